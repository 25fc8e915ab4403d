"""The page shows the figures of the result, is self-contained, and does without what is missing."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from pipelines.crossval.results import Applicability
from pipelines.crossval_figures.figures import confusion_figure
from pipelines.estimate.consistency import TerrainConsistency
from pipelines.learn.predict import Predictions, TargetSlipRow, WindowPrediction
from pipelines.learn.tracking import Registered
from pipelines.learn.train import TrainResult
from pipelines.quickstart.page import CAPTIONS, html_report
from pipelines.quickstart.results import KeptRuns, QuickstartResult
from pipelines.reporting.numbers import NOT_KNOWN
from pipelines.reporting.versions import versions
from terrain.control.comparison import MeanInterval
from terrain.estimation.labelled import TerrainSlip

MINUS_0_07 = "\N{MINUS SIGN}0.070"
VOID = {"meta", "img", "br"}
FETCHING = {"src", "href", "srcset", "action", "data", "poster"}


class Page(HTMLParser):
    """Collects text and fetched addresses and checks that every tag is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.fetched, self.words, self.rows = [], [], [], [], []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [value for name, value in attrs if name in FETCHING]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.words.append(data)
        if self.open and any(tag in ("td", "th") for tag in self.open):
            self.rows[-1][-1] += data

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def row(self, first):
        return [row for row in self.rows if row[0] == first]


def window(run_id, terrain, traction=0.1, label=None):
    slip = {"traction": traction, "braking": -0.07, "steady": 0.02}
    return WindowPrediction(
        run_id, 0.0, terrain, 0.9, slip, terrain, dict.fromkeys(slip, "unestimated"), label
    )


@pytest.fixture
def result(make_report):
    report = make_report().named("moor & <fen>", "d1ge57")
    table = {
        "GRASS": TargetSlipRow(0.2, -0.07, 0.0, "GRASS", "unestimated", "assumed"),
        "ICE": TargetSlipRow(0.1, -0.07, 0.02, "ICE", "estimated", "Field & Lab 2020"),
    }
    windows = (
        window("<b>g1</b>", "ICE"),
        window("<b>g1</b>", "ICE"),
        window("<b>g1</b>", "GRASS", 0.2),
        window("new", "GRASS", 0.2),
    )
    predicted = Predictions(
        windows, 4, 2, ("GRASS", "ICE"), 0.9871, 2, (), {}, {"LAVA": 2}, 2, {}, "default", table
    )
    registered = Registered("models:/moor/3", "3", "cafe01", False, "macro F1 0.78 is not better than 0.80")
    return QuickstartResult(
        dataset="moor & <fen>",
        data_digest="d1ge57",
        commit="abc123",
        seed=0,
        crossval=report,
        train=TrainResult(*registered, "moor & <fen>", "d1ge57", "abc123", 40, {}, (), report),
        predict=predicted,
        imported=KeptRuns(Path("out/runs"), 3, reused=False),
        slip=None,
        consistency=None,
        commands=("terrain quickstart --data 'a < b'",),
        report=Path("out/report.html"),
        created="2025-01-02",
        elapsed_s=131.4,
    )


def with_report(result, **changed):
    return replace(result, crossval=replace(result.crossval, **changed))


def test_headline_numbers_are_rounded_to_one_decimal_of_a_percent(result):
    text = Page(html_report(result, {})).text
    for sentence in (
        "81.3% of windows classified correctly, whole runs held out, except ICE",
        "95% interval over runs: 72.4% to 90.8%",
        "Over 4 fold assignments it spreads by ±1.2 points",
        "balanced accuracy 77.1%",
        "macro F1 78.4%",
        "vote accuracy 82.1%",
        "calibration error 10.8%",
        "always the most frequent terrain 62.5%",
        "speed alone 41.1%",
    ):
        assert sentence in re.sub(r" ([.,])", r"\1", text)
    headline = text[: text.index("Read this first")]
    assert set(re.findall(r"\d+(?:\.\d+)?%", headline)) - {"0%", "50%", "100%", "95%"} == set(
        re.findall(r"\d+\.\d%", headline)
    )


def test_the_page_fetches_nothing_and_runs_nothing(result):
    html = html_report(result, {"confusion": confusion_figure(result.crossval)})
    page = Page(html)
    assert {address.split(";")[0] for address in page.fetched} == {"data:image/svg+xml"}
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert not re.search(r"https?://|url\(|@import|<script", html)
    assert CAPTIONS["confusion"] in page.text


def test_text_from_the_data_is_escaped(result):
    html = html_report(result, {})
    assert "<b>g1" not in html
    assert "<fen>" not in html
    page = Page(html)
    assert len(page.row("<b>g1</b>")) == 1
    assert "Terrain classification: moor & <fen>" in page.text
    assert "--data 'a < b'" in page.text


def test_notes_and_extras_are_shown(result):
    text = Page(html_report(result, {})).text
    for sentence in (
        "ICE: one run only & optimistic.",
        "Not applicable: 1 terrain with enough slow and fast runs, 3 are needed. "
        "Left out: ICE (48 s of slow runs).",
        "3 sizes are too few to estimate how many runs are enough.",
        "Wrong more often than right: GRASS.",
    ):
        assert sentence in text


def test_slow_and_fast_are_compared_where_they_apply(result):
    extras = result.crossval.extras
    split = extras.slow_fast._replace(
        status=Applicability.APPLICABLE, slow_to_fast=0.7335, fast_to_slow=0.6928
    )
    text = Page(html_report(with_report(result, extras=extras._replace(slow_fast=split)), {})).text
    assert "tested on the fast ones: 73.4% ; the reverse: 69.3%" in text
    assert "GRASS 0.20 and 0.40 m/s" in text


def test_each_terrain_has_runs_windows_of_a_repeat_and_its_worst_confusion(result):
    rows = Page(html_report(result, {})).row("GRASS")
    assert rows[0] == ["GRASS", "2", "15", "45.0%", "61.0%", "52.0%", "ICE (55.0%)"]


def test_predictions_are_summed_up_by_run(result):
    page = Page(html_report(result, {}))
    assert page.row("<b>g1</b>") == [
        [
            "<b>g1</b>",
            "GRASS",
            "3",
            "ICE (67%)",
            "33.3%",
            "30.0%",
            "0.100",
            MINUS_0_07,
            "0.020",
            "unestimated",
        ]
    ]
    assert page.row("new")[0][:6] == ["new", NOT_KNOWN, "1", "GRASS (100%)", NOT_KNOWN, NOT_KNOWN]
    assert "2 windows have a label that the model was not trained on" in page.text
    assert "What to expect of new runs is the held-out figure: 81.3%" in page.text


def test_labels_of_windows_go_before_those_of_cross_validation(result):
    windows = list(result.predict.windows)
    windows[0], windows[3] = windows[0]._replace(label="ICE"), windows[3]._replace(label="MUD")
    labelled = replace(result, predict=replace(result.predict, windows=tuple(windows)))
    page = Page(html_report(labelled, {}))
    assert page.row("<b>g1</b>")[0][4] == "66.7%"
    assert page.row("new")[0][1:6] == ["MUD", "1", "GRASS (100%)", NOT_KNOWN, NOT_KNOWN], "not trained on"


def test_a_terrain_without_a_target_slip_names_the_fallback(result):
    table = dict(result.predict.table)
    table["ICE"] = table["ICE"]._replace(entry="unknown")
    row = Page(html_report(replace(result, predict=replace(result.predict, table=table)), {})).row("ICE")[-1]
    assert row[-1] == "no entry of its own, fallback 'unknown': Field & Lab 2020"


def test_target_slip_names_status_and_source_and_what_is_assumed(result):
    page = Page(html_report(result, {}))
    assert page.row("ICE")[-1] == ["ICE", "0.100", MINUS_0_07, "0.020", "estimated", "Field & Lab 2020"]
    assert "1 of 2 entries are not estimated from measured runs" in page.text


def test_model_and_provenance_are_there(result):
    text = Page(html_report(result, {})).text
    for sentence in (
        "models:/moor/3",
        "the champion remains as it was: macro F1 0.78 is not better than 0.80",
        "d1ge57",
        "abc123",
        "7 not steady",
        "2 min 11 s",
        f"numpy {versions()['numpy']}",
    ):
        assert sentence in text


def test_without_what_may_be_missing_the_page_is_complete(result):
    bare = with_report(result, extras=None, notes=(), dropped={}, accuracy_spread=None)
    bare = replace(bare, predict=replace(bare.predict, accuracy=None, n_unknown_labels=0), commands=())
    page = Page(html_report(bare, {}))
    assert "81.3%" in page.text
    assert "None" not in page.text
    assert "left out: none" in page.text
    for heading in (
        *("Read this first", "Figures", "does not say", "From logs to slip", "To reproduce"),
        *("Accuracy against their labels", "does not measure its skill", "fold assignments"),
    ):
        assert heading not in page.text


def test_slip_of_simulated_runs_is_beside_its_truth(result):
    rows = (
        TerrainSlip("grass", 6, 0.0421, 0.0433, 0.00123, 1.118),
        TerrainSlip("sand", 6, None, None, None, None),
    )
    page = Page(html_report(replace(result, slip=rows), {}))
    assert "From logs to slip" in page.text
    assert page.row("grass") == [["grass", "6", "0.042", "0.043", "0.0012", "1.12"]]
    assert page.row("sand") == [["sand", "6", *[NOT_KNOWN] * 4]]


def test_consistency_is_shown_by_terrain_and_group(result):
    known, alone = MeanInterval(4.9, (1.2, 8.6), 12), MeanInterval(0.25, None, 1)
    none = MeanInterval(None, None, 0)
    rows = (
        TerrainConsistency("tilled_loam", 12, {"speed": known, "gyro_bias": alone}, known),
        TerrainConsistency("tiles", 1, {"speed": none, "gyro_bias": alone}, alone),
    )
    page = Page(html_report(replace(result, consistency=rows), {}))
    assert "survey, starts and complex" in page.text
    assert page.row("tilled_loam") == [["tilled_loam", "12", "4.91.2 to 8.6", "0.25", "4.91.2 to 8.6"]]
    assert page.row("tiles") == [["tiles", "1", NOT_KNOWN, "0.25", "0.25"]]
    assert "uncertainty can be believed" not in Page(html_report(result, {})).text


def test_the_published_protocol_is_named_as_such(result):
    published = with_report(result, protocol="published")
    assert "for comparison with papers only" in Page(html_report(published, {})).text


def test_same_result_gives_the_same_page(result):
    pages = [html_report(result, {"confusion": confusion_figure(result.crossval)}) for _ in range(2)]
    assert pages[0] == pages[1]


def test_versions_name_python_and_what_computes():
    assert {"python", "numpy", "scikit-learn"} <= versions().keys()
