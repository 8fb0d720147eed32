"""The flow characteristic: evaluated, written, inverted, and compared with a reference."""
