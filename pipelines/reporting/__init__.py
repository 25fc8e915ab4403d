"""Pages, drawing, numbers, terminal output and progress."""
