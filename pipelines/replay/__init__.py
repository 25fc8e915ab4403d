"""A log replayed through the live chain."""
