"""Terrain and target slip of any robot with a model, from samples as they come."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np

from pipelines.live.chain import Chain, Step
from pipelines.live.classifying import Classifier, WindowOutput
from pipelines.live.model import TerrainModel
from pipelines.live.windows import live_estimator, needs_filter
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import SWITCHING, SwitchSettings, TerrainBelief, check_switching, drive_on
from terrain.errors import ConfigError
from terrain.estimation.clocks import ClockWatch, last_stamp_s
from terrain.estimation.live import LiveEstimate
from terrain.estimation.live import live_estimator as suitable_estimator
from terrain.extension import correct_live
from terrain.kinematics.logged_wheels import speed_columns
from terrain.records import Reading, Sample
from terrain.robots import Robot

LONGEST_STEP_S = 1.0  #: A longer time between two samples of the wheels is no driving time

_NO_TWIST = np.zeros(3)


class Observer(Chain):
    """The terrain under a robot and its target slips, from its samples.

    Parameters
    ----------
    model : that classifies, or a fitted classifier, whose ``model_`` is one
    table : of target slips; the packaged one by default
    robot : its description; needed where the model uses what a filter estimates, or wheel speeds that are
        computed from motor rates
    channels : of each stream, in the order of the columns of its samples; by default those that the first
        samples name (:func:`terrain.logs.replay.replay`), or those of the model
    thread : that classifies windows; at once by default
    switching : when a class is accepted as the terrain (:attr:`belief`)

    Raises
    ------
    DataError
        if the model needs a channel that is neither measured nor estimated.
    ConfigError
        if the table is another robot's, or a setting is not accepted.

    Notes
    -----
    Fed with a log in order of time, it gives the windows and probabilities that ``terrain predict`` gives for
    it.  Whatever arrives, :meth:`update` does not raise, but for a model that does not suit the channels that
    the first samples name.
    """

    name = "observer"
    source: Classifier
    _clocks: ClockWatch

    def __init__(
        self,
        model: TerrainModel | Any,
        table: SlipTable | None = None,
        robot: Robot | None = None,
        channels: Mapping[str, Sequence[str]] | None = None,
        *,
        thread: ThreadPoolExecutor | None = None,
        switching: SwitchSettings = SWITCHING,
    ) -> None:
        check_switching(switching)
        model = getattr(model, "model_", model)
        table = load_slip_table() if table is None else table
        super().__init__("" if robot is None else robot.name, table, switching, ClockWatch())
        self._robot, self._thread = robot, thread
        self._takes_names = channels is None
        self._set_up(model, channels or model.info.channels)
        self._speed_mps, self._speed_s, self._now_s = math.inf, -math.inf, math.nan

    def _set_up(self, model: TerrainModel, channels: Mapping[str, Sequence[str]]) -> None:
        """Take samples with these columns from now on."""
        self.channels = {stream: tuple(names) for stream, names in channels.items()}
        self._filter, corrected = None, self._robot
        if self._robot is not None:
            self._filter, corrected = live_estimator(model.info, self._robot, self.channels)
            if self._filter is None:  # the model does without: for slip and motion alone
                driven, correction = correct_live(self._robot)
                with suppress(ConfigError):
                    self._filter = suitable_estimator(driven, self.channels, correction)
        self._is_needed = self._filter is not None and needs_filter(model.info, self.channels)
        name = self._filter.name if self._filter is not None and self._is_needed else ""
        self.source = Classifier(model, self._robot, self._thread, self.channels, name)
        self._speed_columns, self._mps_per_unit = speed_columns(self.channels.get("wheels", ()), corrected)

    @property
    def model(self) -> TerrainModel:
        """The model that classifies."""
        assert self.source.model is not None
        return self.source.model

    def take(self, sample: Sample) -> Step:
        """Take a sample, as a chain does: no command is given."""
        return Step(self.update(sample.readings, sample.time_s))

    def update(self, samples: Mapping[str, Reading], now_s: float = math.nan) -> Sequence[WindowOutput]:
        """Take what was measured since the last call; return the windows that are whole, in most calls none.

        Where the clock of the stamps was set, windows begin anew.

        Parameters
        ----------
        samples : by stream, stamps ``(k,)`` and values ``(k, channels)`` in order of time
        now_s : on the clock of the stamps; by default the newest one.  With it, a terrain becomes unknown in
            time where no more samples come
        """
        if not isinstance(samples, Mapping):
            return []
        if self._takes_names:
            self._takes_names = False
            if named := getattr(samples, "channels", None):
                self._set_up(self.model, named)
        estimates: Sequence[LiveEstimate] = ()
        if self._filter is not None:
            found = self._filter.step(samples)
            estimates = found if self._is_needed else ()
            self.estimate = self._filter.latest
        if self._clocks.was_set(samples):  # what was believed stays, and its outputs begin anew
            self.source.restart()
            self.belief = TerrainBelief(self.belief.terrain, self.belief.probability)
            self._speed_s, self._now_s = -math.inf, math.nan
        self._drive_on(samples, now_s)
        self._believe(Sample(now_s, _NO_TWIST, samples), estimates)
        return self.source.outputs

    def _drive_on(self, samples: Mapping[str, Reading], now_s: float) -> None:
        """Let the belief age by the time in which the wheels turned, or were not seen to stand."""
        stamps = [stamp_s for stream in samples if math.isfinite(stamp_s := last_stamp_s(samples, stream))]
        newest_s = max(stamps, default=math.nan)
        if "wheels" in samples and self._speed_columns:
            self._speed_mps, self._speed_s = (
                math.inf,
                newest_s,
            )  # of the fastest wheel; infinite where it is unknown
            with suppress(TypeError, ValueError, LookupError, AttributeError, OverflowError):
                speeds = np.abs(np.asarray(samples["wheels"].values, dtype=float)[-1, self._speed_columns])
                if not np.isnan(speeds).all():
                    self._speed_mps = float(np.nanmax(speeds)) * self._mps_per_unit
        if math.isnan(now_s):
            now_s = newest_s
        dt_s = now_s - self._now_s
        if not math.isnan(now_s):
            self._now_s = now_s
        if dt_s > 0.0:  # False for NaN
            seen = now_s - self._speed_s <= LONGEST_STEP_S
            self.belief = drive_on(self.belief, self._speed_mps if seen else math.inf, dt_s, self.switching)
