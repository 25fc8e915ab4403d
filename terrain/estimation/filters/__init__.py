"""What the filters estimate, from what, and with what noise."""
