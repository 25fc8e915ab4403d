"""Commands of state estimation: estimate, calibrate, odometry."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import RunsSettings, load
from pipelines.estimate.settings import CalibrateSettings, EstimateSettings
from pipelines.odometry.settings import OdometrySettings

app = typer.Typer()


@command(app, "estimate")
def estimate_command(source: RunsSettings, settings: EstimateSettings, json_file: Json = None) -> None:
    """Estimate motion and slip, with their uncertainty."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from terrain.estimation.observers.choice import OBSERVERS

    runs, skipped = load(source, settings.robot, align=settings.align)
    if settings.filter in OBSERVERS:
        from pipelines.estimate.observed import estimate_observed
        from pipelines.estimate.observed_screen import print_observed

        with progress_bar() as progress:
            observed = estimate_observed(runs, settings, skipped, progress)
        print_observed(observed, output_console())
        write_json(json_file, observed)
        return
    from pipelines.estimate.estimate import estimate
    from pipelines.estimate.screen import print_estimates

    with progress_bar() as progress:
        result = estimate(runs, settings, skipped, progress)
    print_estimates(result, output_console())
    write_json(json_file, result)


@command(app, "calibrate")
def calibrate_command(source: RunsSettings, settings: CalibrateSettings, json_file: Json = None) -> None:
    """Find zeros, ratio, track, biases, noise and time constants of a robot from its logs."""
    from pipelines.estimate.calibrate import calibrate
    from pipelines.estimate.calibration_screen import print_calibration
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    result = calibrate(
        source.data,
        settings.robot,
        settings.out,
        hard=settings.hard,
        layout=source.layout,
        mapping=source.mapping,
        repair=source.repair,
    )
    print_calibration(result, output_console())
    write_json(json_file, result)


@command(app, "odometry")
def odometry_command(source: RunsSettings, settings: OdometrySettings, json_file: Json = None) -> None:
    """Fit slip-compensated odometry of a tracked robot, and judge it on runs held out."""
    from pipelines.odometry.judge import judge_odometry
    from pipelines.odometry.screen import print_odometry
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, _ = load(source, settings.robot)
    with progress_bar() as progress:
        result = judge_odometry(runs, source, settings, progress)
    print_odometry(result, output_console())
    write_json(json_file, result)
