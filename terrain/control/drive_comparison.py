"""Drives of several controllers at equal conditions: evaluated, and compared seed by seed.

Means over drives and paired differences have 95 % intervals by Student's distribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from terrain.control.controllers import TRACK, adapts, uses_classifier
from terrain.control.drive_metrics import START_TIME_S, EnergyCurve, energy_at_equal_distance
from terrain.control.situations import STARTS
from terrain.records import Array, RunLog


class MeanInterval(NamedTuple):
    """A mean and its 95 % interval, of the known values: None without one, and the interval of a single one."""

    mean: float | None
    ci: tuple[float, float] | None
    n: int


class Difference(NamedTuple):
    """Mean difference and its 95 % interval, which is NaN where one pair gives none."""

    mean: float
    low: float
    high: float

    @property
    def is_significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0.0 or self.high < 0.0


def mean_interval(values: Sequence[float]) -> MeanInterval:
    """Return the mean of the finite values and its 95 % interval.

    Examples
    --------
    >>> found = mean_interval([1.0, 2.0, 3.0, float("nan")])
    >>> found.mean, [round(end, 3) for end in found.ci], found.n
    (2.0, [-0.484, 4.484], 3)
    """
    known = np.array([value for value in values if math.isfinite(value)])
    if not known.size:
        return MeanInterval(None, None, 0)
    mean, half = float(known.mean()), _half_interval(known)
    ci = None if math.isnan(half) else (mean - half, mean + half)
    return MeanInterval(mean, ci, int(known.size))


def paired_difference(
    values: Sequence[float | None], base: Sequence[float | None], relative: bool
) -> Difference | None:
    """Return the mean of ``values - base``, pair by pair; None without a pair of which both are known.

    Relative to the mean of ``base``, which then has to be above zero.
    """
    pairs = np.array([values, base], dtype=float).T
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if not len(pairs):
        return None
    each = pairs[:, 0] - pairs[:, 1]
    scale = float(pairs[:, 1].mean()) if relative else 1.0
    if scale <= 0.0:
        return None
    mean, half = float(each.mean()) / scale, _half_interval(each) / scale
    return Difference(mean, mean - half, mean + half)


def _half_interval(values: Array) -> float:
    """Return half the 95 % interval of a mean; NaN of a single value."""
    n = len(values)
    if n < 2:
        return math.nan
    return float(student.ppf(0.975, n - 1) * values.std(ddof=1) / math.sqrt(n))


STEEPEST_DEG, SLOPE_STEPS = 25.0, 9
"""Range of the search for the steepest grade, and its bisections: to a tenth of a degree."""

CLIMBING_MPS = 0.05
"""A robot that is faster than this in the last second climbs."""

LEAST_RAMP_MPS2, MOST_RAMP_MPS2, RAMP_STEPS = 0.1, 10.0, 7
"""Range of the search for the matching ramp (up to twice the desired rise, where that is finite), and its
bisections."""

REFERENCES = ("true_terrain", "classified", "fallback")
"""Controllers whose distance the ramp matches: the first of them that is driven."""

HARDLY_BELIEVED_RATIO = 0.1
"""Below this ratio of the driving time with a known terrain, nine tenths of a drive are the fallback's."""

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
"""Metrics that a scenario is about, the most informative first."""

ABSOLUTE = ("steepest_deg", "lock_s", "immobilised", "adapt_s", "adapted_ratio")
"""Metrics whose differences are given in their unit; all others relative, as drives differ in size."""

WHERE_ANY = ("immobilised", "lock_s")
"""Metrics that are compared only where a controller has another value than zero."""

ADAPTATION = ("adapt_s", "adapted_ratio")
"""Metrics of controllers whose target follows the terrain; another's may be close to the target by chance."""

Metrics = Mapping[str, float]
"""Metrics of one drive by name; NaN where one is undefined."""

UNKNOWN = MeanInterval(None, None, 0)


class Drive(NamedTuple):
    """Metrics of one drive by name, its energy over distance, and its curves where they are shown."""

    metrics: dict[str, float]
    energy: EnergyCurve
    curves: Any = None


def add_energies(drives: Mapping[str, Sequence[Drive]]) -> None:
    """Add to the metrics of drives, by controller over the same seeds, their energy at equal distance."""
    for at_one_seed in zip(*drives.values(), strict=True):
        energies = energy_at_equal_distance([one.energy for one in at_one_seed])
        for one, energy in zip(at_one_seed, energies, strict=True):
            one.metrics["energy_j_per_m"] = energy


def steepest_grade(drive: Callable[[float], RunLog]) -> float:
    """Return the steepest grade in degrees that is climbed, by bisection over drives at grades."""
    low, high = -STEEPEST_DEG, STEEPEST_DEG
    for _ in range(SLOPE_STEPS):
        middle = (low + high) / 2
        truth = drive(middle).streams["truth"]
        last = truth.time_s > truth.time_s[-1] - 1.0
        climbs = truth.channel("speed_x_mps")[last].mean() > CLIMBING_MPS
        low, high = (middle, high) if climbs else (low, middle)
    return low


def matching_ramp(
    drives: Mapping[str, Sequence[Drive]],
    of_ramp: Callable[[float], Sequence[Drive]],
    scenario: str,
    accel_mps2: float,
) -> float | None:
    """Return the rise of speed in m/s^2 by which the ramp travels as far as the first reference among controllers.

    None where no controller is a reference.

    Parameters
    ----------
    drives : by controller, at the same seeds
    of_ramp : drives of the controller ``ramp`` with a rise of speed in m/s^2
    scenario, accel_mps2 : that is driven, and the desired rise of speed
    """
    references = [name for kind in REFERENCES for name in drives if name in (kind, f"{kind}{TRACK}")]
    references += [name for name in drives if name.startswith(("known:", "target:"))]
    if not references:
        return None
    key = f"distance_{START_TIME_S:g}s_m" if scenario == STARTS else "distance_m"

    def distance_m(found: Sequence[Drive]) -> float:
        return float(np.mean([one.metrics[key] for one in found]))

    desired_m = distance_m(drives[references[0]])
    low = LEAST_RAMP_MPS2
    high = 2.0 * accel_mps2 if math.isfinite(accel_mps2) else MOST_RAMP_MPS2
    for _ in range(RAMP_STEPS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if distance_m(of_ramp(middle)) < desired_m else (low, middle)
    return math.sqrt(low * high)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers over the same seeds.

    Parameters
    ----------
    scenario : that was driven
    rows : by controller, the metrics of each seed
    """

    scenario: str
    rows: Mapping[str, Sequence[Metrics]]

    @cached_property
    def means(self) -> dict[str, dict[str, MeanInterval]]:
        """By controller and metric, its mean over seeds with its 95 % interval."""
        return {
            name: {key: mean_interval([row[key] for row in rows]) for key in rows[0]}
            for name, rows in self.rows.items()
        }

    @cached_property
    def shown(self) -> list[str]:
        """Metrics that are drawn and compared: those of the scenario that a controller has."""
        found = []
        for key in (*_OF_SCENARIO.get(self.scenario, _GENERAL), "immobilised"):
            means = [self.value(name, key).mean for name in self.rows]
            if any(means) if key in WHERE_ANY else any(mean is not None for mean in means):
                found.append(key)
        return found

    def value(self, name: str, key: str) -> MeanInterval:
        """Return a metric of a controller; unknown where it has none, or only by chance."""
        if key in ADAPTATION and not adapts(name):
            return UNKNOWN
        return self.means[name].get(key, UNKNOWN)

    def difference(self, name: str, other: str, key: str) -> Difference | None:
        """Return the difference of a metric between two controllers, seed by seed; None where one has none."""
        if self.value(name, key).mean is None or self.value(other, key).mean is None:
            return None
        values, base = ([row.get(key) for row in self.rows[one]] for one in (name, other))
        return paired_difference(values, base, relative=key not in ABSOLUTE)

    def is_hardly_believed(self, name: str) -> bool:
        """Return whether a controller uses a classifier that was never or hardly believed.

        What such a controller shows is not the classifier's effect.
        """
        believed = self.value(name, "believed_ratio").mean
        return uses_classifier(name) and believed is not None and believed < HARDLY_BELIEVED_RATIO
