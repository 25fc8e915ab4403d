"""Runs in and out: layouts, bags, CAN logs, simulated runs, labels."""
