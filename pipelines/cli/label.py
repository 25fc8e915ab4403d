"""Command on the labels of recorded runs: label."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.label.settings import LabelSettings

app = typer.Typer()


@command(app, "label")
def label_command(settings: LabelSettings, json_file: Json = None) -> None:
    """List windows of low confidence of recorded runs, set their terrain, or have a model propose it."""
    from pipelines.label.labels import doubtful_windows, set_label
    from pipelines.label.screen import print_doubtful, print_labelled
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    if settings.model is not None:
        from pipelines.models.tracking import load_model
        from pipelines.propose.labelling import propose_labels
        from pipelines.propose.screen import print_proposed

        model = load_model(settings.model)
        proposed = propose_labels(settings.data, model, settings.ask, settings.proposals, settings.accept)
        print_proposed(proposed, output_console())
        write_json(json_file, proposed)
        return
    if settings.answers is not None and settings.out is not None:
        from pipelines.propose.labelling import write_labels
        from pipelines.propose.screen import print_written

        written = write_labels(
            settings.data, settings.answers, settings.out, settings.accept, new_class=settings.new_class
        )
        print_written(written, output_console())
        write_json(json_file, written)
        return
    if settings.sets:
        labelled = set_label(settings)
        print_labelled(labelled, output_console())
        write_json(json_file, labelled)
        return
    found = doubtful_windows(settings)
    print_doubtful(found, output_console())
    write_json(json_file, found)
