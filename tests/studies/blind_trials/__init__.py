"""Blind trials of the diagnosis: effects are hidden in simulated runs."""
