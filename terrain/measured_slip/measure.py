"""Slip of many runs: the delay of each session taken off, and what an omni robot's rollers say of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.measured_slip.delay import estimate_delay
from terrain.measured_slip.rollers import (
    DistanceBound,
    RollerFindings,
    distance_bound,
    roller_findings,
    surface_of_windows,
)
from terrain.measured_slip.slips import MeasuredSlip, measured_slip
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, as_drive, robot_named
from terrain.signals import Delay, DelayStatus

WINDOWS_S = (2.0, 0.5)
"""Windows of steady motion; short ones where the outside measurement does not cover longer ones, as a lidar's
twist."""

NO_ROLLERS = "robot {name}: drive {drive!r} has no rollers, only 'omni' has"


class Measured(NamedTuple):
    """Runs beside their slip, the delays by session, and a sentence for each run without a slip."""

    runs: list[RunLog]
    slips: list[MeasuredSlip]
    delays: dict[str, Delay]
    failed: list[str]

    def by_terrain(self) -> dict[str, Measured]:
        """Return the runs of each single terrain, sorted by its name, with those on several or none last."""
        names = [single_terrain(run) for run in self.runs]
        found = {}
        for name in sorted(set(names), key=lambda name: (name == "", name)):
            own = [i for i, each in enumerate(names) if each == name]
            found[name] = self._replace(runs=[self.runs[i] for i in own], slips=[self.slips[i] for i in own])
        return found


class NamedSurface(NamedTuple):
    """Which surface the rollers of an omni robot say that runs of a group were on.

    Parameters
    ----------
    group : surface or, of runs that were not fitted, session
    n_runs : of the group; where ``n_right`` is known those with a label of a fitted surface
    n_right : whose windows are mostly named as their label; None without such labels
    windows : by the surface that they are named
    """

    group: str
    n_runs: int
    n_right: int | None
    windows: Mapping[str, int]

    @property
    def text(self) -> str:
        """How many runs are named rightly or, without labels, what windows look like, in words."""
        if self.n_right is not None:
            return f"{self.n_right} of {self.n_runs} runs are named by their slip"
        counts = ", ".join(f"{name} {n}" for name, n in sorted(self.windows.items(), key=lambda x: -x[1]))
        return f"windows of {self.n_runs} runs look like {counts}"


def one_robot(runs: Sequence[RunLog], given: Robot | None) -> Robot:
    """Return the robot of runs: the one that is given, where it has the name that they state.

    Raises
    ------
    DataError
        if they are of several.
    ConfigError
        if it is unknown.
    """
    names = sorted({run.robot for run in runs})
    if len(names) > 1:
        raise DataError(f"the runs are of the robots {', '.join(names)}: measure those of one at a time")
    return robot_named(names[0], given)


def measure(
    runs: Sequence[RunLog],
    robot: Robot,
    *,
    window_s: float,
    stride_s: float,
    delay_s: float | None = None,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> Measured:
    """Return the slip of each run, with the delay of its session taken off.

    Parameters
    ----------
    runs : of the robot
    window_s, stride_s : of the slips
    delay_s : of the outside measurement; found, a session at a time, by default
    seed : of the intervals of delays
    progress : gets the task, how many of its steps are done, and how many there are
    """
    delays: dict[str, Delay] = {}
    by_session: dict[str, list[RunLog]] = {}
    for run in runs:
        by_session.setdefault(run.session, []).append(run)
    for done, (session, members) in enumerate(sorted(by_session.items()), start=1):
        if delay_s is None:
            delays[session] = estimate_delay(members, robot, seed)
        else:
            delays[session] = Delay(delay_s, 0.0, len(members), DelayStatus.ESTIMATED)
        progress("delay", done, len(by_session))
    kept, slips, failed = [], [], []
    for done, run in enumerate(runs, start=1):
        late_s = delays[run.session].applied_s
        try:
            slips.append(measured_slip(run, robot, window_s=window_s, stride_s=stride_s, delay_s=late_s))
            kept.append(run)
        except DataError as error:
            failed.append(str(error))
        progress("slip", done, len(runs))
    return Measured(kept, slips, delays, failed)


def measure_steady(
    runs: Sequence[RunLog],
    robot: Robot,
    seed: int,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> tuple[float, Measured]:
    """Return slips over :data:`WINDOWS_S`, the first in which a robot drives steadily, and that length.

    Raises
    ------
    DataError
        if there is no slip in steady motion.
    """
    first = ""
    for window_s in WINDOWS_S:
        found = measure(runs, robot, window_s=window_s, stride_s=window_s / 2, seed=seed, progress=progress)
        if any(slip.known.size for slip in found.slips):
            return window_s, found
        first = first or (found.failed[0] if found.failed else "no window is driven steadily")
    raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {first}")


def rollers_of(found: Measured, robot: Robot, seed: int) -> RollerFindings:
    """Return what makes an omni robot slip; sessions are groups that are asked for their load."""
    known = [i for i, run in enumerate(found.runs) if single_terrain(run)]
    groups = [found.runs[i].session or single_terrain(found.runs[i]) for i in known]
    surfaces = sorted({single_terrain(found.runs[i]) for i in known if not found.runs[i].session})
    return roller_findings([found.slips[i] for i in known], groups, robot, surfaces, seed)


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


def single_terrain(run: RunLog) -> str:
    """Return the terrain that a run is labelled with; empty where it is on several or none."""
    return run.terrains[0] if len(run.terrains) == 1 else ""
