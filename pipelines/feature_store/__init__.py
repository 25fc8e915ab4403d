"""Features of many runs on disk, one file a run: made and read without holding the runs in memory."""
