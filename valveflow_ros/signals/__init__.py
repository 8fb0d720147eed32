"""Signals: alignment of readings into rows, and units."""
