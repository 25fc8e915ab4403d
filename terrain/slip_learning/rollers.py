r"""What makes an omni robot slip, from runs whose motion was measured from outside: rollers, load, scale, distance.

The steady law of :mod:`terrain.simulation.plants.planar` is fitted to the median motion of each run,
slip along the direction that the wheels roll and speed across it: the sharing of the load and the scale are
those of the robot, the friction of the rollers over traction is that of each surface.  Intervals are those of runs
left out in turn; what the law leaves is judged on every fifth run in turn, held out.  A group of runs that is not
fitted (with weights, say) is asked which sharing of the load would explain it, all else equal.

Wheels at the distance d from the robot's middle that roll :math:`\varphi_i` without slip turn the body by
:math:`\psi = \sum_i r \varphi_i / (3 d)`.  Over runs on one surface the slope of the turn measured from
outside over that of the described distance is :math:`(1 - s)\,d_0 / d`, with the slip s of turning, which a
robot that is commanded not to turn hardly shows.  Where s is not known, :math:`d_0` over the slope is the
distance of wheels that turn the body without slip: an upper bound, but for what else turns it.  Its interval is
that of draws of runs; how far surfaces differ says what else there is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.errors import DataError
from terrain.identify import Fit, Parameter, folds, identify
from terrain.records import Array
from terrain.robots import OmniRobot, Robot, as_drive
from terrain.simulation.plants.planar import steady_twist
from terrain.slip_learning.measured import Measured, MeasuredSlip, single_terrain

N_FOLDS = 5

MIN_RUNS = 10
"""Of a surface: two unknowns of the load, the scale and its own friction over several directions."""

_FREE = -7.0  #: Logarithm of a roller ratio that counts as none: 0.001


@dataclass(frozen=True, slots=True)
class RollerFindings:
    """What was found of an omni robot."""

    #: load_ratio, load_interval: share of the weight on each wheel, and the 95 % interval of each
    load_ratio: tuple[float, ...]
    load_interval: tuple[tuple[float, float], ...]
    #: scale_error, scale_interval: kappa: slip that is the same in all directions on all surfaces, an effective
    #: radius or a scale of the outside measurement
    scale_error: float
    scale_interval: tuple[float, float]
    #: roller_ratio, roller_interval: friction of the rollers over the stiffness of traction, by surface
    roller_ratio: Mapping[str, float]
    roller_interval: Mapping[str, tuple[float, float]]
    #: held_out_rms, plain_rms: of the slip of runs: left by the law on runs that were held out, and about the mean of
    #: the surface
    held_out_rms: Mapping[str, float]
    plain_rms: Mapping[str, float]
    other_surface: Mapping[str, str]  #: the surface that explains a group that was not fitted best, by name
    #: share of the weight on each wheel in groups that were not fitted, by name
    other_loads: Mapping[str, tuple[float, ...]]
    #: of their slip and sideways speed, with the load of the others and with their own, by name
    other_rms: Mapping[str, tuple[float, float]]

    @property
    def sentences(self) -> list[str]:
        """What of the slip is the robot's own, and what groups that were not fitted look like, in words."""
        loads = ", ".join(
            f"{load:.3f} ({low:.3f} to {high:.3f})"
            for load, (low, high) in zip(self.load_ratio, self.load_interval, strict=True)
        )
        low, high = self.scale_interval
        found = [
            f"Load of the wheels: {loads}.",
            f"Slip alike in all directions on all surfaces: {self.scale_error:.3f} ({low:.3f} to {high:.3f}); "
            "the wheels' radius or the scale of the outside measurement, which these runs do not distinguish.",
        ]
        for name, other in self.other_loads.items():
            before, after = self.other_rms[name]
            found.append(
                f"{name}: the surface is {self.other_surface[name]}, the load of the wheels "
                f"{', '.join(f'{load:.3f}' for load in other)}, by which {before:.4f} of RMS falls to {after:.4f}."
            )
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Cases:
    """Median wheel speeds (n, wheels), slip and sideways speed (n,) of runs, and the group of each."""

    wheel_speed_mps: Array
    slip: Array
    side: Array
    group: Array

    def at(self, rows: Array) -> _Cases:
        return _Cases(self.wheel_speed_mps[rows], self.slip[rows], self.side[rows], self.group[rows])


def roller_findings(
    runs: Sequence[MeasuredSlip], groups: Sequence[str], robot: Robot, surfaces: Sequence[str]
) -> RollerFindings:
    """Return what makes a robot on three omni wheels slip.

    Parameters
    ----------
    runs : measured
    groups : name of the surface of each run, or of another group
    robot : whose runs they are
    surfaces : names of the groups that are fitted; the others are asked for their load

    Raises
    ------
    DataError
        if a surface has fewer than :data:`MIN_RUNS` runs, or none is fitted.
    """
    cases = _cases(runs, groups)
    names = list(surfaces)
    for name in names:
        if (n := int((cases.group == name).sum())) < MIN_RUNS:
            raise DataError(f"surface {name!r} has {n} runs in steady motion; {MIN_RUNS} are needed")
    if not names:
        raise DataError("no surface is named whose runs could be fitted")
    fitted = cases.at(np.flatnonzero(np.isin(cases.group, names)))
    law = _Law(robot, names)
    fit = law.fit(fitted, np.arange(len(fitted.slip)))
    fold, left = np.empty(len(fitted.slip), int), np.empty(len(fitted.slip))
    places = [np.flatnonzero(fitted.group == name) for name in names]
    for rows in places:
        fold[rows] = np.arange(len(rows)) % N_FOLDS
    for train, test in folds(fold):
        part = law.fit(fitted.at(train)).value
        left[test] = law.motion(fitted.at(test), part)[0] - fitted.slip[test]
    loads, load_interval = fit.derived(law.loads)
    ratios, ratio_interval = fit.derived(lambda values: np.exp(values[3:]))
    intervals = [(max(low, 0.0), high) for low, high in ratio_interval.T.tolist()]
    others = [name for name in dict.fromkeys(cases.group.tolist()) if name not in names]
    found = {
        name: law.other_load(cases.at(np.flatnonzero(cases.group == name)), fit.value) for name in others
    }
    named = {name: each for name, each in found.items() if each is not None}
    low, high = fit.interval[:, 2].tolist()
    return RollerFindings(
        load_ratio=tuple(loads.tolist()),
        load_interval=tuple((low, high) for low, high in load_interval.T.tolist()),
        scale_error=float(fit.value[2]),
        scale_interval=(low, high),
        roller_ratio=dict(zip(names, ratios.tolist(), strict=True)),
        roller_interval=dict(zip(names, intervals, strict=True)),
        held_out_rms={name: _rms(left[rows]) for name, rows in zip(names, places, strict=True)},
        plain_rms={name: float(fitted.slip[rows].std()) for name, rows in zip(names, places, strict=True)},
        other_surface={name: surface for name, (surface, _, _) in named.items()},
        other_loads={name: loads for name, (_, loads, _) in named.items()},
        other_rms={name: rms for name, (_, _, rms) in named.items()},
    )


def surface_of_windows(slip: MeasuredSlip, found: RollerFindings, robot: Robot) -> list[str]:
    """Return the surface whose rollers explain each window of a run best; empty where it is not steady."""
    names = list(found.roller_ratio)
    rows = np.flatnonzero(slip.steady & np.isfinite(slip.body_slip) & np.isfinite(slip.body_side))
    windows = _Cases(
        slip.wheel_speed_mps[rows], slip.body_slip[rows], slip.body_side[rows], np.full(len(rows), "")
    )
    law, load = _Law(robot, names), found.load_ratio
    rho = np.log(np.maximum([found.roller_ratio[name] for name in names], 1e-6))
    parameters = np.concatenate([[load[0] / load[1], load[2] / load[1], found.scale_error], rho])
    off = np.empty((len(names), len(rows)))
    for i, name in enumerate(names):
        of_slip, side = law.motion(windows, parameters, name)
        off[i] = np.hypot(of_slip - windows.slip, side - windows.side)
    named = [""] * len(slip.steady)
    for row, best in zip(rows.tolist(), off.argmin(axis=0).tolist(), strict=True):
        named[row] = names[best]
    return named


class _Law:
    """The law with its parameters: loads of the first and last wheel over the second, kappa, log rho."""

    def __init__(self, robot: Robot, surfaces: Sequence[str]) -> None:
        self.robot, self.surfaces = robot, list(surfaces)
        loads = [Parameter(f"load_{i}_ratio", 1.0, 0.05, 20.0) for i in (1, 3)]
        rollers = [Parameter(f"log_roller_{name}_ratio", -1.0, _FREE, 3.0) for name in surfaces]
        self.parameters = [*loads, Parameter("scale_ratio", 0.03, -0.3, 0.6), *rollers]

    def loads(self, parameters: Array) -> Array:
        share = np.array([parameters[0], 1.0, parameters[1]])
        return np.asarray(share / share.sum())

    def motion(self, cases: _Cases, parameters: Array, group: str = "") -> tuple[Array, Array]:
        """Return the slip (n,) and sideways speed (n,) of the law."""
        slip, side = np.empty(len(cases.slip)), np.empty(len(cases.slip))
        for i, name in enumerate(self.surfaces):
            rows = np.flatnonzero(cases.group == name) if not group else np.arange(len(slip))
            if group and name != group:
                continue
            speeds = cases.wheel_speed_mps[rows]
            place = self.robot.wheel_positions_m, self.robot.wheel_directions_rad
            rho = float(np.exp(parameters[3 + i]))
            twist = steady_twist(speeds, *place, self.loads(parameters), rho, float(parameters[2]))
            free = steady_twist(speeds, *place, np.full(3, 1 / 3), 0.0)
            speed = np.linalg.norm(free[:, :2], axis=1)
            ahead = free[:, :2] / speed[:, None]
            slip[rows] = 1.0 - (twist[:, :2] * ahead).sum(axis=1) / speed
            side[rows] = (ahead[:, 0] * twist[:, 1] - ahead[:, 1] * twist[:, 0]) / speed
        return slip, side

    def misfit(self, cases: _Cases, group: str, parameters: Array) -> Array:
        """Return what the law leaves (n, 2) of slip and sideways speed."""
        slip, side = self.motion(cases, parameters, group)
        return np.column_stack([slip - cases.slip, side - cases.side])

    def fit(self, cases: _Cases, clusters: Array | None = None) -> Fit:
        return identify(partial(self.misfit, cases, ""), self.parameters, clusters)

    def other_load(
        self, cases: _Cases, best: Array
    ) -> tuple[str, tuple[float, ...], tuple[float, float]] | None:
        """Return the surface that explains runs best, the load that does so on it, and what is left."""
        if len(cases.slip) < MIN_RUNS:
            return None
        before = {name: _rms(self.misfit(cases, name, best)) for name in self.surfaces}
        surface = min(before, key=before.__getitem__)
        found = identify(
            lambda loads: self.misfit(cases, surface, np.concatenate([loads, best[2:]])),
            self.parameters[:2],
            starts=[best[:2]],
        )
        return surface, tuple(self.loads(found.value).tolist()), (before[surface], _rms(found.residual))


def _cases(runs: Sequence[MeasuredSlip], groups: Sequence[str]) -> _Cases:
    speeds, slips, sides, names = [], [], [], []
    for run, group in zip(runs, groups, strict=True):
        rows = run.steady & np.isfinite(run.body_slip)
        if rows.any():
            speeds.append(np.median(run.wheel_speed_mps[rows], axis=0))
            slips.append(float(np.median(run.body_slip[rows])))
            sides.append(float(np.median(run.body_side[rows])))
            names.append(group)
    return _Cases(np.array(speeds).reshape(len(names), -1), np.array(slips), np.array(sides), np.array(names))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


MIN_CORRELATION = 0.8
"""Of the turns of runs; below, something else turns the robot, as sliding over soft ground."""

N_DISTANCE_DRAWS = 1000


class DistanceBound(NamedTuple):
    """Distance of wheels that turn without slip, its 95 % interval over runs, and how well turns agree."""

    distance_m: float
    interval_m: tuple[float, float]
    correlation: float
    n_runs: int

    @property
    def sentence(self) -> str:
        """The distance, in words."""
        low_m, high_m = self.interval_m
        return (
            f"turns are those of wheels {self.distance_m:.4f} m from the middle that turn without slip "
            f"({low_m:.4f} to {high_m:.4f}, {self.n_runs} runs)."
        )


def distance_bound(
    runs: Sequence[MeasuredSlip], robot: OmniRobot, rng: np.random.Generator
) -> DistanceBound | None:
    """Return the bound that runs on one surface give; None where their turns do not follow the wheels."""
    turns = []
    for run in runs:
        known = np.isfinite(run.twist[:, 2]) & np.isfinite(run.rolled_twist[:, 2])
        if known.any():
            turns.append((run.rolled_twist[known, 2].mean(), run.twist[known, 2].mean()))
    if len(turns) < 3:
        return None
    rolled, seen = np.array(turns).T
    spread = float(np.sqrt((rolled @ rolled) * (seen @ seen)))
    correlation = float(rolled @ seen) / spread if spread > 0.0 else 0.0
    if correlation < MIN_CORRELATION:
        return None
    rows = bootstrap_rows(len(turns), N_DISTANCE_DRAWS, rng)
    described_m = robot.wheel_distance_m
    draws = described_m * (rolled[rows] ** 2).sum(axis=1) / (rolled[rows] * seen[rows]).sum(axis=1)
    found_m = described_m * float(rolled @ rolled) / float(rolled @ seen)
    return DistanceBound(found_m, percentile_interval(draws), correlation, len(turns))


NO_ROLLERS = "robot {name}: drive {drive!r} has no rollers, only 'omni' has"


def rollers_of(found: Measured, robot: Robot) -> RollerFindings:
    """Return what makes an omni robot slip; sessions are groups that are asked for their load."""
    known = [i for i, run in enumerate(found.runs) if single_terrain(run)]
    groups = [found.runs[i].session or single_terrain(found.runs[i]) for i in known]
    surfaces = sorted({single_terrain(found.runs[i]) for i in known if not found.runs[i].session})
    return roller_findings([found.slips[i] for i in known], groups, robot, surfaces)


def named_surfaces(found: Measured, robot: Robot, rollers: RollerFindings) -> tuple[NamedSurface, ...]:
    """Return which surface rollers name in the windows of each group, runs without a label by session."""
    windows: dict[str, Counter[str]] = {}
    right: dict[str, list[bool]] = {}
    for run, slip in zip(found.runs, found.slips, strict=True):
        names = [name for name in surface_of_windows(slip, rollers, robot) if name]
        if not names:
            continue
        group = run.session or single_terrain(run)
        windows.setdefault(group, Counter()).update(names)
        if single_terrain(run) in rollers.roller_ratio:
            right.setdefault(group, []).append(Counter(names).most_common(1)[0][0] == single_terrain(run))
    rows = []
    for group, counts in sorted(windows.items()):
        judged = right.get(group)
        n_right = sum(judged) if judged else None
        n_runs = (
            len(judged)
            if judged
            else sum((run.session or single_terrain(run)) == group for run in found.runs)
        )
        rows.append(NamedSurface(group, n_runs, n_right, dict(sorted(counts.items()))))
    return tuple(rows)


def distances_of(found: Measured, robot: Robot, seed: int) -> dict[str, DistanceBound]:
    """Return the distance of the wheels by each surface on which the robot's turns follow them."""
    omni, bounds = as_drive(OmniRobot, robot, NO_ROLLERS), {}
    alone = [pair for pair in zip(found.runs, found.slips, strict=True) if not pair[0].session]
    for name in sorted({single_terrain(run) for run, _ in alone} - {""}):
        slips = [slip for run, slip in alone if single_terrain(run) == name]
        bound = distance_bound(slips, omni, np.random.default_rng(seed))
        if bound is not None:
            bounds[name] = bound
    return bounds


class NamedSurface(NamedTuple):
    """Which surface the rollers of an omni robot say that runs of a group were on."""

    group: str  #: surface or, of runs that were not fitted, session
    n_runs: int  #: of the group; where ``n_right`` is known those with a label of a fitted surface
    n_right: int | None  #: whose windows are mostly named as their label; None without such labels
    windows: Mapping[str, int]  #: by the surface that they are named

    @property
    def text(self) -> str:
        """How many runs are named rightly or, without labels, what windows look like, in words."""
        if self.n_right is not None:
            return f"{self.n_right} of {self.n_runs} runs are named by their slip"
        counts = ", ".join(f"{name} {n}" for name, n in sorted(self.windows.items(), key=lambda x: -x[1]))
        return f"windows of {self.n_runs} runs look like {counts}"
