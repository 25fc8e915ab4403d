"""Labels of metrics, controllers and scenarios, as the page shows them."""

from __future__ import annotations

import re
from typing import NamedTuple

from pipelines.drive.controller_names import TRACK
from pipelines.reporting.numbers import NBSP, NOT_KNOWN, format_number

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
UNITS = {
    "mps2": "m/s²",
    "mps": "m/s",
    "rad": "rad",
    "deg": "°",
    "m": "m",
    "s": "s",
    "j": "J",
    "n": "N",
    "ratio": "",
}
"""By the last word of a metric that :data:`LABELS` does not hold."""

_GENERAL = ("slip_peak", "energy_j_per_m", "distance_m", "final_speed_mps")
_OF_SCENARIO = {
    "starts": ("slip_peak", "energy_j_per_m", "distance_5s_m", "energy_4m_j", "final_speed_mps"),
    "brake": ("stop_m", "lock_s", "slip_peak", "energy_j_per_m"),
    "slope": ("steepest_deg", *_GENERAL),
    "circle": ("scrub_j", *_GENERAL),
    "crab": ("scrub_j", *_GENERAL),
    "course": (*_GENERAL, "adapt_s", "adapted_ratio"),
    "mixed": (*_GENERAL, "adapt_s", "adapted_ratio"),
}

ABSOLUTE = ("steepest_deg", "lock_s", "immobilised", "adapt_s", "adapted_ratio")
"""Metrics whose differences are given in their unit; all others relative, as drives differ in size."""

WHERE_ANY = ("immobilised", "lock_s")
"""Metrics that are compared only where a controller has another value than zero."""

ADAPTATION = ("adapt_s", "adapted_ratio")
"""Metrics of controllers whose target follows the terrain; another's may be close to the target by chance."""

_CONTROLLERS = {
    "plain": "The wheel speeds of the kinematics; slip is not used.",
    "ramp": "As plain, with a speed that rises by no more than {ramp}.",
    "thesis": "The thesis' PID of slip on each wheel, with the target of the table's fallback.",
    "thesis:classified": "The thesis' PID of slip on each wheel, with the targets of the terrain that a "
    "classifier recognises while driving: the chain of the thesis.",
    "thesis:true_terrain": "The thesis' PID of slip on each wheel, with the targets of the true terrain.",
    "fallback": "Traction control: one speed for all wheels, limited while it rises; the target is that of "
    "the table's fallback.",
    "classified": "Traction control with the target of the terrain that a classifier recognises while "
    "driving.",
    "true_terrain": "Traction control with the target of the true terrain: the limit for a classifier "
    "without error.",
}

SCENARIOS = {
    "starts": "Stand, start, hold the speed, stop: three times. Metrics of a start are means of the second "
    "and third, when the slip of steady motion is known; those of the first are listed beside them in the "
    "table.",
    "brake": "Drive, and stop as fast as possible.",
    "slope": "Uphill; the steepest grade is searched for at each seed.",
    "course": "All terrains one after the other.",
    "mixed": "Terrains in any order, and no camera for three seconds.",
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
    words, _, last = key.rpartition("_")
    known = bool(words) and last in UNITS
    return Label(words.replace("_", " "), UNITS[last]) if known else Label(key.replace("_", " "), "")


def metrics_of_scenario(scenario: str) -> tuple[str, ...]:
    """Return the metrics that are drawn and compared, the most informative first."""
    return (*_OF_SCENARIO.get(scenario, _GENERAL), "immobilised")


def controller_text(name: str, ramp_mps2: float | None) -> str:
    """Return a sentence on a controller."""
    bare, track, _ = name.partition(TRACK)
    if track:
        return f"{controller_text(bare, ramp_mps2)} With path tracking."
    kind, _, given = name.partition(":")
    if kind == "known" and given:
        return f"Traction control with the target of {given} on every terrain."
    if kind == "target" and given:
        return f"Traction control with a target slip of {given}."
    ramp = "a bound" if ramp_mps2 is None else f"{format_number(ramp_mps2)} m/s²"
    return _CONTROLLERS.get(name, NOT_KNOWN).format(ramp=ramp)


def signed_difference(difference: float, key: str) -> str:
    r"""Return a difference with its sign: as a percentage, or in the metric's unit.

    Examples
    --------
    >>> signed_difference(-0.0804, "slip_peak"), signed_difference(1.25, "steepest_deg")
    ('−8.0\xa0%', '+1.25°')
    """
    if key in ABSOLUTE:
        unit = metric_label(key).unit
        text = format_number(abs(difference)) + (unit if unit == "°" else f"{NBSP}{unit}" if unit else "")
    else:
        percentage = abs(100.0 * difference)
        text = f"{percentage:.0f}{NBSP}%" if percentage >= 9.95 else f"{percentage:.1f}{NBSP}%"
    if not re.search("[1-9]", text):
        return text
    return ("+" if difference > 0.0 else "\N{MINUS SIGN}") + text
