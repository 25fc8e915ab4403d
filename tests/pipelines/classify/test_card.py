"""Every model has a card beside it, which no name can break and no change escapes its checksum."""

import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from rich.console import Console

from features.motion import window_motion
from pipelines.classify.card import CARD_FILE, CARD_JSON, figure_rows, model_card
from pipelines.classify.card_support import support_tables
from pipelines.crossval.crossval import samples_of
from pipelines.models.model_files import INFO_FILE, read_lean_model, read_model
from pipelines.reporting.numbers import NOT_KNOWN
from pipelines.support.results import SupportRow
from terrain.errors import ModelError


@pytest.fixture
def card(tracked, runs, settings, make_report):
    """Return a maker of cards of the trained model; what is given replaces fields of its information."""
    info = read_model(tracked[0] / "model").info
    windows = samples_of(runs, settings()).cut.windows

    def make(report=None, **changed):
        info_changed, of_report = replace(info, **changed), report or tracked[1].crossval
        return model_card("drawn", info_changed, windows, window_motion(windows), of_report, {"C": 10.0})

    return make


def test_a_trained_model_has_its_card_and_its_figures(model_dir, in_tracked):
    document = json.loads((model_dir / CARD_JSON).read_text())
    report = in_tracked.crossval
    assert document["data_digest"] == in_tracked.data_digest
    assert document["n_windows"] == in_tracked.n_windows
    assert [row["terrain"] for row in document["terrains"]] == ["ASPHALT", "GRASS", "GRAVEL"]
    assert [row["n_runs"] for row in document["terrains"]] == [4, 4, 4]
    low, high = report.accuracy_ci
    assert document["figures"][0]["value"] == f"{report.accuracy:.1%}"
    assert document["figures"][0]["interval"] == f"{low:.1%} to {high:.1%}"
    assert document["latency_ms"] > 0
    sizes = {row["name"]: row["n_bytes"] for row in document["files"]}
    assert sizes == {
        name: (model_dir / name).stat().st_size for name in ("model.skops", "novelty.npz", "numbers.npz")
    }
    assert any("robots other than husky" in text.lower() for text in document["limits"])
    text = (model_dir / CARD_FILE).read_text()
    assert text.startswith("# Model card: drawn\n")
    logged = list(Path("mlruns").glob(f"*/{in_tracked.registered.run_id}/artifacts/{CARD_FILE}"))
    assert [file.read_text() for file in logged] == [text]


def test_names_of_any_language_and_sign_stay_in_their_cells(card, make_report):
    name = "мокрая | <script>\n# [x](http://y) `трава` *a_b*"
    report = make_report()
    report = replace(
        report,
        classes=(name, "ICE"),
        per_class={name: report.per_class["GRASS"], "ICE": report.per_class["ICE"]},
        notes=(f"{name}: one run only",),
    )
    text = card(report, dataset=name, robots=(name,), classes=(name, "ICE")).texts()[CARD_FILE]
    shown = "мокрая \\| \\<script\\>\\\\n\\# \\[x\\](http\\://y) \\`трава\\` \\*a\\_b\\*"
    rows = [line for line in text.splitlines() if "мокрая" in line]
    assert len(rows) == 6
    assert all(shown in line for line in rows)
    cells = next(line for line in rows if line.startswith("| data set"))
    assert cells.replace("\\|", "").count("|") == 3
    assert [line for line in text.splitlines() if line.startswith("#")] == [
        "# Model card: drawn",
        "## Training data",
        "## Figures on held-out runs",
        "## What it is not for",
        "## Notes of the evaluation",
        "## Files and time",
    ]


class Estimate(NamedTuple):
    value: float
    ci: tuple[float, float] | None


def test_figures_are_taken_as_the_report_has_them():
    report = SimpleNamespace(
        accuracy=0.8,
        accuracy_ci=(0.7, 0.9),
        confidence_auc=Estimate(0.81234, (0.75, 0.86)),
        accuracy_at_coverage={0.8: Estimate(0.91, (0.85, 0.95)), 0.5: Estimate(0.97, None)},
        ece=0.05,
        filter_delay_s=2.5,
        auroc_unknown=None,
    )
    assert [tuple(row) for row in figure_rows(report)] == [
        ("accuracy of single windows", "80.0%", "70.0% to 90.0%"),
        ("expected calibration error of the confidence", "5.0%", NOT_KNOWN),
        ("area from confidence to correctness", "0.812", "0.750 to 0.860"),
        ("accuracy of the most certain windows at 0.8", "91.0%", "85.0% to 95.0%"),
        ("accuracy of the most certain windows at 0.5", "97.0%", NOT_KNOWN),
        ("delay of the filter in s", "2.500", NOT_KNOWN),
    ]


def test_limits_name_what_is_weak(card, make_report):
    limits = " ".join(card(make_report()).limits)
    assert "Decisions that rest on GRASS: recognised in under half of the windows." in limits
    assert "Speeds outside of 0." in limits


def every_file(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_every_file_that_is_read_or_shown_is_covered_by_a_checksum(model_dir):
    document = json.loads((model_dir / INFO_FILE).read_text())
    covered = {"model.skops", "numbers.npz", INFO_FILE, *document["files_sha256"]}
    found = {path.relative_to(model_dir).as_posix() for path in every_file(model_dir)}
    assert found - covered == {"MLmodel"}
    assert {CARD_FILE, CARD_JSON, "requirements.txt"} <= covered


@pytest.mark.parametrize("read", [read_model, read_lean_model])
@pytest.mark.parametrize("harm", ["bit", "cut", "gone", "link out", "link within", "folder", "swapped"])
def test_any_file_that_is_harmed_is_named_in_one_sentence(model_dir, tmp_path, read, harm):
    rng = np.random.default_rng(0)
    for file in every_file(model_dir):
        if file.name in ("MLmodel", INFO_FILE):
            continue
        whole = file.read_bytes()
        if harm == "bit":
            content = bytearray(whole)
            content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
            file.write_bytes(bytes(content))
        elif harm == "cut":
            file.write_bytes(whole[: len(whole) // 2])
        elif harm == "swapped":
            other = next(each for each in every_file(model_dir) if each.name not in (file.name, "MLmodel"))
            file.write_bytes(other.read_bytes())
        else:
            file.unlink()
        if harm == "link out":
            (tmp_path / "elsewhere").write_bytes(whole)
            file.symlink_to(tmp_path / "elsewhere")
        elif harm == "link within":
            file.symlink_to(file)
        elif harm == "folder":
            file.mkdir()
        with pytest.raises(ModelError) as refusal:
            read(model_dir)
        assert "\n" not in str(refusal.value)
        if file.is_dir() and not file.is_symlink():
            file.rmdir()
        file.unlink(missing_ok=True)
        file.write_bytes(whole)
    read(model_dir)


@pytest.mark.parametrize(
    "listed",
    [
        {"../outside": "ab"},
        {"/etc/passwd": "ab"},
        {"a\x00b": "ab"},
        {"x" * 5000: "ab"},
        {"": "ab"},
        {".": "ab"},
        {"model_card.md": 5},
        {"model_card.md": None},
        ["model_card.md"],
        "model_card.md",
        {str(i): "ab" for i in range(10**4)},
    ],
)
def test_a_list_of_files_of_a_stranger_is_one_sentence(model_dir, listed):
    file = model_dir / INFO_FILE
    file.write_text(json.dumps(json.loads(file.read_text()) | {"files_sha256": listed}))
    for read in (read_model, read_lean_model):
        with pytest.raises(ModelError) as refusal:
            read(model_dir)
        assert str(refusal.value).isprintable()
        assert len(str(refusal.value)) < 700


def test_the_limits_name_regimes_without_windows_and_predictions_without_support(card, in_tracked):
    report = in_tracked.crossval
    limits = card().limits
    empty = [row for row in report.support.rows if not row.windows]
    named = [text for text in limits if text.startswith("Regimes without a training window")]
    assert len(named) == bool(empty)
    assert all(f"{row.terrain} at {row.regime}" in named[0] for row in empty)
    part = report.support.accuracy.unsupported
    marked = [text for text in limits if text.startswith("Predictions that no training run supports")]
    assert len(marked) == (part.accuracy is not None)
    assert not any("support" in text for text in card(replace(report, support=None)).limits)


def test_a_regime_without_a_window_is_a_limit(card, in_tracked):
    report = in_tracked.crossval
    row = SupportRow("GRAVEL", "spin at 0.3 to 0.4 m/s", 0, 0, None)
    without = replace(report, support=report.support._replace(rows=(row,)))
    assert "Regimes without a training window: GRAVEL at spin at 0.3 to 0.4 m/s." in card(without).limits


REGIMES = ("straight at 0.1 to 0.3 m/s", "curve at 0.1 to 0.3 m/s")


def with_support(report, terrains, accuracy=0.931):
    """Return the report with the last terrain never driven in a curve."""
    rows = [
        SupportRow(name, regime, 42, 3, accuracy)
        if name != terrains[-1] or regime == REGIMES[0]
        else SupportRow(name, regime, 0, 0, None)
        for name in terrains
        for regime in REGIMES
    ]
    return replace(report, support=report.support._replace(rows=tuple(rows)))


def test_the_table_of_support_has_every_terrain_in_every_regime(card, in_tracked):
    texts = card(with_support(in_tracked.crossval, ("A|B", "GRASS"))).texts()
    lines = texts[CARD_FILE].splitlines()
    at = lines.index("## Support")
    table = [line for line in lines[at : at + 10] if line.startswith("|")]
    assert table == [
        "| driving | A\\|B | GRASS |",
        "|---|---|---|",
        "| straight at 0.1 to 0.3 m/s | 3/42 93% | 3/42 93% |",
        "| curve at 0.1 to 0.3 m/s | 3/42 93% | **none** |",
    ]
    rows = json.loads(texts[CARD_JSON])["support"]
    assert [row["regime"] for row in rows] == list(REGIMES)
    assert rows[1]["cells"][1] == {"terrain": "GRASS", "n_runs": 0, "n_windows": 0, "accuracy": None}
    assert "## Support" not in card(replace(in_tracked.crossval, support=None)).texts()[CARD_FILE]


def test_a_trained_model_shows_the_runs_and_windows_of_its_terrains(model_dir, in_tracked):
    rows = json.loads((model_dir / CARD_JSON).read_text())["support"]
    cells = [cell for row in rows for cell in row["cells"]]
    assert sum(cell["n_windows"] for cell in cells) == in_tracked.n_windows
    of_report = {(row.regime, row.terrain): row.accuracy for row in in_tracked.crossval.support.rows}
    assert {(r["regime"], c["terrain"]): c["accuracy"] for r in rows for c in r["cells"]} == of_report


def test_the_table_for_a_terminal_is_split_where_it_is_too_wide(card, in_tracked):
    names = tuple(f"TERRAIN_NUMBER_{i:02d}_OF_A_LONG_NAME" for i in range(12))
    rows = card(with_support(in_tracked.crossval, names, None)).support
    assert rows[0].cells[0].text == f"3/42 {NOT_KNOWN}"
    for width in (30, 80, 110, 400):
        console = Console(width=width, record=True, soft_wrap=True, markup=False, file=io.StringIO())
        tables = list(support_tables(rows, width))
        assert sum(len(table.columns) - 1 for table in tables) == 12
        for table in tables:
            console.print(table)
        text = console.export_text()
        assert text.count("none") == 1
        assert all(len(line.rstrip()) <= max(width, 60) for line in text.splitlines())
    assert list(support_tables((), 80)) == []
