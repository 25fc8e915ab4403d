"""The commands learn-slip, measure-slip and find-changes."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import RunsSettings, load
from pipelines.ground_changes.settings import FindChangesSettings
from pipelines.measured_slip.settings import MeasureSlipSettings
from pipelines.slip.settings import LearnSlipSettings

app = typer.Typer()


@command(app, "learn-slip")
def learn_slip_command(settings: LearnSlipSettings, json_file: Json = None) -> None:
    """Learn slip of labelled runs, and the target slip on each terrain."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from pipelines.slip.learn_slip import learn_slip
    from pipelines.slip.measured import learn_measured
    from pipelines.slip.measured_screen import print_measured_targets
    from pipelines.slip.screen import print_learned_slip
    from terrain.robots import SwerveRobot, load_robot

    robot = load_robot(settings.robot)
    runs, skipped = load(settings)
    if not isinstance(robot, SwerveRobot):
        with progress_bar() as progress:
            targets = learn_measured(runs, robot, settings, skipped, progress)
        print_measured_targets(targets, output_console())
        write_json(json_file, targets)
        return
    with progress_bar() as progress:
        result = learn_slip(runs, settings, skipped, progress)
    print_learned_slip(result, output_console())
    write_json(json_file, result)


@command(app, "measure-slip")
def measure_slip_command(settings: MeasureSlipSettings, json_file: Json = None) -> None:
    """Measure slip against poses from outside, and show how well currents predict it."""
    from pipelines.measured_slip.measure import measure_slip
    from pipelines.measured_slip.screen import print_measured_slip
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, skipped = load(settings)
    with progress_bar() as progress:
        result = measure_slip(runs, settings, skipped, progress)
    print_measured_slip(result, output_console())
    write_json(json_file, result)


@command(app, "find-changes")
def find_changes_command(settings: FindChangesSettings, json_file: Json = None) -> None:
    """Find changes of the ground as a robot drives, from the currents of its wheels."""
    from pipelines.ground_changes.find import find_changes
    from pipelines.ground_changes.screen import print_changes
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, skipped = load(settings)
    quiet, also_skipped = load(RunsSettings(data=settings.calibrate, repair=settings.repair), settings.robot)
    with progress_bar() as progress:
        result = find_changes(runs, quiet, settings, [*skipped, *also_skipped], progress)
    print_changes(result, output_console())
    write_json(json_file, result)
