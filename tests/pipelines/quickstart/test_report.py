"""The page says what the result says, is self-contained, and survives what is missing."""

import re
from html.parser import HTMLParser

import pytest

from pipelines.classify.figures import confusion_figure
from pipelines.quickstart.report import CAPTIONS, html_report, versions
from pipelines.reporting.drawing import NOT_KNOWN

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


def per_run(run_id, terrain, n_windows, accuracy):
    return {
        "run_id": run_id,
        "terrain": terrain,
        "n_windows": n_windows,
        "accuracy": accuracy,
        "vote_accuracy": accuracy,
        "mistaken_for": None,
    }


def per_class(recall, n_windows):
    return {"precision": 0.61, "recall": recall, "f1": 0.52, "n_windows": n_windows}


def window(run_id, terrain, traction=0.1):
    slip = {"traction": traction, "braking": -0.07, "steady": None}
    return {
        "run_id": run_id,
        "start_s": 0.0,
        "terrain": terrain,
        "probability": 0.9,
        "target_slip": slip,
        "status": dict.fromkeys(slip, "unestimated"),
    }


@pytest.fixture
def result():
    return {
        "dataset": "moor & <fen>",
        "crossval": {
            "protocol": "grouped",
            "recipe": "svm",
            "window_s": 2.0,
            "signal_sets": ["imu", "wheels"],
            "seed": 0,
            "classes": ["GRASS", "ICE"],
            "n_windows": 40,
            "n_runs": 3,
            "repeats": 4,
            "accuracy": 0.81335,
            "accuracy_spread": 0.01234,
            "accuracy_ci": [0.7236, 0.9079],
            "balanced_accuracy": 0.77139,
            "macro_f1": 0.7844,
            "vote_accuracy": 0.82131,
            "ece": 0.10776,
            "per_class": {"GRASS": per_class(0.45, 60), "ICE": per_class(0.95, 100)},
            "confusion": [[27, 33], [5, 95]],
            "per_run": [
                per_run("<b>g1</b>", "GRASS", 10, 0.3),
                per_run("g2", "GRASS", 5, 0.75),
                per_run("i1", "ICE", 25, 0.95),
            ],
            "n_features": 12,
            "dropped": {"not steady": 7},
            "notes": ["ICE: one run only & optimistic"],
            "speed_only_accuracy": 0.4115,
            "slow_fast": {
                "status": "not applicable",
                "classes": {"GRASS": {"slow_mps": 0.2, "fast_mps": 0.4}},
                "left_out": {"ICE": "48 s of slow runs"},
                "slow_to_fast": None,
                "fast_to_slow": None,
            },
            "learning_curve": {
                "runs_per_class": [1.0],
                "accuracy": [0.8],
                "accuracy_spread": [None],
                "enough_runs": None,
                "statement": "1 sizes are too few to tell",
            },
        },
        "train": {
            "model_uri": "models:/moor/3",
            "version": "3",
            "alias_moved": False,
            "alias_reason": "macro F1 0.78 is not better than 0.80",
            "run_id": "cafe01",
        },
        "predict": {
            "accuracy": 0.9871,
            "n_windows": 4,
            "n_unknown_labels": 2,
            "windows": [
                window("<b>g1</b>", "ICE"),
                window("<b>g1</b>", "ICE"),
                window("<b>g1</b>", "GRASS", 0.2),
                window("new", "GRASS", 0.2),
            ],
            "table": {
                "GRASS": {
                    "traction": 0.2, "braking": -0.07, "steady": None, "status": "unestimated",
                    "source": "assumed",
                },
                "ICE": {
                    "traction": 0.1, "braking": -0.07, "steady": 0.02, "status": "estimated",
                    "source": "Field & Lab 2020",
                },
            },
        },
        "data_digest": "d1ge57",
        "commit": "abc123",
        "seed": 0,
        "created": "2025-01-02",
        "elapsed_s": 131.4,
        "commands": ["terrain quickstart --data 'a < b'"],
        "versions": {"numpy": "2.4"},
    }  # fmt: skip


def test_headline_numbers_are_rounded_to_one_decimal_of_a_percent(result):
    text = Page(html_report(result, {})).text
    for said in (
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
        assert said in re.sub(r" ([.,])", r"\1", text)
    headline = text[: text.index("Read this first")]
    assert set(re.findall(r"\d+(?:\.\d+)?%", headline)) - {"0%", "50%", "100%", "95%"} == set(
        re.findall(r"\d+\.\d%", headline)
    )


def test_the_page_fetches_nothing_and_runs_nothing(result):
    html = html_report(result, {"confusion": confusion_figure(result["crossval"])})
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


def test_notes_and_extras_are_said(result):
    text = Page(html_report(result, {})).text
    for said in (
        "ICE: one run only & optimistic.",
        "Not applicable: 1 terrain with enough slow and fast runs, 3 are needed. "
        "Left out: ICE (48 s of slow runs).",
        "1 sizes are too few to tell.",
        "Wrong more often than right: GRASS.",
    ):
        assert said in text


def test_slow_and_fast_are_said_where_they_apply(result):
    result["crossval"]["slow_fast"] |= {
        "status": "applicable",
        "slow_to_fast": 0.7335,
        "fast_to_slow": 0.6928,
    }
    text = Page(html_report(result, {})).text
    assert "tested on the fast ones: 73.4% ; the other way: 69.3%" in text
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
            NOT_KNOWN,
            "unestimated",
        ]
    ]
    assert page.row("new")[0][:6] == ["new", NOT_KNOWN, "1", "GRASS (100%)", NOT_KNOWN, NOT_KNOWN]
    assert "2 windows carry a label that the model never saw" in page.text
    assert "What to expect of new runs is the held-out figure: 81.3%" in page.text


def test_labels_of_windows_go_before_those_of_cross_validation(result):
    windows = result["predict"]["windows"]
    windows[0]["label"], windows[3]["label"] = "ICE", "MUD"
    page = Page(html_report(result, {}))
    assert page.row("<b>g1</b>")[0][4] == "66.7%"
    assert page.row("new")[0][1:6] == ["MUD", "1", "GRASS (100%)", NOT_KNOWN, NOT_KNOWN], "never learned"


def test_a_terrain_without_a_target_slip_names_the_fallback(result):
    result["predict"]["table"]["ICE"]["entry"] = "unknown"
    row = Page(html_report(result, {})).row("ICE")[-1]
    assert row[-1] == "no entry of its own, fallback 'unknown': Field & Lab 2020"


def test_target_slip_names_status_and_source_and_what_is_assumed(result):
    page = Page(html_report(result, {}))
    assert page.row("ICE")[-1] == ["ICE", "0.100", MINUS_0_07, "0.020", "estimated", "Field & Lab 2020"]
    assert "1 of 2 entries have no measured runs behind them" in page.text


def test_model_and_provenance_are_there(result):
    text = Page(html_report(result, {})).text
    for said in (
        "models:/moor/3",
        "the champion stays what it was: macro F1 0.78 is not better than 0.80",
        "d1ge57",
        "abc123",
        "7 not steady",
        "2 min 11 s",
        "numpy 2.4",
    ):
        assert said in text


def test_without_what_may_be_missing_the_page_still_stands(result):
    crossval = result["crossval"]
    for name in ("speed_only_accuracy", "slow_fast", "learning_curve", "notes", "dropped"):
        del crossval[name]
    crossval["accuracy_spread"] = None
    bare = dict.fromkeys(result) | {"crossval": crossval}
    text = Page(html_report(bare, {})).text
    assert "81.3%" in text
    assert "None" not in text
    for heading in ("Read this first", "Figures", "The model", "Predictions", "Target slip", "To reproduce"):
        assert heading not in text
    assert html_report({"crossval": crossval}, {}) == html_report(bare, {})


def test_numbers_missing_from_predictions_are_dashes(result):
    result["predict"] |= {"accuracy": None, "table": None}
    result["predict"]["windows"][3] |= {"target_slip": None, "probability": None, "status": None}
    page = Page(html_report(result, {}))
    assert page.row("new")[0][-4:] == [NOT_KNOWN] * 4
    assert "None" not in page.text


def test_the_published_protocol_is_called_what_it_is(result):
    result["crossval"]["protocol"] = "published"
    assert "for comparison with papers only" in Page(html_report(result, {})).text


def test_same_result_gives_the_same_page(result):
    pages = [html_report(result, {"confusion": confusion_figure(result["crossval"])}) for _ in range(2)]
    assert pages[0] == pages[1]


def test_versions_name_python_and_what_computes():
    assert {"python", "numpy", "scikit-learn"} <= versions().keys()
