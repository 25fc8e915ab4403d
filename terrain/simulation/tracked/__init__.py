"""Tracked robots on a slope: forces under two tracks, or slip that is given, and the log of a run."""
