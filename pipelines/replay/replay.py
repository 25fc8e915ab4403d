"""``terrain replay``: runs sent through the live chain, at their own speed or as fast as it goes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from time import perf_counter, sleep
from typing import Protocol

import numpy as np

from features.windows import label_windows
from pipelines.data.settings import InspectSettings, load
from pipelines.live.chain import Chain
from pipelines.live.classifying import WindowOutput
from pipelines.live.over_time import filtered
from pipelines.models.model_files import TerrainModel
from pipelines.replay.chains import chain_of
from pipelines.replay.results import ObservedWindow, Replay, ReplayedRun, ReplayMoment
from pipelines.replay.settings import ReplaySettings
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.logs.replay import replay
from terrain.records import RunLog
from terrain.robots import Robot, load_robot

LONGEST_SLEEP_S = 0.2
"""The screen moves at least so often."""


class View(Protocol):
    """Watches a replay."""

    def moment(self, moment: ReplayMoment) -> None:
        """See where the replay is; called at each step."""
        ...

    def observed(self, run_id: str, window: ObservedWindow) -> None:
        """See a window."""
        ...


class NoView:
    """Watches nothing."""

    def moment(self, moment: ReplayMoment) -> None:
        """Do nothing."""

    def observed(self, run_id: str, window: ObservedWindow) -> None:
        """Do nothing."""


def replay_logs(
    source: InspectSettings,
    settings: ReplaySettings,
    view: View | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Replay:
    """Replay all runs of a log, one after the other; Ctrl-C ends it with what was found until then.

    Parameters
    ----------
    source, settings : logs, and how they are replayed
    view : watches it
    stopped : asked at each step whether it ends there

    Raises
    ------
    ConfigError, DataError, LogError, ModelError
        if the log, the model or the table cannot be read, or do not fit each other.
    """
    table = load_slip_table(settings.table)
    model = _model(settings.model, settings.filter_stride_s)
    runs, skipped = load(source)
    robot = None if source.robot is None else load_robot(source.robot)
    replayed: list[ReplayedRun] = []
    for run in runs:
        replayed.append(replay_run(run, model, table, settings, robot=robot, view=view, stopped=stopped))
        if replayed[-1].interrupted:
            break
    duration_s, elapsed_s = (
        sum(getattr(one, name) for one in replayed) for name in ("duration_s", "elapsed_s")
    )
    n_judged = sum(one.n_judged for one in replayed)
    n_right = sum(one.n_judged * (one.accuracy or 0.0) for one in replayed)
    return Replay(
        settings.model,
        table.name,
        tuple(replayed),
        sum(one.n_windows for one in replayed),
        n_right / n_judged if n_judged else None,
        n_judged,
        duration_s,
        elapsed_s,
        duration_s / elapsed_s if elapsed_s else math.nan,
        any(one.interrupted for one in replayed),
        tuple(skipped),
    )


def replay_run(
    run: RunLog,
    model: TerrainModel | None,
    table: SlipTable,
    settings: ReplaySettings,
    *,
    robot: Robot | None = None,
    view: View | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> ReplayedRun:
    """Send one run through the live chain of its robot.

    Raises
    ------
    ConfigError, DataError
        as :func:`pipelines.replay.chains.chain_of`.
    """
    chain = chain_of(run, model, table, robot)
    steps = _Steps(run, chain, settings, view or NoView(), stopped)
    begin_s = perf_counter()
    try:
        interrupted = not steps.run()
    except KeyboardInterrupt:
        interrupted = True
    elapsed_s = perf_counter() - begin_s
    classes = () if model is None else model.info.classes
    given = [window for window in steps.windows if not window.refused]
    judged = [window for window in given if window.label in classes]
    counts = Counter(window.terrain for window in given)
    return ReplayedRun(
        run.run_id,
        run.robot,
        chain.name,
        steps.passed_s,
        elapsed_s,
        steps.passed_s / elapsed_s if elapsed_s else math.nan,
        steps.believed.total(),
        len(steps.windows),
        len(steps.windows) - len(given),
        {terrain: n / len(given) for terrain, n in counts.most_common()},
        {terrain: n / steps.believed.total() for terrain, n in steps.believed.most_common()},
        float(np.mean([window.terrain == window.label for window in judged])) if judged else None,
        len(judged),
        dict(chain.dropped),
        interrupted,
        tuple(steps.windows),
    )


class _Steps:
    """The steps of one replay, and what they have given so far."""

    def __init__(
        self, run: RunLog, chain: Chain, settings: ReplaySettings, view: View, stopped: Callable[[], bool]
    ) -> None:
        self._run, self._chain, self._settings, self._view = run, chain, settings, view
        self._stopped = stopped
        self.windows: list[ObservedWindow] = []
        self.believed: Counter[str] = Counter()
        self.passed_s = 0.0

    def run(self) -> bool:
        """Take all steps, each when it is due; return whether all were taken."""
        run, view, chain = self._run, self._view, self._chain
        speed, wall_s, start_s = self._settings.speed_ratio, perf_counter(), math.nan
        end_s = max(stream.time_s[-1] for stream in run.streams.values())
        for sample in replay(run, self._settings.rate_hz):
            if self._stopped():
                return False
            if math.isnan(start_s):
                start_s = sample.time_s
            self.passed_s = sample.time_s - start_s
            if speed < math.inf:
                _wait(wall_s + self.passed_s / speed, self._stopped)
            done = chain.step(sample)
            believed, target_ratio = chain.belief.terrain, chain.target_ratio
            self.believed[believed] += 1
            for output in done.windows:
                self.windows.append(self._observed(output, believed, target_ratio))
                view.observed(run.run_id, self.windows[-1])
            view.moment(ReplayMoment(run.run_id, self.passed_s, end_s - start_s, believed, target_ratio))
        return True

    def _observed(self, output: WindowOutput, believed: str, target_ratio: float) -> ObservedWindow:
        label = label_windows(self._run, np.array([output.start_s]), output.end_s - output.start_s)[0]
        return ObservedWindow(
            output.start_s,
            output.end_s,
            output.terrain,
            output.probability,
            output.refused,
            believed,
            target_ratio,
            label or None,
        )


def _model(uri: str | None, filter_stride_s: float | None) -> TerrainModel | None:
    if uri is None:
        return None
    from pipelines.models.tracking import load_model

    return filtered(load_model(uri), filter_stride_s)


def _wait(until_s: float, stopped: Callable[[], bool]) -> None:
    while (rest_s := until_s - perf_counter()) > 0.0 and not stopped():
        sleep(min(rest_s, LONGEST_SLEEP_S))
