"""Reports: one tree of parts, three writers; and the settings and results of commands."""
