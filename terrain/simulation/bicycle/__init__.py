"""Car-like robots on side slopes, simulated with tyres whose side force saturates."""
