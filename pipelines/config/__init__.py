"""Settings of commands: one model a command, the only place of its defaults."""
