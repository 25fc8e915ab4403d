"""What the metrics of a drive are called, and how differences of them are written."""

from __future__ import annotations

import re
from typing import NamedTuple

from pipelines.report import format_value
from pipelines.report.numbers import MINUS, NBSP, unit_of
from terrain.control.drive_comparison import ABSOLUTE

LABELS = {
    "energy_j_per_m": ("energy per metre", "J/m"),
    "distance_m": ("distance travelled", "m"),
    "mean_speed_mps": ("mean speed", "m/s"),
    "final_speed_mps": ("final speed", "m/s"),
    "slip_peak": ("largest slip", ""),
    "lock_s": ("longest lock of a wheel", "s"),
    "scrub_j": ("energy dissipated in the contacts", "J"),
    "scrub_along_j": ("of it along the wheels", "J"),
    "immobilised": ("times stuck", ""),
    "adapt_s": ("time to the new terrain's target", "s"),
    "adapted_ratio": ("ratio of terrain changes followed", ""),
    "believed_ratio": ("ratio of driving time with a known terrain", ""),
    "n_accepted": ("outputs of the classifier accepted", ""),
    "n_below_threshold": ("outputs below the threshold", ""),
    "n_refused": ("windows the classifier refused", ""),
    "slip_error_ratio": ("slip error while the speed was limited", ""),
    "sinkage_m": ("sinkage of the deepest wheel", "m"),
    "command_mps2": ("change of the wheels' commands, rms", "m/s²"),
    "yaw_drift_rad": ("change of heading over the drive", "rad"),
    "stop_m": ("stopping distance", "m"),
    "steepest_deg": ("steepest grade climbed", "°"),
}


class Label(NamedTuple):
    """Name of a metric, and its unit or nothing."""

    text: str
    unit: str

    @property
    def with_unit(self) -> str:
        """The name with its unit in brackets."""
        return f"{self.text} [{self.unit}]" if self.unit else self.text


def metric_label(key: str) -> Label:
    """Return the label of a metric.

    Examples
    --------
    >>> tuple(metric_label("first_distance_5s_m")), metric_label("energy_4m_j").with_unit
    (('distance within 5 s of a start, first start', 'm'), 'energy of the first 4 m [J]')
    >>> metric_label("odd_mps").with_unit
    'odd [m/s]'
    """
    if key.startswith("first_"):
        text, unit = metric_label(key.removeprefix("first_"))
        return Label(f"{text}, first start", unit)
    if key in LABELS:
        return Label(*LABELS[key])
    if found := re.fullmatch(r"distance_(.+)s_m", key):
        return Label(f"distance within {found[1]} s of a start", "m")
    if found := re.fullmatch(r"energy_(.+)m_j", key):
        return Label(f"energy of the first {found[1]} m", "J")
    return Label(key.rpartition("_")[0].replace("_", " "), unit_of(key))


def signed_difference(difference: float, key: str) -> str:
    r"""Return a difference with its sign: as a percentage, or in the metric's unit.

    Examples
    --------
    >>> signed_difference(-0.0804, "slip_peak"), signed_difference(1.25, "steepest_deg")
    ('−8.0\xa0%', '+1.25°')
    """
    if key in ABSOLUTE:
        unit = metric_label(key).unit
        text = format_value(abs(difference)) + (unit if unit == "°" else f"{NBSP}{unit}" if unit else "")
    else:
        text = format_value(abs(difference), ".1%")
    if not re.search("[1-9]", text):
        return text
    return ("+" if difference > 0.0 else MINUS) + text
