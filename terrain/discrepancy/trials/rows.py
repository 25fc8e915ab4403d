"""Kinds of blind trials.  Imports nothing heavy: the command line reads it."""

from __future__ import annotations

from enum import StrEnum


class Row(StrEnum):
    """What is hidden in the runs of a trial.

    ``NONE``: nothing.  ``STRONG``: one effect of 3 times its detection limit.  ``LADDER``: one effect of 0.1
    to 10 times its limit.  ``FOUND``: each effect in turn, around its limit.  ``TWO``: two effects.
    ``OUTSIDE``: something that is not in the library.  ``POOR``: one effect, with drives that excite little.

    What measured runs have besides, see :mod:`terrain.discrepancy.trials.stage`.  ``GROSS``: one effect of 20
    to 100 times its limit.  ``SHORT``: one effect in 80 runs of 6 s.  ``LATE``: a logger is late, beside one
    effect.  ``SCATTERED``: an effect that differs from run to run.  ``STALLED``: runs whose body is at rest,
    beside one effect.  ``HALF``: an effect in half of the runs.  ``SENSOR_LATE``: one sensor is late.
    ``FAULT``: a sign, a unit or an order written into the log.  ``DYNAMIC``: runs of the dynamic simulation,
    half of the trials with nothing hidden.  ``KNOWN``: a skid-steer robot of which the effective track is far
    off, in 80 runs of 6 s.

    Robots of other drives, none of which logs currents.  ``TRACKED``, ``CAR``: each effect in turn, of 3
    times its limit; nothing in every fifth trial.
    """

    NONE = "none"
    STRONG = "strong"
    LADDER = "ladder"
    FOUND = "found"
    TWO = "two"
    OUTSIDE = "outside"
    POOR = "poor"
    GROSS = "gross"
    SHORT = "short"
    LATE = "late"
    SCATTERED = "scattered"
    STALLED = "stalled"
    HALF = "half"
    SENSOR_LATE = "sensor_late"
    FAULT = "fault"
    DYNAMIC = "dynamic"
    KNOWN = "known"
    TRACKED = "tracked"
    CAR = "car"


DRIVE_ROWS = (Row.TRACKED, Row.CAR)
"""Rows of drives whose robots log no currents."""
