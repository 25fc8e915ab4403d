"""Health of logs: faults of columns with their repair, and runs that are unfit."""
