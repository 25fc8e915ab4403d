"""Robot, ground, logs, estimation, classifiers and control: pure code, arrays in and arrays out."""

from pathlib import Path

from terrain.kernel_caches import discard_stale

__version__ = "0.1.0"

discard_stale(Path(__file__).parent)
