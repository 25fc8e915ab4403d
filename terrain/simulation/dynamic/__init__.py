"""The dynamic simulation of a swerve robot in closed loop."""
