"""The live chain on a CAN bus: frames of the sensors in, corrections of the wheels' speeds out."""
