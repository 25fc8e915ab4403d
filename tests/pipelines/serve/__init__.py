"""Tests of the service, over loopback."""
