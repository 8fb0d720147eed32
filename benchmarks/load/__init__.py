"""The running monitor under load: who sends, who counts, and what is tried."""
