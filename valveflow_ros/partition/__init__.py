"""The exact partition of samples into straight pieces, and the choice of their number."""
