"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.explain import app as explain_group
from pipelines.cli.reproduce import app as reproduce_group
from pipelines.cli.runs import app as runs_group
from terrain.errors import ConfigError, TerrainError
from terrain.logs.schema import SIGNAL_SETS

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


class Protocol(StrEnum):
    """Protocols of cross-validation."""

    grouped = "grouped"
    leave_one_run_out = "leave-one-run-out"
    published = "published"


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


class Recipe(StrEnum):
    """Recipes from windows to terrain."""

    svm = "svm"


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
Window = Annotated[float | None, typer.Option(help="Window length in s (2; 1.7 under 'published').")]
Stride = Annotated[float | None, typer.Option(help="From window to window in s; one length by default.")]
Steady = Annotated[bool, typer.Option(help="Keep windows of steady motion only.")]
Signals = Annotated[
    str, typer.Option(help="Signal sets to use, by commas; leave one out to see what it is worth.")
]
Seed = Annotated[int, typer.Option(min=0, help="Deals runs into folds.")]
Repeats = Annotated[int | None, typer.Option(min=1, help="Fold assignments (5).")]
Jobs = Annotated[int, typer.Option(min=0, help="Processes at once; 0 for one a core.")]
ALL_SIGNALS = ",".join(SIGNAL_SETS)
DRIVE_CONTROLLERS = ("plain", "ramp", "thesis", "fixed", "learned", "oracle")
MAX_GRADE_DEG = 30.0


GROUPS: tuple[typer.Typer, ...] = (runs_group, explain_group, reproduce_group)
"""The files of commands, in the order of help; each has its own ``app``."""


@app.command("crossval")
def crossval_command(
    data: Data,
    recipe: Annotated[Recipe, typer.Option(help="What to evaluate.")] = Recipe.svm,
    protocol: Annotated[
        Protocol, typer.Option(help="Which windows teach and which test.")
    ] = Protocol.grouped,
    window: Window = None,
    stride: Stride = None,
    steady: Steady = True,
    signals: Signals = ALL_SIGNALS,
    repeats: Repeats = None,
    seed: Seed = 0,
    extras: Annotated[bool, typer.Option(help="Speed alone, slow against fast, learning curve.")] = True,
    jobs: Jobs = 0,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    align: Align = False,
    json_file: Json = None,
) -> None:
    """Tell how well a recipe does on runs it has not seen."""
    from pipelines.classify.crossval import CrossvalSettings, crossval
    from pipelines.reporting.screens import print_crossval, progress_bar
    from pipelines.runs.datasets import data_digest

    settings = CrossvalSettings(
        recipe=recipe.value,
        protocol=protocol.value,
        window_s=window,
        stride_s=stride,
        steady=steady,
        repeats=repeats,
        seed=seed,
        signal_sets=_names(signals),
        extras=extras,
        n_jobs=jobs,
        skip_short=repair,
    )
    runs, skipped = _load(data, layout, mapping, repair, align)
    with progress_bar() as progress:
        report = crossval(runs, settings, progress)
    result = {"dataset": data.resolve().name, "data_digest": data_digest(runs), **report, "skipped": skipped}
    print_crossval(result, _console())
    _write_json(json_file, result)


@app.command("train")
def train_command(
    data: Data,
    name: Annotated[str, typer.Option(help="Name of the registered model.")],
    recipe: Annotated[Recipe, typer.Option(help="What to train.")] = Recipe.svm,
    window: Window = None,
    stride: Stride = None,
    steady: Steady = True,
    signals: Signals = ALL_SIGNALS,
    repeats: Repeats = None,
    seed: Seed = 0,
    jobs: Jobs = 0,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    align: Align = False,
    json_file: Json = None,
) -> None:
    """Evaluate on held-out runs, fit on all of them, track in MLflow and register."""
    from pipelines.classify.crossval import CrossvalSettings
    from pipelines.classify.train import train
    from pipelines.reporting.screens import print_crossval, print_training, progress_bar

    settings = CrossvalSettings(
        recipe=recipe.value,
        window_s=window,
        stride_s=stride,
        steady=steady,
        repeats=repeats,
        seed=seed,
        signal_sets=_names(signals),
        extras=False,
        n_jobs=jobs,
        skip_short=repair,
    )
    runs, skipped = _load(data, layout, mapping, repair, align)
    with progress_bar() as progress:
        result = {**train(runs, settings, name, data.resolve().name, progress), "skipped": skipped}
    print_crossval({**result["crossval"], "dataset": result["dataset"], "skipped": skipped}, _console())
    print_training(result, _console())
    _write_json(json_file, result)


@app.command("predict")
def predict_command(
    model: Annotated[str, typer.Option(help="models:/NAME@champion, models:/NAME/3, or a model folder.")],
    data: Data,
    table: Annotated[
        Path | None, typer.Option(help="Table of target slips; the packaged one by default.")
    ] = None,
    layout: FormatOption = Format.auto,
    mapping: Mapping = None,
    repair: Repair = False,
    align: Align = False,
    json_file: Json = None,
) -> None:
    """Print terrain, probability and target slip."""
    from pipelines.classify.predict import predict
    from pipelines.models.tracking import load_model
    from pipelines.reporting.screens import print_predictions
    from terrain.control.slip_table import load_slip_table

    slip_table = load_slip_table(table)
    runs, skipped = _load(data, layout, mapping, repair, align)
    predicted = predict(runs, load_model(model), slip_table, skip_short=repair)
    result = {"model": model, "dataset": data.resolve().name, **predicted, "skipped": skipped}
    print_predictions(result, _console())
    _write_json(json_file, result)


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


@app.command("drive")
def drive_command(
    robot: Annotated[str, typer.Option(help="Robot by name, or its YAML file.")] = "agrimaro",
    scenario: Annotated[
        str,
        typer.Option(
            help="starts, straight, slope (the steepest; else level), brake, circle, crab; course and mixed "
            "on the terrain 'course'; or any of simulate."
        ),
    ] = "starts",
    terrain: Annotated[
        str, typer.Option(help="Name of a soil, its YAML file, or 'course' for all.")
    ] = "grass",
    controllers: Annotated[
        str,
        typer.Option(
            help="By commas: plain, ramp, thesis, fixed, learned, oracle, told:NAME (always told that "
            "ground), target:SLIP; ours also as NAME+track, held to its way."
        ),
    ] = ",".join(DRIVE_CONTROLLERS),
    table: Annotated[
        Path | None, typer.Option(help="Table of target slips; the packaged one by default.")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Classifier of 'learned': models:/NAME@champion or a folder; taught anew without."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Days: draws of load, soil, tyres and noise.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The first of them.")] = 0,
    delay: Annotated[float, typer.Option(help="From a sample to the wheel in s.")] = 0.05,
    ramp: Annotated[
        float | None,
        typer.Option(help="Rise of speed of 'ramp' in m/s^2; without, as fast as gets as far as ours."),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Length of a drive in s.")] = None,
    speed: Annotated[float, typer.Option(help="Cruising speed in m/s.")] = 1.0,
    accel: Annotated[float, typer.Option(help="Rise of the wanted speed in m/s^2; inf for a step.")] = 1.0,
    grade: Annotated[float, typer.Option(help="Slope in degrees, uphill > 0.")] = 0.0,
    radius: Annotated[
        str | None,
        typer.Option(help="True radius of each wheel over the believed one, as in 1,1.02,1; drawn without."),
    ] = None,
    leg_backlash: Annotated[float, typer.Option(help="Play of the third leg in rad.")] = 0.0,
    plant: Annotated[
        str | None, typer.Option(help="Robot as it really is, where it is not what --robot believes.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the page with its pictures.")] = None,
    jobs: Jobs = 0,
    json_file: Json = None,
) -> None:
    """Drive controllers side by side in the closed loop, and compare what it costs."""
    import os

    from pipelines.drive.controllers import taught_classifier
    from pipelines.drive.drive import DriveSettings, drive, example_runs
    from pipelines.reporting.screens import print_drive, progress_bar
    from terrain.control.slip_table import load_slip_table
    from terrain.robots import load_robot

    if not abs(grade) <= MAX_GRADE_DEG:
        raise ConfigError(
            f"--grade is {grade:g}; {-MAX_GRADE_DEG:g} to {MAX_GRADE_DEG:g} degrees are accepted"
        )
    described = load_robot(robot)
    slip_table = load_slip_table(table, described.name)
    settings = DriveSettings(
        scenario=scenario,
        terrain=terrain,
        controllers=tuple(name.strip() for name in controllers.split(",") if name.strip()),
        seeds=seeds,
        first_seed=seed,
        delay_s=delay,
        ramp_mps2=ramp,
        duration_s=duration,
        speed_mps=speed,
        accel_mps2=accel,
        grade_deg=grade,
        radius_factors=_radii(radius),
        leg_backlash_rad=leg_backlash,
        plant=None if plant is None else load_robot(plant),
    )
    settings.check(described, slip_table)
    needs_model = any(name.partition("+")[0] == "learned" for name in settings.controllers)
    if model is not None and not needs_model:
        raise ConfigError("--model is the classifier of 'learned', which is not among the controllers")
    if out is not None:
        from terrain.files.atomic import ensure_writable

        ensure_writable(out)
    with progress_bar() as progress:
        classifier = None
        if needs_model:
            if model is None:
                classifier = taught_classifier(described, seed, progress)
            else:
                from pipelines.models.tracking import load_model

                classifier = load_model(model)
        result = drive(described, slip_table, settings, classifier, progress, jobs or os.cpu_count() or 1)
        if out is not None:
            from pipelines.drive.page import write_drive_page

            examples = example_runs(described, slip_table, settings, result["ramp_mps2"], classifier)
            write_drive_page(out, result, examples, slip_table)
    print_drive(result, _console())
    if out is not None:
        typer.echo(f"page: {out / 'drive.html'}")
    _write_json(json_file, result)


@app.command("quickstart")
def quickstart_command(
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of labelled runs; without, runs are simulated.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the runs and the report.")] = Path("terrain-report"),
    name: Annotated[str, typer.Option(help="Name of the registered model.")] = "quickstart",
    seed: Seed = 0,
    jobs: Jobs = 0,
    json_file: Json = None,
) -> None:
    """Import or simulate runs, cross-validate, train, predict, and write a report."""
    from pipelines.classify.crossval import CrossvalSettings
    from pipelines.quickstart.quickstart import quickstart
    from pipelines.reporting.screens import (
        print_crossval,
        print_predictions,
        print_slip,
        print_training,
        progress_bar,
    )

    with progress_bar() as progress:
        result = quickstart(data, out, CrossvalSettings(seed=seed, n_jobs=jobs), name, progress)
    if result["slip"]:
        print_slip(result["slip"], _console())
    print_crossval(result["crossval"], _console())
    print_training(result["train"], _console())
    print_predictions(result["predict"], _console())
    typer.echo(f"report: {result['report']}")
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


def _radii(text: str | None) -> tuple[float, float, float] | None:
    """Read ``A,B,C``."""
    if text is None:
        return None
    try:
        one, two, three = (float(part) for part in text.split(","))
    except ValueError:
        one = two = three = 0.0
    if not all(0.5 <= ratio <= 2.0 for ratio in (one, two, three)):
        raise ConfigError(f"--radius is {text!r}; three ratios from 0.5 to 2 are required, as in 1,1.02,1")
    return one, two, three


def _names(signals: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in signals.split(",") if name.strip())
    if not names:
        raise ConfigError(f"no signal set is named; there are {ALL_SIGNALS}")
    return names


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
