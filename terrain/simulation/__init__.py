"""Simulated runs: what is driven, by which robot, on what ground, and what its sensors report."""
