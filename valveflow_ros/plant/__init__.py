"""The simulated plant: the paper's unit, with effects to switch on."""
