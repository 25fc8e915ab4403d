"""Sessions of robots that are served: samples in, steps out, recording; no network is used here."""
