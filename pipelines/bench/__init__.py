"""Latency of the live chain and of the service, and the service under load and faults for hours."""
