"""The commands that measure: bench live, soak (chain, service), fleet (many runs), labels (questions)."""

from __future__ import annotations

import typer

from pipelines.bench.settings import BenchSettings, FleetSettings, LabelsSettings, SoakSettings
from pipelines.cli.command import Json, command

app = typer.Typer(
    help="Measure the live chain, the service, and features of many runs.", no_args_is_help=True
)


@command(app, "live")
def live_command(settings: BenchSettings, json_file: Json = None) -> None:
    """Measure latencies by stage, and the service with one robot and with many."""
    from pipelines.bench.live import bench_live
    from pipelines.bench.screen import print_bench
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = bench_live(settings, progress)
    print_bench(result, output_console())
    write_json(json_file, result)


@command(app, "soak")
def soak_command(settings: SoakSettings, json_file: Json = None) -> None:
    """Load the service with robots and faults at random; exit code 1 where anything is not accepted."""
    from pipelines.bench.screen import print_soak
    from pipelines.bench.soak import soak
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = soak(settings, progress)
    print_soak(result, output_console())
    write_json(json_file, result)
    if result.problems:
        raise typer.Exit(1)


@command(app, "fleet")
def fleet_command(settings: FleetSettings, json_file: Json = None) -> None:
    """Measure time and memory of features against the number of runs, on a generated fleet."""
    from pipelines.bench.fleet import bench_fleet
    from pipelines.bench.screen import print_fleet
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = bench_fleet(settings, progress)
    print_fleet(result, output_console())
    write_json(json_file, result)


@command(app, "labels")
def labels_command(settings: LabelsSettings, json_file: Json = None) -> None:
    """Measure what chosen questions and self-training gain on held-out runs, from few labels."""
    from pipelines.learn.settings import LearnSettings
    from pipelines.propose.screen import print_study
    from pipelines.propose.study import label_study
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    evaluation = LearnSettings(repeats=settings.repeats, seed=settings.seed, n_jobs=settings.n_jobs)
    with progress_bar() as progress:
        result = label_study(settings.data, evaluation, progress)
    print_study(result, output_console())
    write_json(json_file, result)
