"""Special segments: found while the data stream by, and the rolling window that keeps them."""
