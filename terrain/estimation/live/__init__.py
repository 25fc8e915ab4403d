"""Estimation sample by sample, on memory of a fixed size."""
