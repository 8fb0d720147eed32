"""What is fast, and how far results are from the truth: measured, not asserted."""
