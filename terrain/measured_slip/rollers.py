"""What makes an omni robot slip, from runs whose motion was measured from outside: rollers, load, scale.

The steady law of :mod:`terrain.simulation.planar.omni_contact` is fitted to the median motion of each run,
slip along the direction that the wheels roll and speed across it: the sharing of the load and the scale are
those of the robot, the friction of the rollers over traction is that of each surface.  Intervals are of draws
of runs; what the law leaves is judged on every fifth run in turn, held out.  A group of runs that is not
fitted (with weights, say) is asked which sharing of the load would explain it, all else equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.errors import DataError
from terrain.measured_slip.slips import MeasuredSlip
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.planar.omni_contact import steady_twist

N_FOLDS = 5
N_DRAWS = 100

MIN_RUNS = 10
"""Of a surface: two unknowns of the load, the scale and its own friction over several directions."""

_FREE = -7.0
"""Logarithm of a roller ratio that counts as none: 0.001."""


@dataclass(frozen=True, slots=True)
class RollerFindings:
    """What was found of an omni robot.

    Parameters
    ----------
    load_ratio, load_interval : share of the weight on each wheel, and the 95 % interval of each
    scale_error, scale_interval : kappa: slip that is the same in all directions on all surfaces, an effective
        radius or a scale of the outside measurement
    roller_ratio, roller_interval : friction of the rollers over the stiffness of traction, by surface
    held_out_rms, plain_rms : of the slip of runs: left by the law on runs that were held out, and about the
        mean of the surface
    other_surface : the surface that explains a group that was not fitted best, by name
    other_loads : share of the weight on each wheel in groups that were not fitted, by name
    other_rms : of their slip and sideways speed, with the load of the others and with their own, by name
    """

    load_ratio: tuple[float, ...]
    load_interval: tuple[tuple[float, float], ...]
    scale_error: float
    scale_interval: tuple[float, float]
    roller_ratio: Mapping[str, float]
    roller_interval: Mapping[str, tuple[float, float]]
    held_out_rms: Mapping[str, float]
    plain_rms: Mapping[str, float]
    other_surface: Mapping[str, str]
    other_loads: Mapping[str, tuple[float, ...]]
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
    runs: Sequence[MeasuredSlip], groups: Sequence[str], robot: Robot, surfaces: Sequence[str], seed: int = 0
) -> RollerFindings:
    """Return what makes a robot on three omni wheels slip.

    Parameters
    ----------
    runs : measured
    groups : name of the surface of each run, or of another group
    robot : whose runs they are
    surfaces : names of the groups that are fitted; the others are asked for their load
    seed : of the draws

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
    best = law.fit(fitted, law.start())
    rng = np.random.default_rng(seed)
    places = [np.flatnonzero(fitted.group == name) for name in names]
    draws = np.array([law.fit(fitted.at(_drawn(places, rng)), best) for _ in range(N_DRAWS)])
    fold = np.concatenate([np.arange(len(rows)) % N_FOLDS for rows in places])
    order = np.concatenate(places)
    left = np.full(len(fitted.slip), np.nan)
    for number in range(N_FOLDS):
        test = order[fold == number]
        part = law.fit(fitted.at(order[fold != number]), best)
        left[test] = law.motion(fitted.at(test), part)[0] - fitted.slip[test]
    loads = np.array([law.loads(draw) for draw in draws])
    others = [name for name in dict.fromkeys(cases.group.tolist()) if name not in names]
    found = {
        name: each
        for name in others
        if (each := _other_load(law, cases.at(np.flatnonzero(cases.group == name)), best)) is not None
    }
    return RollerFindings(
        load_ratio=tuple(law.loads(best).tolist()),
        load_interval=tuple(percentile_interval(column) for column in loads.T),
        scale_error=float(best[2]),
        scale_interval=percentile_interval(draws[:, 2]),
        roller_ratio={name: float(np.exp(best[3 + i])) for i, name in enumerate(names)},
        roller_interval={name: percentile_interval(np.exp(draws[:, 3 + i])) for i, name in enumerate(names)},
        held_out_rms={name: _rms(left[rows]) for name, rows in zip(names, places, strict=True)},
        plain_rms={name: float(fitted.slip[rows].std()) for name, rows in zip(names, places, strict=True)},
        other_surface={name: surface for name, (surface, _, _) in found.items()},
        other_loads={name: loads for name, (_, loads, _) in found.items()},
        other_rms={name: rms for name, (_, _, rms) in found.items()},
    )


def surface_of_windows(slip: MeasuredSlip, found: RollerFindings, robot: Robot) -> list[str]:
    """Return the surface whose rollers explain each window of a run best; empty where it is not steady.

    Parameters
    ----------
    slip : of the run, which may cross from one surface to another
    found : of runs on one surface each, of the robot with the same load
    robot : whose runs they are
    """
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


def _drawn(places: Sequence[Array], rng: np.random.Generator) -> Array:
    """Return rows of runs drawn with replacement, as many of each surface as it has."""
    return np.concatenate([rows[bootstrap_rows(len(rows), 1, rng)[0]] for rows in places])


class _Law:
    """The law with its parameters: loads of the first and last wheel over the second, kappa, log rho."""

    def __init__(self, robot: Robot, surfaces: Sequence[str]) -> None:
        self.robot, self.surfaces = robot, list(surfaces)

    def start(self) -> Array:
        return np.concatenate([[1.0, 1.0, 0.03], np.full(len(self.surfaces), -1.0)])

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

    def fit(self, cases: _Cases, start: Array) -> Array:
        def misfit(parameters: Array) -> Array:
            slip, side = self.motion(cases, parameters)
            return np.concatenate([slip - cases.slip, side - cases.side])

        low = np.concatenate([[0.05, 0.05, -0.3], np.full(len(self.surfaces), _FREE)])
        high = np.concatenate([[20.0, 20.0, 0.6], np.full(len(self.surfaces), 3.0)])
        return np.asarray(
            least_squares(misfit, np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high)).x
        )


def _other_load(
    law: _Law, cases: _Cases, best: Array
) -> tuple[str, tuple[float, ...], tuple[float, float]] | None:
    """Return the surface that explains runs best, the load that does so on it, and what is left."""
    if len(cases.slip) < MIN_RUNS:
        return None

    def misfit(loads: Array, surface: str) -> Array:
        slip, side = law.motion(cases, np.concatenate([loads, best[2:]]), surface)
        return np.concatenate([slip - cases.slip, side - cases.side])

    surface = min(law.surfaces, key=lambda name: _rms(misfit(best[:2], name)))
    found = least_squares(misfit, best[:2], args=(surface,), bounds=(0.05, 20.0))
    rms = _rms(misfit(best[:2], surface)), _rms(found.fun)
    return surface, tuple(law.loads(found.x).tolist()), rms


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
