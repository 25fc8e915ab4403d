"""Controllers in closed loop: side by side, through sensor faults, along a path."""
