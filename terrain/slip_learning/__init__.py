"""From measured slip and force to slip curves and target slips."""
