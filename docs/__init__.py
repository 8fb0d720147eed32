"""The handbook, and the programs that make its tables and pictures."""
