"""Terrain and target slip of any robot with a model, from samples as they come."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipelines.live.clock_watch import ClockWatch, last_stamp_s
from pipelines.live.pilot_settings import check_table
from pipelines.live.state import LiveState, Restorable, restorable, state_of
from pipelines.models.model_files import TerrainModel
from pipelines.streaming.classifying import AtOnce, Classifying, Part, WindowOutput
from pipelines.streaming.estimator import live_estimator
from pipelines.streaming.over_time import ground_filter, without_dwell
from pipelines.streaming.window_feed import Estimate, WindowFeed, live_filter, needs_filter
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import (
    NO_BELIEF,
    SWITCHING,
    SwitchSettings,
    TerrainBelief,
    check_switching,
    drive_on,
    update,
)
from terrain.errors import DataError
from terrain.records import Reading, SlipTarget
from terrain.robots import Robot

LONGEST_STEP_S = 1.0
"""A longer time between two samples of the wheels is no driving time."""


class TerrainObservation(NamedTuple):
    """What one window tells.

    Parameters
    ----------
    start_s, end_s : of the window, on the clock of the samples
    terrain, probability : class of the largest probability; empty and NaN where the model refused the window,
        empty where the window is like no terrain that was learned
    probabilities : of each class
    target : target slip of that terrain, by drive state
    refused : why there is no output; empty where there is one, also of a terrain that was never learned
    output : of the model
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    probabilities: Mapping[str, float]
    target: Mapping[str, SlipTarget]
    refused: str
    output: WindowOutput


class TerrainObserver:
    """The terrain under a robot and its target slips, from its samples.

    Parameters
    ----------
    model : that classifies
    table : of target slips; the packaged one by default
    robot : its description; needed where the model uses what a filter estimates, or wheel speeds that are
        computed from motor rates
    channels : of each stream, in the order of the columns of its samples; those of the model by default
    classifying : where windows are classified; at once by default
    switching : when a class is accepted as the terrain (:attr:`belief`)

    Attributes
    ----------
    refused : number of windows that the model refused, by message

    Raises
    ------
    DataError
        if the model needs a channel that is neither measured nor estimated.
    ConfigError
        if the table is another robot's, or a setting is not accepted.

    Notes
    -----
    Fed with a log in order of time, it gives the windows and probabilities that
    :func:`pipelines.classify.predict.predict` gives for it.  Whatever arrives, :meth:`update` does not raise.
    """

    def __init__(
        self,
        model: TerrainModel,
        table: SlipTable | None = None,
        robot: Robot | None = None,
        channels: Mapping[str, Sequence[str]] | None = None,
        *,
        classifying: Classifying | None = None,
        switching: SwitchSettings = SWITCHING,
    ) -> None:
        self.table = load_slip_table() if table is None else table
        if robot is not None:
            check_table(self.table, robot.name)
        check_switching(switching)
        self.model, self.switching = model, switching
        self.channels = {stream: tuple(names) for stream, names in (channels or model.info.channels).items()}
        self._filter = None
        corrected = robot
        if robot is not None:
            self._filter, corrected = live_estimator(model.info, robot, self.channels)
        self._robot_name = "" if robot is None else robot.name
        self._filter_name = "" if self._filter is None else self._filter.name
        self._robot = corrected
        self._feed = WindowFeed(model.info, self.channels, corrected)
        self._classifying: Classifying = AtOnce() if classifying is None else classifying
        self._classifying.begin(Part(model, self._feed))
        self._speed_columns, self._mps_per_unit = _speeds(self.channels.get("wheels", ()), corrected)
        self._latest: Estimate | None = None
        self._speed_mps, self._speed_s, self._now_s = math.inf, -math.inf, math.nan
        self._watch = ClockWatch()
        self._over_time = ground_filter(model)
        self.belief: TerrainBelief = NO_BELIEF
        self.refused: Counter[str] = Counter()

    @property
    def estimate(self) -> Estimate | None:
        """Last estimate of the motion; None before the first, and where the model needs none."""
        return self._latest

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, as counts by kind."""
        counts = dict(self._classifying.dropped)
        counts |= {f"window: refused, {why}": n for why, n in self.refused.items()}
        counts |= {"time: clock set": n} if (n := self._watch.n_set) else {}
        return counts | (dict(self._filter.dropped) if self._filter is not None else {})

    def check(self, model: TerrainModel) -> None:
        """Raise what :meth:`swap` would."""
        if not self._feed.suits(model.info):
            WindowFeed(model.info, self.channels, self._robot)
            if needs_filter(model.info, self.channels) and (
                self._robot is None or live_filter(model.info, self._robot) != self._filter_name
            ):
                raise DataError(
                    f"the model was trained on estimates of the filter {model.info.filter!r}; "
                    f"{self._filter_name or 'none'!r} runs here"
                )

    def swap(self, model: TerrainModel, table: SlipTable) -> None:
        """Go on with another model and table, between two samples; the filter runs on.

        Where both take the same windows, the one that is being cut is the first of the new model; otherwise
        its windows begin with the next sample.

        Raises
        ------
        DataError
            if the model needs a channel that is neither measured nor estimated, or another filter.
        ConfigError
            if the table is another robot's.
        """
        self.check(model)
        if self._robot is not None:
            check_table(table, self._robot_name)
        self.table = table
        if not self._feed.suits(model.info):
            self._feed = WindowFeed(model.info, self.channels, self._robot)
        self.model, self._over_time = model, ground_filter(model)
        self._classifying.begin(Part(model, self._feed))

    def state(self, now_s: float) -> LiveState:
        """Return what is worth keeping over a restart, at a time in seconds since 1970."""
        resident = None if self._filter is None else self._filter.resident
        return state_of(self._robot_name, self._filter_name, resident, self.belief, math.nan, now_s)

    def restore(self, state: LiveState, now_s: float) -> Restorable:
        """Start from a saved state; return what of it is used.

        Raises
        ------
        DataError
            if the filter has run already.
        """
        fresh = restorable(state, self._robot_name, self._filter_name, now_s)
        if self._filter is not None and self._filter.resident is not None:
            self._filter.resident.begin_from(fresh.biases, fresh.age_s)
        self.belief = fresh.belief
        return fresh

    def update(self, samples: Mapping[str, Reading], now_s: float = math.nan) -> list[TerrainObservation]:
        """Take what was measured since the last call; return what has been found, in most calls nothing.

        Where the clock of the stamps was set, windows begin anew.

        Parameters
        ----------
        samples : by stream, stamps ``(k,)`` and values ``(k, channels)`` in order of time
        now_s : on the clock of the stamps; by default the newest one.  With it, a terrain becomes unknown in
            time where no more samples come
        """
        if not isinstance(samples, Mapping):
            return []
        estimates: Sequence[Estimate] = ()
        if self._filter is not None:
            estimates = self._filter.step(samples)
            if estimates:
                self._latest = estimates[-1]
        if self._watch.was_set(samples):
            self._begin_again()
        self._classifying.put(samples, estimates)
        self._drive_on(samples, now_s)
        return [self._observed(output) for output in self._classifying.finished()]

    def _observed(self, output: WindowOutput) -> TerrainObservation:
        if output.refused:
            self.refused[output.refused] += 1
        if self._over_time is not None:
            settings = without_dwell(self.switching)
            self.belief = update(self.belief, output.end_s, *self._over_time.take(output), settings)
        elif not output.refused:
            self.belief = update(
                self.belief, output.end_s, output.terrain, output.probability, self.switching
            )
        return TerrainObservation(
            output.start_s,
            output.end_s,
            output.terrain,
            output.probability,
            dict(zip(output.classes, output.probabilities.tolist(), strict=True)),
            self.table.lookup(output.terrain),
            output.refused,
            output,
        )

    def _begin_again(self) -> None:
        """Cut windows from here on; what was believed stays, and its outputs begin anew."""
        self._feed = WindowFeed(self.model.info, self.channels, self._robot)
        self._classifying.begin(Part(self.model, self._feed))
        self.belief = TerrainBelief(self.belief.terrain, self.belief.probability)
        self._over_time = ground_filter(self.model)
        self._speed_s, self._now_s = -math.inf, math.nan

    def _drive_on(self, samples: Mapping[str, Reading], now_s: float) -> None:
        """Let the belief age by the time in which the wheels turned, or were not seen to stand."""
        stamps = [stamp_s for stream in samples if math.isfinite(stamp_s := last_stamp_s(samples, stream))]
        newest_s = max(stamps, default=math.nan)
        if "wheels" in samples and self._speed_columns:
            self._speed_mps, self._speed_s = self._wheel_speed_mps(samples["wheels"]), newest_s
        if math.isnan(now_s):
            now_s = newest_s
        dt_s = now_s - self._now_s
        if not math.isnan(now_s):
            self._now_s = now_s
        if dt_s > 0.0:  # False for NaN
            seen = now_s - self._speed_s <= LONGEST_STEP_S
            self.belief = drive_on(self.belief, self._speed_mps if seen else math.inf, dt_s, self.switching)

    def _wheel_speed_mps(self, reading: Reading) -> float:
        """Return the speed of the fastest wheel; infinite where it is unknown."""
        try:
            speeds = np.abs(np.asarray(reading.values, dtype=float)[-1, self._speed_columns])
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError):
            return math.inf
        return math.inf if np.isnan(speeds).all() else float(np.nanmax(speeds)) * self._mps_per_unit


def _speeds(wheels: Sequence[str], robot: Robot | None) -> tuple[list[int], float]:
    """Return the columns that tell how fast the wheels turn, and what makes them speeds in m/s."""
    columns = [i for i, name in enumerate(wheels) if name.startswith("speed_")]
    if columns or robot is None or not robot.describes("motors"):
        return columns, 1.0
    motors = [i for i, name in enumerate(wheels) if name.startswith("motor_")]
    return motors, robot.wheel_radius_m / robot.motors.reduction_ratio
