"""``terrain model``: what a model states of itself, by its card."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from pipelines.classify.card import CARD_JSON
from pipelines.classify.card_support import rows_of_card, support_tables
from pipelines.learn.model_file import TerrainModel, read_model
from pipelines.reporting.json_file import as_json
from pipelines.reporting.numbers import NOT_KNOWN
from pipelines.reporting.terminal import print_lines
from terrain.errors import LogError, ModelError
from terrain.files.documents import MAX_JSON_BYTES, parse_json
from terrain.files.regular import read_regular

CARD_KEYS = {"name", "recipe", "terrains", "figures", "limits", "notes", "files"}


class ModelStatement(NamedTuple):
    """What is known of a model.

    Parameters
    ----------
    model : as it was asked for
    recipe, classes, window_s, channels, robots, filter : of ``terrain_model.json``
    n_training_runs : runs that it was trained on
    finds_unknown, counts_support, names_sets : whether it answers "unknown", counts support, and gives sets
    card : the content of its card; None of models of releases that wrote none
    """

    model: str
    recipe: str
    classes: tuple[str, ...]
    window_s: float
    channels: Mapping[str, tuple[str, ...]]
    robots: tuple[str, ...]
    filter: str
    n_training_runs: int
    finds_unknown: bool
    counts_support: bool
    names_sets: bool
    card: Mapping[str, Any] | None

    def as_json(self) -> dict[str, Any]:
        """Return all fields."""
        found: dict[str, Any] = as_json(self._asdict())
        return found


def model_statement(uri: str) -> ModelStatement:
    """Return what a model states of itself.

    Parameters
    ----------
    uri : ``models:/NAME@champion``, ``models:/NAME/3``, or a folder

    Raises
    ------
    ModelError
        if there is no such model, or a file of it is damaged.
    """
    if Path(uri).exists():
        folder = Path(uri)
    else:
        from pipelines.learn.tracking import fetch_model

        folder = fetch_model(uri)
    model: TerrainModel = read_model(folder)
    info = model.info
    return ModelStatement(
        uri,
        info.recipe,
        info.classes,
        info.window_s,
        info.channels,
        info.robots,
        info.filter,
        len(info.run_digests),
        model.novelty is not None,
        model.support is not None,
        info.conformal is not None,
        _card(folder / CARD_JSON),
    )


def _card(file: Path) -> Mapping[str, Any] | None:
    """Return the content of a card whose checksum was compared; None where there is none."""
    if not file.is_file():
        return None
    try:
        card = parse_json(read_regular(file, str(file), ModelError, MAX_JSON_BYTES))
    except (LogError, ValueError) as error:
        raise ModelError(f"{file}: is damaged ({error})") from error
    if not isinstance(card, dict) or not set(card) >= CARD_KEYS:
        raise ModelError(f"{file}: is no card of a model")
    return card


def print_model(found: ModelStatement, console: Console) -> None:
    """Print the card of a model: what it was trained on, how good it is, what it is not for."""
    console.print(f"{found.model}: recipe {found.recipe}, windows of {found.window_s:g} s")
    print_lines(console, _lines(found))
    if found.card is None:
        return
    table = Table(
        "terrain", "runs", "windows", "precision", "recall", title="trained on, and on held-out runs"
    )
    for row in found.card["terrains"]:
        table.add_row(
            str(row["terrain"]),
            str(row["n_runs"]),
            str(row["n_windows"]),
            f"{row['precision']:.1%}",
            f"{row['recall']:.1%}",
        )
    console.print(table)
    for part in support_tables(rows_of_card(found.card), console.width):
        console.print(part)
    for row in found.card["figures"]:
        console.print(
            f"{row['name']}: {row['value']}"
            + (f" ({row['interval']})" if row["interval"] != NOT_KNOWN else "")
        )
    print_lines(console, (f"not for: {text}" for text in found.card["limits"]))
    print_lines(console, (f"note: {text}" for text in found.card["notes"]))
    print_lines(console, (f"{row['name']}: {row['n_bytes']} bytes" for row in found.card["files"]))


def _lines(found: ModelStatement) -> Iterator[str]:
    for stream, channels in found.channels.items():
        yield f"{stream}: {', '.join(channels)}"
    yield f"terrains: {', '.join(found.classes)}"
    yield f"robots: {', '.join(found.robots) or 'not known'}; {found.n_training_runs} training runs"
    if found.filter:
        yield f"estimates of the filter {found.filter}"
    kept = {
        "answers unknown": found.finds_unknown,
        "counts support": found.counts_support,
        "gives sets of terrains": found.names_sets,
    }
    yield "; ".join(f"{what}: {'yes' if there else 'no'}" for what, there in kept.items())
    if found.card is None:
        yield "it has no card: it is of an earlier release, or was not registered"
