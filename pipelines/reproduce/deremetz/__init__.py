"""Deremetz et al., ICRA 2017."""
