"""The planar simulation that takes any wheeled robot and replays logs."""
