"""``terrain faults``: sensor faults in the closed loop, and what the controller makes of each."""
