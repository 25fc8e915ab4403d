"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli import classify, drive, quickstart, reproduce, runs
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


class FilterName(StrEnum):
    """Filters; the numbers are those of their states."""

    encoder12 = "encoder12"
    slip14 = "slip14"
    vio12 = "vio12"
    vio15 = "vio15"
    skid = "skid"


class Tuning(StrEnum):
    """Where a filter's noise comes from."""

    physical = "physical"
    thesis = "thesis"
    likelihood = "likelihood"


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


GROUPS = (runs.app, classify.app, drive.app, reproduce.app, quickstart.app)
"""Files of commands, in the order of help."""


@app.command("estimate")
def estimate_command(
    data: Data,
    filter_name: Annotated[FilterName, typer.Option("--filter", help="Which filter.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of new run folders with state and slip, and of pictures.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Robot or its YAML file, in place of the one that a run names.")
    ] = None,
    tuning: Annotated[
        Tuning | None, typer.Option(help="Noise; the thesis' own for vio12, else physical.")
    ] = None,
    tune_on: Annotated[
        str | None, typer.Option(help="Runs, by commas, that teach the tuning 'likelihood'; the first three.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw pictures into OUT/figures.")] = True,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    json_file: Json = None,
) -> None:
    """Estimate motion and slip, and say how well."""
    from pipelines.estimate.estimate import estimate
    from pipelines.estimate.screen import print_estimates
    from pipelines.estimate.settings import EstimateSettings
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.screens import progress_bar

    given: dict[str, Any] = {"filter": filter_name.value, "tuning": tuning and tuning.value}
    given |= {"out": out, "robot": robot, "tune_on": tune_on, "figures": figures}
    settings = EstimateSettings(**given)
    runs, skipped = _load(data, layout, mapping, repair, align=False)
    with progress_bar() as progress:
        result = estimate(runs, settings, skipped, progress)
    print_estimates(result, _console())
    write_json(json_file, result)


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
    from pipelines.estimate.calibrate import calibrate, print_calibration

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
    _write_json(json_file, result)


@app.command("explain")
def explain_command(
    data: Data,
    robot: Annotated[str, typer.Option(help="Robot whose simulation is tested: name or YAML file.")],
    out: Annotated[Path, typer.Option(help="Folder of the page, its pictures, and the extended robot.")],
    model: Annotated[
        str | None, typer.Option(help="Extended description of that robot, tested in its place.")
    ] = None,
    effects: Annotated[
        str | None, typer.Option(help="Effects that may be named, by commas; all by default.")
    ] = None,
    terrain: Annotated[str | None, typer.Option(help="Look at runs of this label alone.")] = None,
    hold_out: Annotated[
        int | None,
        typer.Option(min=0, help="Runs kept to measure the gain; a quarter of six or more by default."),
    ] = None,
    classifier: Annotated[
        bool,
        typer.Option(
            "--classifier", help="Also teach a classifier in simulation, before and after; takes a minute."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of which runs are kept, and of the bootstrap.")] = 0,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    align: Align = False,
    json_file: Json = None,
) -> None:
    """Find what a robot's simulation gets wrong about runs, extend it, and measure what that is worth."""
    from pipelines.explain.explain import explain
    from pipelines.reporting.screens import print_explain, progress_bar

    runs, skipped = _load(data, layout, mapping, repair, align)
    with progress_bar() as progress:
        result = explain(
            runs,
            robot,
            out,
            model=model,
            effects=None
            if effects is None
            else [name.strip() for name in effects.split(",") if name.strip()],
            terrain=terrain,
            hold_out=hold_out,
            seed=seed,
            dataset=data.resolve().name,
            classifier=classifier,
            progress=progress,
        )
    print_explain({**result, "skipped": skipped}, _console())
    _write_json(json_file, {**result, "skipped": skipped})


@app.command("explain-trials")
def explain_trials_command(
    n: Annotated[
        int,
        typer.Option(
            help="Trials of each row; row 'found' takes the effects in turn, 50 trials a round, and tells "
            "something after 5 rounds."
        ),
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is drawn.")] = 0,
    rows: Annotated[
        str | None,
        typer.Option(help="By commas: none, strong, ladder, found, two, outside, poor; all by default."),
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs of each trial.")] = 8,
    jobs: Jobs = 0,
    json_file: Json = None,
) -> None:
    """Hide effects in simulated runs, have them looked for blindly, and count how often that is right."""
    import os

    from pipelines.explain.trials import ROWS, explain_trials
    from pipelines.reporting.screens import print_explain_trials, progress_bar

    chosen = ROWS if rows is None else tuple(name.strip() for name in rows.split(",") if name.strip())
    with progress_bar() as progress:
        result = explain_trials(n, seed, chosen, runs, jobs or os.cpu_count() or 1, progress)
    print_explain_trials(result, _console())
    _write_json(json_file, result)


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
