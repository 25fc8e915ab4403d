"""Slip that was measured from outside: poses or speeds over ground against what the wheels rolled."""
