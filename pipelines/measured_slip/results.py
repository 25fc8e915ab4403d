"""Results of ``terrain measure-slip``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from terrain.measured_slip.delay import Delay
from terrain.measured_slip.rollers import RollerFindings
from terrain.measured_slip.surfaces import SurfaceSlip
from terrain.measured_slip.wheel_distance import DistanceBound


@dataclass(frozen=True, slots=True)
class PredictionFigures:
    """How well slip is predicted, without any measurement from outside.

    Parameters
    ----------
    held_out : what is on the other side of each split: ``runs``, ``regimes`` (speeds and directions), or
        the name of what was never trained on
    n_runs, n_windows : that were predicted
    rms, rms_interval : error of the slip of the body, and its 95 % interval over runs
    bias : mean error
    coverage : ratio of windows whose slip is inside the 95 % interval of its prediction
    width : median width of these intervals
    by_terrain : rms error on each terrain
    """

    held_out: str
    n_runs: int
    n_windows: int
    rms: float
    rms_interval: tuple[float, float]
    bias: float
    coverage: float
    width: float
    by_terrain: Mapping[str, float]


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


@dataclass(frozen=True, slots=True)
class MeasuredSlipResult:
    """Slip measured from outside.

    Parameters
    ----------
    robot : by name
    window_s, stride_s, seed : as set
    sources : runs by the stream that measured their motion from outside
    delays : of that behind the wheels, by session
    surfaces : by terrain, runs without a label last
    predictions : of slip from currents and wheel speeds; none unless asked for
    rollers : what makes an omni robot slip; None unless asked for
    named : surfaces that rollers name window by window, by group; none unless rollers are asked for
    distances : of the wheels of an omni robot, by surface, where its turns follow the wheels
    not_measured : a sentence for each run without a slip
    n_runs : that were read
    out : folder of the runs with their slip
    figures : files
    skipped : a sentence for each run that could not be read
    """

    robot: str
    window_s: float
    stride_s: float
    seed: int
    sources: Mapping[str, int]
    delays: Mapping[str, Delay]
    surfaces: tuple[SurfaceSlip, ...]
    predictions: tuple[PredictionFigures, ...]
    rollers: RollerFindings | None
    named: tuple[NamedSurface, ...]
    distances: Mapping[str, DistanceBound]
    not_measured: tuple[str, ...]
    n_runs: int
    out: Path | None
    figures: tuple[str, ...]
    skipped: tuple[str, ...]
