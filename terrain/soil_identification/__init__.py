"""Which law of a wheel in sand, with which numbers, agrees with trials of measured forces and sinkage."""
