"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli import classify, drive, estimate, explain, quickstart, reproduce, runs
from terrain.errors import ConfigError, TerrainError

if TYPE_CHECKING:
    from terrain.records import RunLog

app = typer.Typer(
    name="terrain",
    help="Terrain classification and slip learning for off-road robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)


class Format(StrEnum):
    """Layouts of a folder of runs."""

    auto = "auto"
    runs = "runs"
    borealtc = "borealtc"
    csv = "csv"
    drive = "drive"


Data = Annotated[Path, typer.Option("--data", help="Folder of runs in any readable layout.")]
Json = Annotated[
    Path | None,
    typer.Option(
        "--json", help="Write the result to this file as JSON.", callback=lambda path: _checked(path)
    ),
]
FormatOption = Annotated[Format, typer.Option("--format", help="Layout of the folder.")]
Mapping = Annotated[Path | None, typer.Option(help="YAML file that says how to read CSV files.")]
Repair = Annotated[bool, typer.Option("--repair", help="Drop and count what a strict read refuses.")]
Align = Annotated[
    bool,
    typer.Option("--align", help="Bring the wheel stream onto the IMU's clock where both see the turns."),
]
Jobs = Annotated[int, typer.Option(min=0, help="Processes at once; 0 for one a core.")]
MAX_GRADE_DEG = 30.0


GROUPS = (runs.app, estimate.app, classify.app, drive.app, explain.app, reproduce.app, quickstart.app)
"""Files of commands, in the order of help."""


@app.command("learn-slip")
def learn_slip_command(
    data: Data,
    robot: Annotated[str, typer.Option(help="Swerve robot by name, or its YAML file.")],
    out: Annotated[Path, typer.Option(help="YAML file of the table of target slips.")],
    figures: Annotated[
        Path | None, typer.Option(help="Folder of a page and its pictures; MLflow gets them anyway.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the bootstrap.")] = 0,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    json_file: Json = None,
) -> None:
    """Learn slip curves of labelled runs, and which slip to aim for on each terrain."""
    from pipelines.reporting.screens import print_learned_slip, progress_bar
    from pipelines.slip.learn_slip import learn_slip

    runs, skipped = _load(data, layout, mapping, repair, align=False)
    with progress_bar() as progress:
        result = learn_slip(
            runs,
            robot,
            out,
            dataset=data.resolve().name,
            figures=figures,
            seed=seed,
            skip_faulty=repair,
            on_skip=skipped.append,
            progress=progress,
        )
    print_learned_slip({**result, "skipped": skipped}, _console())
    named = {key: value for key, value in result.items() if key != "tracking_run_id"}  # drawn by MLflow anew
    _write_json(json_file, {**named, "skipped": skipped})


@app.command("calibrate")
def calibrate_command(
    data: Data,
    robot: Annotated[str, typer.Option(help="Robot by name, or its YAML file, to start from.")],
    out: Annotated[Path | None, typer.Option(help="New YAML file with what was found.")] = None,
    hard: Annotated[
        str | None,
        typer.Option(help="Labels of hard ground, by commas; those that slip next to nothing by default."),
    ] = None,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    json_file: Json = None,
) -> None:
    """Find zeros, ratio, biases, noise and time constants of a robot from its logs."""
    from pipelines.estimate.calibrate import calibrate
    from pipelines.estimate.calibration_screen import print_calibration
    from pipelines.reporting.json_file import write_json

    result = calibrate(
        data,
        robot,
        out,
        hard=None if hard is None else [name.strip() for name in hard.split(",")],
        layout=layout.value,
        mapping=mapping,
        repair=repair,
    )
    print_calibration(result, _console())
    write_json(json_file, result)


def _console() -> Any:
    from rich.console import Console

    # names come from the user's files: brackets in them are no markup
    return Console(soft_wrap=True, markup=False, width=None if sys.stdout.isatty() else 110)


def _load(
    data: Path, layout: Format, mapping: Path | None, repair: bool, align: bool
) -> tuple[list[RunLog], list[str]]:
    """Return the runs, and a sentence for each that a repairing read had to skip."""
    from pipelines.runs.datasets import load_runs

    skipped: list[str] = []
    return load_runs(
        data, layout=layout.value, mapping=mapping, repair=repair, align=align, on_skip=skipped.append
    ), skipped


def _checked(path: Path | None) -> Path | None:
    """Refuse a place that cannot be written before the work is done, not after."""
    if path is not None:
        from terrain.files.atomic import ensure_writable

        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; --json names a file")
        ensure_writable(path.parent)
    return path


def _write_json(path: Path | None, result: dict[str, Any]) -> None:
    if path is not None:
        from terrain.files.atomic import atomic_write

        atomic_write(path, json.dumps(result, indent=2, allow_nan=False) + "\n")


for group in GROUPS:
    app.add_typer(group)


def main() -> None:
    """Run the command line: a user's mistake is one sentence and exit code 2, a fault keeps its traceback."""
    try:
        app()
    except TerrainError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("stopped", err=True)
        sys.exit(130)
