"""Sensors of simulated robots: errors, low-pass, latency, quantisation and loss."""
