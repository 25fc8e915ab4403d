"""Frames of a CAN bus: signals that are read and sent, frames to samples and back, logs of frames."""
