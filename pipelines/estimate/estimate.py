"""``terrain estimate``: state and slip of runs, with their errors where a log has a truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.estimate.observed import refuse_existing
from pipelines.estimate.results import EstimateResult
from pipelines.estimate.settings import EstimateSettings
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError, DataError
from terrain.estimation.ekf.model import Noise
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import Estimate, beside, filter_run, model_and_noise, tuning_of
from terrain.estimation.summary import summarize
from terrain.estimation.tuned_noise import TunedNoise, tuned_noise, tuning_runs
from terrain.extension import correct, corrected, corrected_log
from terrain.logs.clock import estimate_clock
from terrain.logs.write import write_run
from terrain.records import RunLog
from terrain.robots import Robot, load_robot, packaged_robot


def estimate(
    runs: Sequence[RunLog],
    settings: EstimateSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> EstimateResult:
    """Filter runs; write them with their tracks, and their pictures.

    Parameters
    ----------
    runs : logs
    settings : filter and noise; nothing is written without ``out``
    skipped : a sentence for each run that was not read

    Raises
    ------
    ConfigError
        if the filter does not fit a robot, or runs to tune on are named without the tuning ``likelihood``.
    DataError
        if there is no run of a name to tune on, or a log has no wheels.
    LogError
        if a run is in ``out`` already; nothing is written then.
    """
    if settings.slip_model is not None:
        raise ConfigError(
            f"a slip model is for observers of tracked robots, not for filter {settings.filter!r}"
        )
    if settings.out is not None:
        refuse_existing(runs, settings.out)
    tuning = tuning_of(settings.filter, settings.tuning)
    if settings.tune_on is not None and tuning != "likelihood":
        raise ConfigError(f"runs to tune on go with the tuning 'likelihood', not {tuning!r}")
    process_noise, tuned = _tuned(runs, settings) if tuning == "likelihood" else (None, None)
    rows, given = [], None if settings.robot is None else load_robot(settings.robot)
    for done, run in enumerate(runs):
        (log, robot), noise = correct(run, given or packaged_robot(run.robot)), None
        if process_noise is not None:  # not every run has the sensors of the runs tuned on
            _, own = model_and_noise(log, robot, settings.filter, tuning)
            noise = Noise(process_noise.process_variance, own.measurement_variance, own.initial_variance)
        found = beside(run, filter_run(log, robot, settings.filter, tuning=tuning, noise=noise))
        rows.append(summarize(found))
        if settings.out is not None:
            _write(found, settings.out, settings.figures)
        progress(f"estimate {settings.filter}", done + 1, len(runs))
    clocks = () if settings.align or settings.filter != "skid" else _apart(runs, given)
    return EstimateResult(settings.filter, tuning, tuned, settings.out, tuple(rows), tuple(skipped), clocks)


MAX_APART_S = 0.1
"""Between the clocks of wheels and IMU: in more, a robot that begins to turn is seen to turn without wheels,
and the effective track is wrong by as much as its turns are short."""


def _apart(runs: Sequence[RunLog], given: Robot | None) -> tuple[str, ...]:
    """Return a sentence where wheels and IMU of runs clearly do not share a clock."""
    offsets_s = {}
    for run in runs:
        try:
            found = estimate_clock(run, track_m=(given or packaged_robot(run.robot)).track_m)
        except DataError:  # no gyro, or no speeds of two sides
            continue
        known = found.status in ("estimated", "offset only")
        if known and abs(found.offset_s) > max(MAX_APART_S, 3.0 * found.offset_std_s):
            offsets_s[run.run_id] = found.offset_s
    if not offsets_s:
        return ()
    worst = max(offsets_s, key=lambda name: abs(offsets_s[name]))
    return (
        f"the clocks of wheels and IMU are apart in {len(offsets_s)} of {len(runs)} runs, by "
        f"{offsets_s[worst]:+.2f} s in {worst}: tracks and yaw rates of these are wrong; --align brings the "
        "wheels onto the IMU's clock",
    )


def _tuned(runs: Sequence[RunLog], settings: EstimateSettings) -> tuple[Noise, TunedNoise]:
    chosen = tuning_runs(runs, settings.tune_on)
    robot: Robot = load_robot(settings.robot) if settings.robot else packaged_robot(chosen[0].robot)
    logs, robot = [corrected_log(run, robot) for run in chosen], corrected(robot)
    return tuned_noise(*model_and_noise(logs[0], robot, settings.filter), logs, robot)


def _write(found: Estimate, out: Path, figures: bool) -> None:
    write_run(enriched(found), out)
    if figures:
        from pipelines.estimate.figures import write_figures

        write_figures(found, out / "figures")
