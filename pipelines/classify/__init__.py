"""``terrain train`` and ``predict``."""
