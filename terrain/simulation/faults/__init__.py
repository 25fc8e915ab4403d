"""Faults of sensors in a closed loop: a catalogue, and the bus that applies one."""
