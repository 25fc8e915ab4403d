"""``terrain estimate`` and ``terrain calibrate``."""
