"""Support of held-out predictions by training runs, and which drives to record next."""
