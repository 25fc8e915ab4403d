"""A law of a wheel in sand identified from trials of a wheel testbed, compared with others on trials held out.

**Trials.**  One wheel at set slips and slip angles.  What a testbed adds to the traction of its side force is found
by symmetry: a locked wheel that is dragged along its axle looks the same from ahead and from behind, its traction
is 0, and what is measured is the instrument's, as of a mount that bends under the side force::

    Fx_measured = Fx + x Fy,   x = sum(Fx_measured Fy) / sum(Fy^2) over such trials

**Laws.**  A law is which terms of the wheel's stresses (:mod:`terrain.terramechanics.inflow_wheel`) are there, and
which law gives the sinkage.  Sinkage is fitted first, then the forces at the sinkage that it predicts, both by least
squares (:func:`terrain.identify.identify`) with weak normal priors, which hold what the trials do not::

    sum over settings of n ((z - z') / 2 mm)^2             + sum of ((p - p0) / s)^2
    sum over settings of n (((Fx - Fx') / W / 0.1)^2 + ((Fy - Fy') / W / 0.1)^2) + sum of ((p - p0) / s)^2

n is the number of trials of a setting over the mean number, and 2 mm and 0.1 are what such laws miss by, of which
the repeats of a trial (0.8 mm, 0.04) are a small part.

**Comparison.**  Each law predicts slips, and slip angles, that its fit did not have; a polynomial of both shows how
well a fit without any mechanics does.

**The simulator's law** has one number for the limit of the thrust, one for its rise and Bekker's sinkage, with the
force along the resultant slip (:func:`~terrain.terramechanics.traction.wheel_ground`).  Of one wheel under one load
four numbers can be fitted: friction, shear modulus, kphi and slip sinkage.  Cohesion is taken as 0, kc as 0 (it
needs wheels of two widths) and the exponent n as 1 (it needs two loads).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.errors import DataError
from terrain.identify import Fit, Parameter, folds, identify
from terrain.logs.testbed import STREAM
from terrain.records import Array, RunLog
from terrain.terramechanics.inflow_wheel import FORCE, NAMES, bulldozing_ratio, wheel_forces
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import ground_record, wheel_ground
from terrain.terramechanics.travel_sinkage import (
    DEEPEST_RATIO,
    DING,
    LYASKO,
    TRAVEL,
    ding_sinkage,
    lyasko_sinkage,
    travel_sinkage,
)


class Wheel(NamedTuple):
    """A rigid wheel: radius by which it turns, radius up to the grousers' tips, and width."""

    name: str
    radius_m: float
    tip_radius_m: float
    width_m: float


WHEELS: dict[str, Wheel] = {
    "testbed_smooth": Wheel("smooth", 0.058, 0.058, 0.050),
    "testbed_grouser": Wheel("grouser", 0.058, 0.063, 0.050),
}
"""By the name of the robot: Pavlov and Johnson, repository robomechanics/3d-terramechanics."""

MIN_SETTINGS = 20  #: Settings of slip and angle below which a law with twenty parameters is not fitted


class Trials(NamedTuple):
    """Trials of one wheel, each array (n,)."""

    #: wheel_radps, travel_mps, slip_angle_rad: measured motion; the commanded angle, which the wheel keeps
    wheel_radps: Array
    travel_mps: Array
    slip_angle_rad: Array
    slip_ratio: Array  #: of the speeds of wheel and travel
    #: load_n, pull_n, side_n: what the ground does to the wheel: up, ahead, and to the side of the angle's sign
    load_n: Array
    pull_n: Array
    side_n: Array
    sinkage_m: Array  #: of the lowest point
    slip_setting: Array  #: slip_setting, angle_setting: commanded wheel speed in mm/s and angle in degrees
    angle_setting: Array
    n_trials: Array  #: number of trials behind an entry

    @property
    def n(self) -> int:
        """Number of entries."""
        return int(self.load_n.size)

    def chosen(self, rows: Array) -> Trials:
        """Return the trials of a mask or of row numbers (m,)."""
        return Trials._make(column[rows] for column in self)


def trials_of(runs: Sequence[RunLog], wheel: Wheel) -> Trials:
    """Return the trials that runs of the testbed hold.

    Raises
    ------
    DataError
        if a run has no stream of the testbed, or no load.
    """
    rows: list[list[float]] = []
    for run in runs:
        if STREAM not in run.streams:
            raise DataError(
                f"run {run.run_id}: has no stream {STREAM!r}, as trials of the wheel testbed have"
            )
        stream = run.streams[STREAM]
        value = {channel: float(stream.channel(channel)[0]) for channel in stream.channels}
        if not value["force_z_n"] > 0.0:
            raise DataError(
                f"run {run.run_id}: force_z_n is {value['force_z_n']:g} N, a load above 0 is needed"
            )
        names = "slip_measured_ratio", "force_z_n", "force_x_n", "force_y_n", "sinkage_wheel_m"
        angle_rad = value["slip_angle_commanded_rad"]
        settings = round(value["speed_wheel_commanded_mps"] * 1e3, 3), round(np.degrees(angle_rad), 3)
        motion = value["speed_wheel_mps"] / wheel.radius_m, value["speed_travel_mps"], angle_rad
        rows.append([*motion, *(value[name] for name in names), *settings, 1.0])
    return Trials(*np.array(rows).T)


def setting_means(trials: Trials) -> Trials:
    """Return the mean trial of each setting of slip and angle, with how many it stands for.

    Raises
    ------
    DataError
        if there are fewer settings than :data:`MIN_SETTINGS`.
    """
    settings = np.column_stack([trials.slip_setting, trials.angle_setting])
    _, index, counts = np.unique(settings, axis=0, return_inverse=True, return_counts=True)
    if len(counts) < MIN_SETTINGS:
        raise DataError(
            f"trials have {len(counts)} settings of slip and angle, a fit needs {MIN_SETTINGS} or more"
        )
    means = Trials._make(np.bincount(index.ravel(), column) / counts for column in trials)
    return means._replace(n_trials=counts.astype(float))


MIN_ANGLE_DEG, MAX_SLIP = 89.0, -0.99
MIN_TRIALS = 2


class Coupling(NamedTuple):
    """Part of the side force that is measured as traction; its scatter over trials, and their number.

    ``ratio`` and ``std_ratio`` are NaN without :data:`MIN_TRIALS` trials of a locked wheel along its axle.
    """

    ratio: float
    std_ratio: float
    n_trials: int

    @property
    def text(self) -> str:
        """By how much the measured traction is corrected, or that it is not, in words."""
        if math.isnan(self.ratio):
            return "traction as measured, no trials of a locked wheel along its axle"
        return (
            f"traction less {self.ratio:.3f} ± {self.std_ratio:.3f} of the side force, what {self.n_trials} trials "
            "of a locked wheel along its axle show"
        )


def calibration_rows(trials: Trials) -> Array:
    """Return which trials (n,) are of a locked wheel that is dragged along its axle."""
    return (np.abs(trials.angle_setting) > MIN_ANGLE_DEG) & (trials.slip_ratio < MAX_SLIP)


def side_coupling(trials: Trials) -> Coupling:
    """Return the coupling that the trials of a locked wheel along its axle show."""
    own = trials.chosen(calibration_rows(trials))
    if own.n < MIN_TRIALS:
        return Coupling(np.nan, np.nan, own.n)
    ratio = float((own.pull_n * own.side_n).sum() / (own.side_n**2).sum())
    return Coupling(ratio, float(np.std(own.pull_n / own.side_n, ddof=1)), own.n)


def without_coupling(trials: Trials, coupling: Coupling) -> Trials:
    """Return trials with their traction corrected, less those that the coupling was found from.

    Without a coupling they are returned as they are.
    """
    if np.isnan(coupling.ratio):
        return trials
    corrected = trials._replace(pull_n=trials.pull_n - coupling.ratio * trials.side_n)
    return corrected.chosen(~calibration_rows(trials))


SINKAGES: dict[str, dict[str, tuple[float, float]]] = {"travel": TRAVEL, "lyasko": LYASKO, "ding": DING}
"""Parameters of each law of sinkage."""


class Law(NamedTuple):
    """A law of the forces and one of the sinkage."""

    name: str  #: of both
    sinkage: str  #: one of :data:`SINKAGES`
    free: tuple[str, ...]  #: parameters of :data:`~terrain.terramechanics.inflow_wheel.FORCE` that are fitted
    fixed: Mapping[str, float]  #: value of each other one that is not where its fit would begin
    tied: bool  #: whether the side face's pressure is that of the friction angle
    text: str  #: what it is, for readers


_ARC = ("pressure_exponent", "peak_ratio", "peak_slip_ratio", "exit_ratio", "tan_friction", "shear_modulus_m")
_SIDE = ("inflow", "pressure", "friction", "lift")
_NO_SIDE = dict.fromkeys((*(f"side_{name}_ratio" for name in _SIDE), "exit_slip_ratio", "inflow"), 0.0)
_BULLDOZING = _NO_SIDE | {"side_depth_exponent": 1.0, "travel_exponent": 1.0, "rotation_exponent": 0.0}
_BEKKER = _NO_SIDE | {"peak_ratio": 0.0, "peak_slip_ratio": 0.0, "exit_ratio": 0.0}
_BEKKER_FREE = "pressure_exponent", "tan_friction", "shear_modulus_m"
_BEKKER_TEXT = "Bekker's pressure by depth in front of the axle, Janosi's shear, Lyasko's sinkage"
ALL = tuple(name for name in NAMES if name not in ("cohesion_pa", "inflow"))

LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        Law("bekker", "lyasko", _BEKKER_FREE, _BEKKER, False, _BEKKER_TEXT),
        Law(
            "wong_reece", "lyasko", _ARC, _NO_SIDE, False, "Wong and Reece's peak and exit, Lyasko's sinkage"
        ),
        Law("ishigami", "lyasko", _ARC, _BULLDOZING, True, "and Ishigami's bulldozing of the side face"),
        Law("ishigami_ding", "ding", _ARC, _BULLDOZING, True, "the same with Ding's sinkage"),
        Law("ishigami_travel", "travel", _ARC, _BULLDOZING, True, "the same with the sinkage by travel"),
        Law("inflow", "travel", ALL, {}, False, "inflow of soil, friction and lift of the side face"),
    )
}
"""By name, from the plainest to the one that holds."""


class Prediction(NamedTuple):
    """Forces in N, sinkage in m and apparent modulus in Pa of each trial, (n,)."""

    pull_n: Array
    side_n: Array
    sinkage_m: Array
    modulus_pa: Array


def sinkage_of(law: Law, values: Array, trials: Trials, wheel: Wheel) -> Array:
    """Return the sinkage (n,) in m that a law predicts from slip and angle, and Ding's from the load."""
    radius_m = wheel.tip_radius_m
    if law.sinkage == "travel":
        wheel_mps = trials.wheel_radps * radius_m
        depth = travel_sinkage(values, wheel_mps, trials.travel_mps, trials.slip_angle_rad, radius_m)
    elif law.sinkage == "lyasko":
        depth = lyasko_sinkage(values, trials.slip_ratio)
    else:
        depth = ding_sinkage(values, trials.slip_ratio, trials.load_n, radius_m, wheel.width_m)
    return np.clip(depth, 1e-4, DEEPEST_RATIO * radius_m)


def _motion(trials: Trials) -> Array:
    """Return motion and load (n, 4) as :func:`~terrain.terramechanics.inflow_wheel.wheel_forces` takes them."""
    return np.ascontiguousarray(np.array([*trials[:3], trials.load_n]).T)


def forces_of(law: Law, values: Array, trials: Trials, wheel: Wheel, sinkage_m: Array) -> Prediction:
    """Return the forces of each trial for a sinkage (n,) in m, the free parameters of the law being ``values``."""
    named = {name: entry[0] for name, entry in FORCE.items()} | dict(law.fixed)
    named |= dict(zip(law.free, np.asarray(values).tolist(), strict=True))
    if law.tied:
        named["side_pressure_ratio"] = bulldozing_ratio(named["tan_friction"])
    depths, vector = np.ascontiguousarray(sinkage_m), np.array([named[name] for name in NAMES])
    pull, side, modulus = wheel_forces(vector, wheel.tip_radius_m, wheel.width_m, _motion(trials), depths).T
    return Prediction(pull, side, depths, modulus)


SINKAGE_MISFIT_M = 2e-3
FORCE_MISFIT_RATIO = 0.1
_STARTS = (0.0, -0.7, 0.7)  #: In standard deviations of the priors: where fits begin; the best one counts


class LawFit(NamedTuple):
    """A fitted law: what was fitted, and the parameters of its sinkage and of its forces."""

    law: Law
    wheel: Wheel
    sinkage: Fit
    force: Fit


def fit_law(law: Law, trials: Trials, wheel: Wheel, start: LawFit | None = None) -> LawFit:
    """Return a law fitted to trials.

    Parameters
    ----------
    law, wheel : what to fit, and the wheel of the trials
    trials : means of settings, with their numbers
    start : a fit to begin at; without one, begin at several places around the priors
    """
    weight = np.sqrt(trials.n_trials / trials.n_trials.mean())
    scale = weight / (FORCE_MISFIT_RATIO * trials.load_n)

    def fit(misses: Callable[[Array], Array], parameters: list[Parameter], before: Fit | None) -> Fit:
        starts = [np.array([p.nominal + s * p.prior_std for p in parameters]) for s in _STARTS]
        starts = starts if before is None else [before.value]
        return identify(misses, parameters, starts=starts, diff_step=1e-4, xtol=1e-5, ftol=1e-5, max_nfev=60)

    def depth_misses(values: Array) -> Array:
        return np.asarray(
            (sinkage_of(law, values, trials, wheel) - trials.sinkage_m) * weight / SINKAGE_MISFIT_M
        )

    def force_misses(values: Array) -> Array:
        found = forces_of(law, values, trials, wheel, depths)
        return np.concatenate(
            [(found.pull_n - trials.pull_n) * scale, (found.side_n - trials.side_n) * scale]
        )

    depth = [Parameter(name, mean, 0.0, prior_std=std) for name, (mean, std) in SINKAGES[law.sinkage].items()]
    sinkage = fit(depth_misses, depth, None if start is None else start.sinkage)
    depths = sinkage_of(law, sinkage.value, trials, wheel)
    priors = ((name, *FORCE[name]) for name in law.free)
    force = [Parameter(name, mean, low, high, std) for name, mean, std, low, high in priors]
    return LawFit(law, wheel, sinkage, fit(force_misses, force, None if start is None else start.force))


def predict(fit: LawFit, trials: Trials, given: str = "load") -> Prediction:
    """Return what a fitted law predicts of trials, with ``given`` ``sinkage`` at the measured one."""
    depths = trials.sinkage_m
    if given == "load":
        depths = sinkage_of(fit.law, fit.sinkage.value, trials, fit.wheel)
    return forces_of(fit.law, fit.force.value, trials, fit.wheel, depths)


class SoilParameter(NamedTuple):
    """A parameter of a law."""

    name: str  #: ends in its unit, or in ``ratio`` or ``exponent``
    value: float  #: of the fit to all trials
    #: 95 %: what holds both the bootstrap over settings of slip and angle, which knows nothing of what the prior
    #: pulls, and what the fit with its prior leaves open
    interval: tuple[float, float]
    prior_std: float  #: standard deviation that the prior holds it with
    informed_ratio: float  #: standard deviation with the trials over that without them
    identified: bool  #: whether the trials narrow it to less than half, away from its bounds


def parameters_of(
    fit: LawFit, trials: Trials, n_draws: int, seed: int, on_draw: Callable[[], None] = lambda: None
) -> dict[str, SoilParameter]:
    """Return the parameters of a fitted law by name, those of the sinkage first.

    Parameters
    ----------
    fit, trials : to all trials, means of settings as they were fitted
    n_draws, seed : of the bootstrap, over whole settings, as repeats of a trial share what a law misses
    on_draw : called after each sample
    """
    draws = []
    for count in bootstrap_counts(trials.n, n_draws, seed):
        sample = trials.chosen(rows := np.flatnonzero(count))
        again = fit_law(
            fit.law, sample._replace(n_trials=sample.n_trials * count[rows]), fit.wheel, start=fit
        )
        draws.append(np.concatenate([again.sinkage.value, again.force.value]))
        on_draw()
    found: dict[str, SoilParameter] = {}
    for own in (fit.sinkage, fit.force):
        columns = zip(own.parameters, own.value, own.std, *own.interval, own.identified, strict=True)
        for p, value, std, low, high, identified in columns:
            if draws:
                least, most = percentile_interval(np.array(draws)[:, len(found)])
                low, high = min(low, least), max(high, most)
            interval = max(float(low), p.low), min(float(high), p.high)
            informed = float(std) / p.prior_std
            found[p.name] = SoilParameter(
                p.name, float(value), interval, p.prior_std, informed, bool(identified)
            )
    return found


class CohesionRow(NamedTuple):
    """A fit with a cohesion that is held: friction that goes with it, and the sum of squares of the fit."""

    cohesion_pa: float
    friction_angle_rad: float
    cost: float


def cohesion_profile(
    law: Law, trials: Trials, wheel: Wheel, cohesions_pa: Sequence[float]
) -> list[CohesionRow]:
    """Return how much less friction goes with each cohesion."""
    rows = []
    place = law.free.index("tan_friction")
    for cohesion_pa in cohesions_pa:
        fit = fit_law(law._replace(fixed={**law.fixed, "cohesion_pa": cohesion_pa}), trials, wheel)
        rows.append(CohesionRow(cohesion_pa, float(np.arctan(fit.force.value[place])), fit.force.cost))
    return rows


class ModulusSpread(NamedTuple):
    """Pressure in Pa at a depth of one wheel width that carries the measured load at the measured sinkage."""

    #: median of trials that roll straight ahead, |slip| below 0.3 and angle below 8 degrees
    rolling_pa: float
    smallest_pa: float  #: smallest_pa, largest_pa: 5 and 95 % over all trials
    largest_pa: float
    #: root mean square of the logarithm of the load by the median modulus over the measured
    load_error_ratio: float


def modulus_spread(fit: LawFit, trials: Trials) -> ModulusSpread:
    """Return how the apparent modulus of the soil differs from trial to trial."""
    modulus = predict(fit, trials, "sinkage").modulus_pa
    straight = (np.abs(trials.slip_ratio) < 0.3) & (np.abs(trials.angle_setting) < 8.0)
    rolling = float(np.median(modulus[straight])) if straight.any() else np.nan
    low, high = np.quantile(modulus, [0.05, 0.95]).tolist()
    spread = np.log(modulus / np.median(modulus))
    return ModulusSpread(rolling, low, high, float(np.sqrt(np.mean(spread**2))))


PARAMETERS = {
    "friction_angle_rad": (0.5, 0.05, 1.1),
    "shear_modulus_m": (0.01, 1e-4, 0.5),
    "kphi_npmn2": (1e6, 1e3, 1e9),
    "slip_sinkage_ratio": (0.5, 1e-3, 5.0),
}
"""Of the simulator's law: where the search begins, and its bounds; they are identified by their logarithms."""

MAX_ANGLE_DEG, MIN_SLIP = 31.0, -0.6  #: Of trials that roll nearly straight, as a robot's wheels do
SINKAGE_M = 5e-3  #: Error of the sinkage that weighs as much as one of the forces of a tenth of the load


class PlainFit(NamedTuple):
    """Values and 95 % intervals of :data:`PARAMETERS`, NaN of what was held, and the number of trials."""

    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    n_trials: int

    @property
    def soil(self) -> Soil:
        """The soil, what one wheel under one load says nothing of taken as none."""
        return plain_soil(np.array(list(self.values.values())))


def plain_soil(values: Array) -> Soil:
    """Return the soil of fitted values (4,) in the order of :data:`PARAMETERS`."""
    assumed = "rolling_resistance_ratio", "roughness_m3", "cohesion_pa", "kc_npmn1"
    named = dict(zip(PARAMETERS, values.tolist(), strict=True)) | dict.fromkeys(assumed, 0.0)
    return Soil("fit", "janosi", sinkage_exponent_ratio=1.0, **named)


def plain_prediction(soil: Soil, trials: Trials, wheel: Wheel) -> Prediction:
    """Return what the simulator's law predicts; its apparent modulus is NaN.

    Lateral slip is over the larger of both speeds along the wheel, as in the simulator.
    """
    ground = ground_record(soil, wheel.tip_radius_m, wheel.width_m, 0.0)[0]
    out = np.full((trials.n, 4), np.nan)
    for i, (omega, travel, angle, load) in enumerate(_motion(trials)):
        speed, ahead, across = omega * wheel.radius_m, travel * math.cos(angle), travel * math.sin(angle)
        fastest = max(speed, abs(ahead), 1e-9)
        slip_x, slip_y = (speed - ahead) / fastest, across / fastest
        thrust, side, resistance, sinkage = wheel_ground(ground, load, slip_x, slip_y)
        out[i, :3] = thrust - resistance, side, sinkage
    return Prediction(*out.T)


def nearly_straight(trials: Trials) -> Trials:
    """Return the trials that roll nearly straight ahead, and do not skid much."""
    return trials.chosen((np.abs(trials.angle_setting) < MAX_ANGLE_DEG) & (trials.slip_ratio > MIN_SLIP))


def fit_plain_soil(
    trials: Trials, wheel: Wheel, friction_angle_rad: float = math.nan, n_draws: int = 0, seed: int = 0
) -> PlainFit:
    """Return the soil that fits trials best.

    Parameters
    ----------
    trials, wheel : means of settings, of one wheel
    friction_angle_rad : to hold; NaN to fit it with the others
    n_draws, seed : of the bootstrap over settings

    Raises
    ------
    DataError
        if there are fewer settings than parameters.
    """
    if trials.n < len(PARAMETERS):
        raise DataError(f"trials have {trials.n} settings, the simulator's law needs {len(PARAMETERS)}")
    names, bounds = list(PARAMETERS), np.log(list(PARAMETERS.values()))
    held = 0 if math.isnan(friction_angle_rad) else 1
    logs = bounds[:, 0].copy()
    if held:
        logs[0] = math.log(friction_angle_rad)
    parameters = [Parameter(names[i], logs[i], *bounds[i, 1:]) for i in range(held, len(names))]

    def misses(weight: Array, values: Array) -> Array:
        found = plain_prediction(plain_soil(np.exp([*logs[:held], *values])), trials, wheel)
        forces = found.pull_n - trials.pull_n, found.side_n - trials.side_n
        scaled = [force / trials.load_n / FORCE_MISFIT_RATIO for force in forces]
        depth = (found.sinkage_m - trials.sinkage_m) / SINKAGE_M
        return np.concatenate([weight * miss for miss in (*scaled, depth)])

    def identified(weight: Array, start: Array) -> Array:
        """Return the logarithms of what is not held that fit trials with weights (n,) best."""
        return identify(partial(misses, weight), parameters, starts=[start], max_nfev=60).value

    best = identified(np.ones(trials.n), logs[held:])
    draws = [identified(np.sqrt(count), best) for count in bootstrap_counts(trials.n, n_draws, seed)]
    intervals = dict.fromkeys(names, (math.nan, math.nan))
    if n_draws:
        intervals |= zip(names[held:], map(percentile_interval, np.exp(draws).T), strict=True)
    values = dict(zip(names, np.exp([*logs[:held], *best]).tolist(), strict=True))
    return PlainFit(values, intervals, int(trials.n_trials.sum()))


def soil_yaml(name: str, wheel: str, dataset: str, fit: PlainFit, friction: SoilParameter, law: str) -> str:
    """Return the text of a soil file, as ``data/soils`` describes soils."""
    trials, by = f"{fit.n_trials} trials of the {wheel} wheel", f"terrain calibrate on {dataset}"
    low, high = (math.atan(bound) for bound in friction.interval)
    interval = f"95 % over settings of slip and angle: {low:.3f} to {high:.3f} rad"
    rough = load_soil("dry_sand").roughness_m3
    rows = [
        ("rolling_resistance_ratio", 0.0, "assumed: a rigid wheel has no loss of its own"),
        ("slip_sinkage_ratio", None, ""),
        ("roughness_m3", rough, "assumed: that of dry_sand; a testbed has none"),
        ("cohesion_pa", 0.0, "assumed: under one load cohesion cannot be separated from friction"),
        ("friction_angle_rad", math.atan(friction.value), f"{by}, {wheel} wheel, law {law}; {interval}"),
        ("shear_modulus_m", None, ""),
        ("kc_npmn1", 0.0, "assumed: one width of wheel says nothing of it"),
        ("kphi_npmn2", None, ""),
        ("sinkage_exponent_ratio", 1.0, "assumed: one load says nothing of it"),
    ]
    described: dict[str, Any] = {"name": name, "law": "janosi"}
    for key, value, source in rows:
        if value is None:
            value, (low, high) = fit.values[key], fit.intervals[key]
            of = f"{trials}, nearly straight, law of the simulator; 95 % over settings"
            source = f"{by}, {of}: {low:.4g} to {high:.4g}"
        unit = key.rpartition("_")[2]
        described[key] = {"value": float(f"{value:.4g}"), "unit": unit, "source": source}
    head = f"# Dry sand of a wheel testbed, identified from {trials}.\n"
    return head + yaml.safe_dump(described, sort_keys=False, width=1000, allow_unicode=True)


HELD_OUT = {"slip": "slip_setting", "angle": "angle_setting"}
"""What is held out in turn: all trials of one commanded wheel speed, or of one slip angle."""

GIVEN = ("load", "sinkage")

SLIPS = {"skidding": (-1.1, -0.1), "rolling": (-0.1, 0.1), "driving": (0.1, 1.1)}
ANGLES_DEG = {"0 to 30 deg": (0.0, 31.0), "45 to 75 deg": (31.0, 76.0), "90 deg": (76.0, 91.0)}
"""Ranges of slip and of the slip angle's size, by which misfits are shown."""

BAR_RATIO = 0.15
"""Root mean square error of each force over the load, on slips or angles left out, that is aimed at."""

AXLE_ANGLE_DEG = 89.0  #: From here on a wheel is dragged along its axle, and stands deeper than its axle

COHESIONS_PA = (0.0, 250.0, 500.0, 1000.0)
SIMULATOR_TEXT = "the law of terrain simulate: one limit, one rise, along the resultant slip"
DEGREE = 4  #: Of the polynomial that laws are compared with


class Misfit(NamedTuple):
    """Root mean square errors: of both forces over the load, and of the sinkage in m; NaN of no trial."""

    n_trials: int
    pull_ratio: float
    side_ratio: float
    sinkage_m: float

    @property
    def forces(self) -> str:
        """The errors of traction and side force, in words."""
        return f"{100.0 * self.pull_ratio:.1f} % and {100.0 * self.side_ratio:.1f} %"


def misfit(trials: Trials, prediction: Prediction, rows: Array | None = None) -> Misfit:
    """Return the errors of a prediction of trials, or of those of a mask (n,)."""
    rows = np.ones(trials.n, dtype=bool) if rows is None else rows
    if not rows.any():
        return Misfit(0, np.nan, np.nan, np.nan)
    errors = (
        (prediction.pull_n - trials.pull_n) / trials.load_n,
        (prediction.side_n - trials.side_n) / trials.load_n,
        prediction.sinkage_m - trials.sinkage_m,
    )
    return Misfit(int(rows.sum()), *(float(np.sqrt(np.mean(error[rows] ** 2))) for error in errors))


def regime_misfits(trials: Trials, prediction: Prediction) -> dict[str, Misfit]:
    """Return the errors by regime of slip and slip angle, of those that have trials."""
    angle, found = np.abs(trials.angle_setting), {}
    for (name, (slow, fast)), (far, (least, most)) in itertools.product(SLIPS.items(), ANGLES_DEG.items()):
        rows = (trials.slip_ratio >= slow) & (trials.slip_ratio < fast) & (angle >= least) & (angle < most)
        if rows.any():
            found[f"{name}, {far}"] = misfit(trials, prediction, rows)
    return found


Predictor = Callable[[Trials, Trials], dict[str, Prediction]]
"""From training trials (means of settings) and tested trials to predictions by what is given."""


def law_predictor(law: Law, wheel: Wheel) -> Predictor:
    """Return what fits a law to the first trials and predicts the second, by each of :data:`GIVEN`."""

    def predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
        fit = fit_law(law, training, wheel)
        return {given: predict(fit, tested, given) for given in GIVEN}

    return predictions


def polynomial_predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
    """Return forces over the load and sinkage by ridge regression on a polynomial of slip and angle.

    The strength of the ridge is chosen by leave-one-out on the training part.
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    forces = training.pull_n / training.load_n, training.side_n / training.load_n
    targets = np.column_stack([*forces, training.sinkage_m * 10.0])
    ridge = RidgeCV(alphas=np.logspace(-4, 3, 29), alpha_per_target=True)
    model = make_pipeline(StandardScaler(), PolynomialFeatures(DEGREE), StandardScaler(), ridge)
    slips, tested_slips = (
        np.column_stack([own.slip_ratio, own.slip_angle_rad]) for own in (training, tested)
    )
    pull, side, depth = model.fit(slips, targets).predict(tested_slips).T
    unknown = np.full(tested.n, np.nan)
    return {"load": Prediction(pull * tested.load_n, side * tested.load_n, depth / 10.0, unknown)}


def held_out_predictions(
    trials: Trials, predictor: Predictor, held_out: str, on_fold: Callable[[], None] = lambda: None
) -> dict[str, Prediction]:
    """Return predictions of all trials, each by a fit without its slip or its angle.

    Parameters
    ----------
    trials : single ones
    predictor : fits and predicts
    held_out : ``slip`` or ``angle``
    on_fold : called after each fit

    Raises
    ------
    DataError
        if too few settings are left to fit.
    """
    found: dict[str, list[Array]] = {}
    for training, tested in folds(getattr(trials, HELD_OUT[held_out])):
        for given, part in predictor(setting_means(trials.chosen(training)), trials.chosen(tested)).items():
            whole = found.setdefault(given, [np.full(trials.n, np.nan) for _ in part])
            for all_trials, these in zip(whole, part, strict=True):
                all_trials[tested] = these
        on_fold()
    return {given: Prediction(*whole) for given, whole in found.items()}


class HeldOut(NamedTuple):
    """Errors of predictions with the slip, or the angle, of each trial left out of the fit."""

    load: Misfit  #: sinkage predicted, from slip, angle and load alone
    sinkage: Misfit  #: sinkage measured
    below_axle_angle: Misfit  #: of ``load``, trials but those dragged along the axle
    reached: bool  #: whether both forces of ``load`` are within :data:`BAR_RATIO`


class LawRow(NamedTuple):
    """A law by its errors on slips and on angles that were left out."""

    name: str
    text: str
    n_parameters: int
    slip: HeldOut
    angle: HeldOut


class SoilFile(NamedTuple):
    """The soil that the simulator takes."""

    file: Path | None  #: that was written; None without ``--out``
    fit: PlainFit  #: of the simulator's law to trials that roll nearly straight, with the friction of the last law
    misfit: Misfit  #: of that law on those trials


@dataclass(frozen=True, slots=True)
class WheelResult:
    """One wheel."""

    wheel: str  #: wheel, n_trials, n_settings: which, and how much of it
    n_trials: int
    n_settings: int
    load_range_n: tuple[float, float]  #: load_range_n, sinkage_range_m: smallest and largest mean of a trial
    sinkage_range_m: tuple[float, float]
    coupling: Coupling  #: of the testbed, by which the measured traction is corrected; its trials are judged nowhere
    deeper_than_axle: int  #: number of trials whose sinkage is over the wheel's radius
    laws: tuple[LawRow, ...]  #: compared, in the order in which they were asked for
    law: str  #: the last one, whose figures follow
    parameters: Mapping[str, SoilParameter]  #: by name
    #: by_slip, by_angle: errors by the commanded wheel speed in mm/s, and the slip angle in degrees, left out
    by_slip: Mapping[float, Misfit]
    by_angle: Mapping[float, Misfit]
    regimes: Mapping[str, Misfit]  #: errors by regime, slips left out and load known
    #: cohesion, modulus: friction by cohesion, and the modulus of the soil as it seems from each trial
    cohesion: tuple[CohesionRow, ...]
    modulus: ModulusSpread
    #: surrogate_slip, surrogate_angle: errors of a polynomial of slip and angle, for reference
    surrogate_slip: Misfit
    surrogate_angle: Misfit
    #: errors of the last law, fitted to all trials, on those of ``--check``, by what is given; None without any
    checked: Mapping[str, Misfit] | None
    not_identified: tuple[str, ...]  #: a sentence for each thing that these trials cannot say
    soil: SoilFile  #: that was written for the simulator

    @property
    def verdict(self) -> str:
        """Whether the last law reaches what is aimed at, and where it stops, in words."""
        parts = []
        for held, found in (("slips", self.laws[-1].slip), ("angles", self.laws[-1].angle)):
            without = f"({found.below_axle_angle.forces} without the wheel dragged along its axle)"
            state = "reached" if found.reached else f"not reached {without}"
            parts.append(
                f"{held} left out, traction and side force off by {found.load.forces} of the load: {state}"
            )
        if self.checked is not None:
            load = self.checked["load"]
            parts.append(f"{load.n_trials} further trials: {load.forces}")
        return f"{self.wheel}: {100.0 * BAR_RATIO:.0f} % aimed at; {'; '.join(parts)}."


def compare_laws(
    trials: Trials,
    further: Trials | None,
    wheel: Wheel,
    laws: Sequence[str],
    draws: int,
    seed: int,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> tuple[WheelResult, Trials, dict[str, Prediction]]:
    """Compare laws on slips and on angles that their fits did not have, and report the last one in full.

    Parameters
    ----------
    trials : single ones of one wheel
    further : trials that the last law predicts, fitted to all of ``trials``; None without any
    wheel : of the trials
    laws : names of :data:`LAWS`, and ``simulator``
    draws, seed : of the bootstrap over settings
    progress : gets the task, how many fits are done, and how many there are

    Returns
    -------
    result
    trials
        with the traction corrected, without those that show the testbed's coupling
    predictions
        of these trials by the last law, by what was left out

    Raises
    ------
    DataError
        if there are too few settings to fit.
    """
    raw, coupling = trials, side_coupling(trials)
    trials = without_coupling(trials, coupling)
    straight = np.abs(trials.angle_setting) < AXLE_ANGLE_DEG
    n_folds = sum(len(np.unique(getattr(trials, name))) for name in HELD_OUT.values())
    fits, total = itertools.count(1), n_folds * (len(laws) + 1) + draws

    def count() -> None:
        progress(f"fit {wheel.name}", next(fits), total)

    def held_out(predictor: Predictor) -> dict[str, dict[str, Prediction]]:
        return {held: held_out_predictions(trials, predictor, held, count) for held in HELD_OUT}

    predictor: Predictor

    def by_simulator(training: Trials, tested: Trials) -> dict[str, Prediction]:
        found = plain_prediction(fit_plain_soil(training, wheel).soil, tested, wheel)
        return {
            "load": found,
            "sinkage": Prediction._make(np.full((4, tested.n), np.nan)),
        }  # it takes no sinkage

    def compared(name: str) -> Law:
        """Return a law, without the coupling among its parameters where the testbed's is known."""
        if math.isnan(coupling.ratio):
            return LAWS[name]
        return LAWS[name]._replace(free=tuple(each for each in LAWS[name].free if each != "coupling_ratio"))

    rows, predictions = [], {}
    for name in laws:
        text, n_parameters, predictor = SIMULATOR_TEXT, len(PARAMETERS), by_simulator
        if name != "simulator":
            law = compared(name)
            text, n_parameters = law.text, len(law.free) + len(SINKAGES[law.sinkage])
            predictor = law_predictor(law, wheel)
        predictions, errors = held_out(predictor), []
        for given in predictions.values():
            load = misfit(trials, given["load"])
            reached = max(load.pull_ratio, load.side_ratio) <= BAR_RATIO
            below = misfit(trials, given["load"], straight)
            errors.append(HeldOut(load, misfit(trials, given["sinkage"]), below, reached))
        rows.append(LawRow(name, text, n_parameters, *errors))
    law, means = compared(laws[-1]), setting_means(trials)
    reference, checked = held_out(polynomial_predictions), None
    fit = fit_law(law, means, wheel)
    if further is not None:
        further = without_coupling(further, coupling)
        checked = {given: misfit(further, predict(fit, further, given)) for given in GIVEN}
    parameters = parameters_of(fit, means, draws, seed, count)
    cohesion = tuple(cohesion_profile(law, means, wheel, COHESIONS_PA))
    modulus, angle_rad = modulus_spread(fit, trials), math.atan(parameters["tan_friction"].value)
    plain = fit_plain_soil(nearly_straight(means), wheel, angle_rad, draws, seed)
    rolling = nearly_straight(trials)
    slip, angle = (predictions[held]["load"] for held in HELD_OUT)
    by_setting = {
        held: {each: misfit(trials, last, own == each) for each in np.unique(own).tolist()}
        for (held, name), last in zip(HELD_OUT.items(), (slip, angle), strict=True)
        for own in [getattr(trials, name)]
    }
    result = WheelResult(
        wheel=wheel.name,
        n_trials=raw.n,
        n_settings=setting_means(raw).n,
        load_range_n=(float(raw.load_n.min()), float(raw.load_n.max())),
        sinkage_range_m=(float(raw.sinkage_m.min()), float(raw.sinkage_m.max())),
        coupling=coupling,
        deeper_than_axle=int((raw.sinkage_m > wheel.tip_radius_m).sum()),
        laws=tuple(rows),
        law=law.name,
        parameters=parameters,
        by_slip=by_setting["slip"],
        by_angle=by_setting["angle"],
        regimes=regime_misfits(trials, slip),
        cohesion=cohesion,
        modulus=modulus,
        surrogate_slip=misfit(trials, reference["slip"]["load"]),
        surrogate_angle=misfit(trials, reference["angle"]["load"]),
        checked=checked,
        not_identified=tuple(_not_identified(parameters, cohesion, modulus, coupling)),
        soil=SoilFile(None, plain, misfit(rolling, plain_prediction(plain.soil, rolling, wheel))),
    )
    return result, trials, {"slip": slip, "angle": angle}


def _not_identified(
    parameters: Mapping[str, SoilParameter],
    cohesion: Sequence[CohesionRow],
    modulus: ModulusSpread,
    coupling: Coupling,
) -> list[str]:
    unknown = [name for name, parameter in parameters.items() if not parameter.identified]
    first, last = cohesion[0], cohesion[-1]
    with_it, without = (math.degrees(row.friction_angle_rad) for row in (last, first))
    sentences = [
        f"Cohesion against friction: with {last.cohesion_pa:.0f} Pa in place of 0 the friction angle is "
        f"{with_it:.1f} in place of {without:.1f} degrees, and the sum of squares {2 * last.cost:.1f} in "
        f"place of {2 * first.cost:.1f}.",
        "kc, kphi and n: there is one wheel width and one dead weight. The pressure at a depth of one wheel "
        f"width that carries the measured load is {modulus.rolling_pa / 1e3:.0f} kPa when rolling straight "
        f"and {modulus.smallest_pa / 1e3:.1f} to {modulus.largest_pa / 1e3:.0f} kPa over nine tenths of all "
        "trials: it goes with how the wheel travels.",
        "How sinkage depends on the load: all trials have one dead weight, and their measured loads differ "
        "by what the guide takes, not by what was put on.",
    ]
    if math.isnan(coupling.ratio):
        sentences.append(
            "What the testbed adds to the traction of its side force: there are no trials of a locked wheel "
            "along its axle."
        )
    if unknown:
        sentences.append(f"Narrowed to no less than half of the prior, or at a bound: {', '.join(unknown)}.")
    return sentences
