"""Recordings in MCAP: reading, writing, following and repairing them."""
