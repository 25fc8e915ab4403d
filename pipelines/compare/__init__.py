"""``terrain compare``."""
