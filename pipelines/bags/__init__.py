"""MCAP files and ROS 2 bags as runs: topics to streams by a mapping, or as a run was exported."""
