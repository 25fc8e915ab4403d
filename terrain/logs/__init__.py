"""Run logs: channels and units, readers, writers, and whether two loggers keep one clock."""
