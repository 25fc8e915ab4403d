"""Recording of live sessions as run folders: what was measured, commanded and classified."""
