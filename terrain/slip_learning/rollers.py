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
from terrain.identify import Parameter, folds, identify
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Array
from terrain.robots import OmniRobot, Robot, as_drive
from terrain.signals import agreement
from terrain.slip_learning.measured import Measured, MeasuredSlip, single_terrain

N_FOLDS = 5

MIN_RUNS = 10
"""Of a surface: two unknowns of the load, the scale and its own friction over several directions."""

#: Loads of the first and last wheel over that of the second, and kappa.
ROBOT = (
    *(Parameter(f"load_{i}_ratio", 1.0, 0.05, 20.0) for i in (1, 3)),
    Parameter("scale_ratio", 0.03, -0.3, 0.6),
)
SURFACE = Parameter(
    "log_roller_ratio", -1.0, -7.0, 3.0
)  #: Of each surface; from 0.001, which counts as none.


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


def loads_of(values: Array) -> Array:
    """Return the share of the weight on each wheel (3,) by the parameters."""
    share = np.array([values[0], 1.0, values[1]])
    return np.asarray(share / share.sum())


def steady_twist(
    wheel_speed_mps: Array,
    positions_m: Array,
    direction_rad: Array,
    load_ratio: Array,
    roller_ratio: float,
    scale_error: float = 0.0,
) -> Array:
    """Return the twist (n, 3) of a body whose wheels turn at steady speeds (n, wheels).

    Parameters
    ----------
    wheel_speed_mps : (n, wheels) circumferential
    positions_m, direction_rad : (wheels, 2) and (wheels,) of the wheels
    load_ratio : (wheels,) shares of the weight, summing to 1
    roller_ratio : rho, friction of the rollers over the stiffness of traction; 0 is free
    scale_error : kappa

    Examples
    --------
    A wheel that rolls across entirely, and carries most of the weight, brakes the more:

    >>> from terrain.robots import load_robot
    >>> place = load_robot("robotino").wheel_positions_m, np.radians([150.0, 270.0, 390.0])
    >>> ahead, left, _ = 0.1 * rolling_matrix(*place).T
    >>> load = np.array([0.25, 0.5, 0.25])
    >>> steady_twist(np.array([ahead, left]), *place, load, 0.8)[:, :2].diagonal().round(4)
    array([0.0429, 0.0652])
    """
    along = rolling_matrix(positions_m, direction_rad)
    across = rolling_matrix(positions_m, np.asarray(direction_rad) + np.pi / 2)
    balance = (along * load_ratio[:, None]).T @ along
    balance = balance + roller_ratio * (across * load_ratio[:, None]).T @ across
    driven = np.asarray(wheel_speed_mps) @ (along * load_ratio[:, None])
    return np.asarray((1.0 - scale_error) * np.linalg.solve(balance, driven.T).T)


def law_motion(
    robot: Robot, wheel_speed_mps: Array, loads: Array, roller_ratio: float, kappa: float
) -> Array:
    """Return slip and sideways speed (n, 2) of the law at speeds (n, 3) of the wheels."""
    place = robot.wheel_positions_m, robot.wheel_directions_rad
    twist = steady_twist(wheel_speed_mps, *place, loads, roller_ratio, kappa)
    free = steady_twist(wheel_speed_mps, *place, np.full(3, 1 / 3), 0.0)
    speed = np.linalg.norm(free[:, :2], axis=1)
    ahead = free[:, :2] / speed[:, None]
    side = (ahead[:, 0] * twist[:, 1] - ahead[:, 1] * twist[:, 0]) / speed
    return np.column_stack([1.0 - (twist[:, :2] * ahead).sum(axis=1) / speed, side])


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
    chosen = [(run, group) for run, group in zip(runs, groups, strict=True) if run.known.size]
    speeds = np.array([np.median(run.wheel_speed_mps[run.known], axis=0) for run, _ in chosen])
    seen = np.array(
        [[np.median(run.body_slip[run.known]), np.median(run.body_side[run.known])] for run, _ in chosen]
    )
    group, names = np.array([group for _, group in chosen]), list(surfaces)
    for name in names:
        if (n := int((group == name).sum())) < MIN_RUNS:
            raise DataError(f"surface {name!r} has {n} runs in steady motion; {MIN_RUNS} are needed")
    if not names:
        raise DataError("no surface is named whose runs could be fitted")

    def misfit(rows: Array, values: Array, surface: str = "") -> Array:
        """Return what the law leaves of some runs (n, 2), on their own surfaces or all on one."""
        out = np.empty((len(rows), 2))
        for i, name in enumerate(names):
            own = (group[rows] == name) if not surface else np.full(len(rows), name == surface)
            law = loads_of(values), float(np.exp(values[3 + i])), float(values[2])
            out[own] = law_motion(robot, speeds[rows][own], *law) - seen[rows][own]
        return out

    parameters = [*ROBOT, *(SURFACE._replace(name=f"log_roller_{name}_ratio") for name in names)]
    fitted = np.flatnonzero(np.isin(group, names))
    fit = identify(partial(misfit, fitted), parameters, np.arange(len(fitted)))
    fold, left = np.zeros(len(group), int), np.empty(len(group))
    places = {name: np.flatnonzero(group == name) for name in dict.fromkeys(group.tolist())}
    for name in names:
        fold[places[name]] = np.arange(len(places[name])) % N_FOLDS
    for train, test in folds(fold[fitted]):
        part = identify(partial(misfit, fitted[train]), parameters).value
        left[fitted[test]] = misfit(fitted[test], part)[:, 0]

    def as_on(rows: Array, surface: str, two: Array) -> Array:
        return misfit(rows, np.concatenate([two, fit.value[2:]]), surface)

    loads, load_interval = fit.derived(loads_of)
    ratios, ratio_interval = fit.derived(lambda values: np.exp(values[3:]))
    other_surface: dict[str, str] = {}
    other_loads: dict[str, tuple[float, ...]] = {}
    other_rms: dict[str, tuple[float, float]] = {}
    for name, rows in places.items():
        if name in names or len(rows) < MIN_RUNS:
            continue
        before = {surface: _rms(misfit(rows, fit.value, surface)) for surface in names}
        other_surface[name] = surface = min(before, key=before.__getitem__)
        own = identify(partial(as_on, rows, surface), ROBOT[:2], starts=[fit.value[:2]])
        other_loads[name] = tuple(loads_of(own.value).tolist())
        other_rms[name] = before[surface], _rms(own.residual)
    low, high = fit.interval[:, 2].tolist()
    intervals = [(max(low, 0.0), high) for low, high in ratio_interval.T.tolist()]
    return RollerFindings(
        load_ratio=tuple(loads.tolist()),
        load_interval=tuple((low, high) for low, high in load_interval.T.tolist()),
        scale_error=float(fit.value[2]),
        scale_interval=(low, high),
        roller_ratio=dict(zip(names, ratios.tolist(), strict=True)),
        roller_interval=dict(zip(names, intervals, strict=True)),
        held_out_rms={name: _rms(left[places[name]]) for name in names},
        plain_rms={name: float(seen[places[name], 0].std()) for name in names},
        other_surface=other_surface,
        other_loads=other_loads,
        other_rms=other_rms,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def surface_of_windows(slip: MeasuredSlip, found: RollerFindings, robot: Robot) -> list[str]:
    """Return the surface whose rollers explain each window of a run best; empty where it is not steady."""
    named, rows = [""] * len(slip.steady), slip.known[np.isfinite(slip.body_side[slip.known])]
    seen = np.column_stack([slip.body_slip[rows], slip.body_side[rows]])
    loads, off = np.array(found.load_ratio), []
    for ratio in found.roller_ratio.values():
        motion = law_motion(robot, slip.wheel_speed_mps[rows], loads, max(ratio, 1e-6), found.scale_error)
        off.append(np.hypot(*(motion - seen).T))
    for row, best in zip(rows.tolist(), np.argmin(off, axis=0).tolist(), strict=True):
        named[row] = list(found.roller_ratio)[best]
    return named


MIN_CORRELATION = 0.8
"""Of the turns of runs; below, something else turns the robot, as sliding over soft ground."""

N_DISTANCE_DRAWS = 1000


class DistanceBound(NamedTuple):
    """Distance of wheels that turn without slip, its 95 % interval within one session, and how well turns agree."""

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
            f"({low_m:.4f} to {high_m:.4f} within one session, {self.n_runs} runs)."
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
    correlation = float(agreement(rolled[:, None], seen[:, None])[0][0])
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


def named_surfaces(found: Measured, robot: Robot, rollers: RollerFindings) -> tuple[NamedSurface, ...]:
    """Return which surface rollers name in the windows of each group, runs without a label by session."""
    windows: dict[str, Counter[str]] = {}
    runs: Counter[str] = Counter()
    right: dict[str, list[bool]] = {}
    for run, slip in zip(found.runs, found.slips, strict=True):
        label, names = single_terrain(run), Counter(surface_of_windows(slip, rollers, robot))
        group = run.session or label
        runs[group] += 1
        del names[""]
        if names:
            windows.setdefault(group, Counter()).update(names)
            if label in rollers.roller_ratio:
                right.setdefault(group, []).append(names.most_common(1)[0][0] == label)
    return tuple(
        NamedSurface(
            group,
            len(right[group]) if group in right else runs[group],
            sum(right[group]) if group in right else None,
            dict(sorted(counts.items())),
        )
        for group, counts in sorted(windows.items())
    )


def distances_of(found: Measured, robot: Robot, seed: int) -> dict[str, DistanceBound]:
    """Return the distance of the wheels by each surface on which the robot's turns follow them."""
    omni, bounds = as_drive(OmniRobot, robot, NO_ROLLERS), {}
    for name, own in found.by_terrain().items():
        slips = [slip for run, slip in zip(own.runs, own.slips, strict=True) if not run.session]
        bound = distance_bound(slips, omni, np.random.default_rng(seed))
        if name and bound is not None:
            bounds[name] = bound
    return bounds
