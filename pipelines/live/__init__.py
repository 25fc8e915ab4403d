"""The chain that runs on the robot's own computer, sample by sample."""
