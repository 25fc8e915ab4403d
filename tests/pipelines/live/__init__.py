"""What the tests of the live chain share."""

import time


def until(fact, timeout_s=10.0):
    """Wait for something to become true."""
    end_s = time.monotonic() + timeout_s
    while not fact():
        assert time.monotonic() < end_s, "it did not become true"
        time.sleep(0.005)
