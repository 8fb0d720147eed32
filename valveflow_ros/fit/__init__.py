"""The joint fit of curve and dynamics, its uncertainty, and the manual step test."""
