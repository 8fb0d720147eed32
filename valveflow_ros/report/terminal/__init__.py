"""The terminal view of a monitor."""
