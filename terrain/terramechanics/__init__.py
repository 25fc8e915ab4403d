"""Wheel on ground: described soils, force against slip, and what resists rolling."""
