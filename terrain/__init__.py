"""Robot, ground, logs, estimation, classifiers and control: pure code, arrays in and arrays out."""

__version__ = "0.1.0"
