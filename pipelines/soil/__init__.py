"""Identify the soil of a wheel testbed: laws compared on held-out trials, parameters, a soil file."""
