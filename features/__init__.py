"""Windows and feature arrays, for whole logs and sample by sample."""
