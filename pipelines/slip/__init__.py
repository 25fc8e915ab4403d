"""``terrain learn-slip``."""
