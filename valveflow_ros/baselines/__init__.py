"""The methods the paper compares with, and how models are judged on other data."""
