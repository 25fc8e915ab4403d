"""Observers of slip: one a file, all behind one interface."""
