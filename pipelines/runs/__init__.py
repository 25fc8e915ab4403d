"""Import, inspect, simulate and load runs."""
