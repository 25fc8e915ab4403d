"""Commands of terrain classification: crossval, compare, train, sweep, model, predict."""

from __future__ import annotations

import typer

from pipelines.classify.settings import ModelSettings, PredictSettings, TrainSettings
from pipelines.cli.command import Json, command
from pipelines.compare.settings import CompareSettings
from pipelines.crossval.settings import CrossvalSettings
from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.learn.parallel import ComputeSettings
from pipelines.sweep.settings import SweepSettings

app = typer.Typer()


@command(app, "crossval")
def crossval_command(
    source: AlignedRunsSettings,
    settings: CrossvalSettings,
    compute: ComputeSettings,
    json_file: Json = None,
) -> None:
    """Evaluate a recipe on held-out runs, of run logs or of a store of features."""
    from dataclasses import replace

    from pipelines.crossval.crossval import crossval
    from pipelines.crossval.screen import print_crossval
    from pipelines.data.datasets import data_digest
    from pipelines.feature_store.crossval import crossval_store
    from pipelines.feature_store.store import is_store, store_of
    from pipelines.learn.parallel import computing
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with computing(compute.compute), progress_bar() as progress:
        if is_store(source.data):
            store = store_of(source, settings.rule, settings.signal_sets)
            report = crossval_store(store, settings, progress).named(source.dataset, store.digest)
            skipped: list[str] = []
        else:
            runs, skipped = load(source)
            found = crossval(runs, settings.with_(skip_short=source.repair), progress)
            report = found.named(source.dataset, data_digest(runs))
    report = replace(report, skipped=tuple(skipped))
    print_crossval(report, output_console())
    write_json(json_file, report)


@command(app, "compare")
def compare_command(source: AlignedRunsSettings, settings: CompareSettings, json_file: Json = None) -> None:
    """Compare two recipes or models on held-out runs."""
    from pipelines.compare.compare import compare_models, compare_recipes
    from pipelines.compare.screen import print_compare
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, _ = load(source)
    asked = settings.with_(skip_short=source.repair)
    if settings.contenders is not None:
        with progress_bar() as progress:
            report = compare_recipes(runs, settings.contenders, asked, source.dataset, progress)
    else:
        from pipelines.models.tracking import load_model

        models = load_model(settings.a), load_model(settings.b)
        report = compare_models(runs, models, asked, source.dataset)
    print_compare(report, output_console())
    write_json(json_file, report)


@command(app, "train")
def train_command(
    source: AlignedRunsSettings,
    settings: TrainSettings,
    compute: ComputeSettings,
    json_file: Json = None,
) -> None:
    """Evaluate on held-out runs, fit on all of them, track in MLflow and register; also of a store."""
    from dataclasses import replace

    from pipelines.classify.screen import print_training
    from pipelines.classify.train import train, train_store
    from pipelines.crossval.screen import print_crossval
    from pipelines.feature_store.store import is_store, store_of
    from pipelines.learn.parallel import computing
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    skipped: list[str] = []
    with computing(compute.compute), progress_bar() as progress:
        if is_store(source.data):
            store = store_of(source, settings.rule, settings.signal_sets)
            found = train_store(store, settings, source.dataset, progress)
        else:
            runs, skipped = load(source)
            found = train(runs, settings.with_(skip_short=source.repair), source.dataset, progress)
    result = replace(found, skipped=tuple(skipped))
    print_crossval(replace(result.crossval, skipped=result.skipped), output_console())
    print_training(result, output_console())
    write_json(json_file, result)


@command(app, "sweep")
def sweep_command(
    source: AlignedRunsSettings, settings: SweepSettings, compute: ComputeSettings, json_file: Json = None
) -> None:
    """Search hyper-parameters on inner folds; a search that was interrupted goes on."""
    from pipelines.learn.parallel import computing
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from pipelines.sweep.screen import print_sweep
    from pipelines.sweep.sweep import sweep

    runs, _ = load(source)
    with computing(compute.compute), progress_bar() as progress:
        found = sweep(runs, settings.with_(skip_short=source.repair), source.dataset, progress)
    print_sweep(found, output_console())
    write_json(json_file, found)


@command(app, "model")
def model_command(settings: ModelSettings, json_file: Json = None) -> None:
    """Print the card of a model: training runs, figures, limits, size and time."""
    from pipelines.classify.show import model_statement, print_model
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    found = model_statement(settings.model)
    print_model(found, output_console())
    write_json(json_file, found)


@command(app, "predict")
def predict_command(source: AlignedRunsSettings, settings: PredictSettings, json_file: Json = None) -> None:
    """Print terrain, probability and target slip."""
    from dataclasses import replace

    from pipelines.classify.predict import predict
    from pipelines.classify.screen import print_predictions
    from pipelines.live.over_time import filtered
    from pipelines.models.tracking import load_model
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console
    from terrain.control.slip_table import load_slip_table
    from terrain.robots import load_robot

    table = load_slip_table(settings.table)
    runs, skipped = load(source)
    robot = None if source.robot is None else load_robot(source.robot)
    model = filtered(load_model(settings.model), settings.filter_stride_s)
    predicted = predict(runs, model, table, robot=robot, skip_short=source.repair)
    result = replace(predicted, model=settings.model, dataset=source.dataset, skipped=tuple(skipped))
    print_predictions(result, output_console())
    write_json(json_file, result)
