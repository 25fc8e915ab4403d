"""Calibration of a robot's description from its own run logs (Danzi, AgriMaRo thesis, 3.3 and 4.4.3)."""
