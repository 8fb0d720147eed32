"""Fits and diagnoses in a process of their own."""
