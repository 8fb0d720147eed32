"""Compares the speed of this tree with that of an earlier one."""
