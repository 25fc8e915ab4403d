"""``terrain odometry``: odometry of tracked robots fitted to some runs and judged on others."""
