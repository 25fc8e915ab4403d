"""``terrain explain`` and ``terrain explain-trials``."""
