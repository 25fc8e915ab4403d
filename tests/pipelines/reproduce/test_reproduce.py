"""Rows are complete, verdicts correct, the page self-contained; experiments give the known results."""

import io
import json
import math
import re
import sys
import types
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from rich.console import Console

from pipelines.reporting.json_file import as_json
from pipelines.reproduce import reproduce as frame
from pipelines.reproduce.danzi.camera_lost import camera_lost
from pipelines.reproduce.danzi.experiments import EXPERIMENTS
from pipelines.reproduce.danzi.observability import straight_line_rank
from pipelines.reproduce.danzi.slip_bias import slip_bias
from pipelines.reproduce.papers import PAPERS, assumed_numbers
from pipelines.reproduce.reproduce import reproduce
from pipelines.reproduce.results import Experiment, Finding, Paper, Picture, Row, Verdict, verdict_of
from pipelines.reproduce.screen import print_reproduction
from terrain.errors import ConfigError
from terrain.robots import load_robot

SEED = 3
FETCHING = {"src", "href", "srcset", "action", "data", "poster"}
VOID = {"meta", "img", "br"}


def row(**changes):
    values = {
        "what": "depth of the moor",
        "where": "figure 3",
        "printed": "1 to 2",
        "simulated": 1.5,
        "unit": "m",
        "verdict": Verdict.AS_PRINTED,
        "why": "It was measured.",
    }
    return Row(**(values | changes))


class Page(HTMLParser):
    """Collects words and fetched addresses, and checks that every tag is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.fetched, self.words = [], [], [], []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [value for name, value in attrs if name in FETCHING]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def printed(result):
    console = Console(record=True, markup=False, width=110, file=io.StringIO())
    print_reproduction(result, console)
    return console.export_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("reproduced")


@pytest.fixture(scope="module")
def danzi(folder):
    """All experiments of the thesis, with few and short runs."""
    steps = []
    found = reproduce("danzi", folder, SEED, lambda *step: steps.append(step), quick=True)
    assert steps == [("reproduce danzi", n, len(EXPERIMENTS)) for n in range(1, len(EXPERIMENTS) + 1)]
    return found


@pytest.fixture(scope="module")
def document(danzi):
    """The same as JSON."""
    return as_json(danzi)


@pytest.fixture
def moor(monkeypatch):
    """A paper with names that would break a page, and one figure."""

    def dig(seed, quick):
        hostile = row(
            what="<script>alert(1)</script> & [bold]peat[/bold]",
            where='"3" < 4',
            printed="5 < 6",
            why="a & b",
            unit="<m>",
            simulated=seed + 0.5,
            spread=(0.25, 9.0),
            beside={"<i>wet</i>": 1e-7},
        )
        return Finding([hostile, row(verdict=Verdict.DIFFERS)], [Picture("<b>peat</b>", Figure())])

    module = types.ModuleType("moor_experiments")
    module.EXPERIMENTS = (Experiment("Digging <deep>", dig),)
    monkeypatch.setitem(sys.modules, "moor_experiments", module)
    known = {"moor": Paper("The <moor>", "A. & B.", "moor_experiments", (("robots", "agrimaro"),))}
    monkeypatch.setattr(frame, "PAPERS", known)


@pytest.mark.parametrize(
    ("simulated", "printed", "spread", "verdict"),
    [
        (1.0, (1.0, 2.0), None, "as printed"),
        (2.0, (1.0, 2.0), None, "as printed"),
        (2.1, (1.0, 2.0), None, "differs"),
        (2.1, (1.0, 2.0), (1.5, 2.7), "differs"),  # an interval is compared with the mean
        (2.1, (1.6, 1.6), (1.5, 2.7), "as printed"),  # one printed number is of one run
        (2.1, (1.4, 1.4), (1.5, 2.7), "differs"),
        (0.1 + 0.2, (0.3, 0.3), None, "as printed"),
        (-0.3, (-0.5, -0.1), None, "as printed"),
        (0.0, (0.0, 0.0), None, "as printed"),
    ],
)
def test_a_number_agrees_inside_what_is_printed(simulated, printed, spread, verdict):
    assert verdict_of(simulated, printed, spread) == verdict


@pytest.mark.parametrize(
    "fault",
    [
        {"what": " "},
        {"why": ""},
        {"unit": ""},
        {"simulated": math.nan},
        {"beside": {"true": math.inf}},
        {"spread": (2.0, 1.0)},
        {"printed_interval": (math.nan, 1.0)},
    ],
)
def test_an_incomplete_row_is_refused(fault):
    with pytest.raises(ValueError, match=r"^row "):
        row(**fault)


def test_an_unknown_paper_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match=r"^there is no paper 'newton' to reproduce; there are danzi, "):
        reproduce("newton", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_page_is_self_contained_and_escapes(moor, tmp_path):
    result = reproduce("moor", tmp_path, seed=1)
    text = (tmp_path / "moor.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.fetched) == 1
    assert page.fetched[0].startswith("data:image/")
    assert not {"script", "i"} & set(page.tags)
    for words in (
        "<script>alert(1)</script> & [bold]peat[/bold]",
        '"3" < 4',
        "1.5 <m> (0.25 to 9)",
        "<i>wet</i>: 1·10⁻⁷",
        "Digging <deep>",
        "terrain reproduce moor --seed 1",
        "assumed: the thesis prints none",
    ):
        assert words in page.text, words
    assert text.count('class="weak"') == 1
    assert not re.search(r"url\(|@import", text)
    shown = printed(result)
    assert "[bold]peat[/bold]" in shown
    assert "1 differs" in shown


def test_assumed_numbers_are_those_with_an_assumed_source():
    names = {number.name for number in assumed_numbers([("robots", "agrimaro"), ("soils", "grass")])}
    assert {"mass_kg", "wheel_radius_m", "sensors.wheels_rate_hz", "friction_angle_rad"} <= names
    assert not {"track_m", "steering.dead_band_rad", "camera.lever_x_m"} & names


@pytest.mark.slow
def test_every_experiment_gives_complete_rows_and_a_page(danzi, document, folder):
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert {found["experiment"] for found in document["rows"]} == {one.title for one in EXPERIMENTS}
    whole = set(Row.__dataclass_fields__) | {"experiment"}
    assert all(set(found) == whole for found in document["rows"])
    assert document["verdicts"].keys() == {verdict.value for verdict in Verdict}
    assert sum(document["verdicts"].values()) == len(document["rows"])
    page = Page((folder / "danzi.html").read_text(encoding="utf-8"))
    assert all(found["what"] in page.text and found["why"] in page.text for found in document["rows"])
    assert page.text.count("Figure ") == len(page.fetched) == page.tags.count("img")
    assert PAPERS["danzi"].about in page.text
    assert "try it out" in page.text
    shown = printed(danzi)
    assert f"report: {folder / 'danzi.html'}" in shown.replace("\n", "")


def find(result, pattern):
    return [found for found in result["rows"] if re.search(pattern, found["what"])]


@pytest.mark.slow
def test_errors_of_the_thesis_are_corrected(document):
    (turn,) = find(document, "sharpest left turn")
    (rank,) = find(document, "Independent states")
    (yaw,) = find(document, "Yaw from the camera")
    (ahead,) = find(document, "Forward speed from the camera")
    (band,) = find(document, "dead band")
    assert {one["verdict"] for one in (turn, rank, yaw, ahead, band)} == {"corrected"}
    assert rank["simulated"] == 9
    assert (round(yaw["simulated"], 6), yaw["printed_interval"]) == (30.0, [-90.0, -90.0])
    assert ahead["simulated"] == pytest.approx(-ahead["printed_interval"][0])
    assert band["simulated"] == pytest.approx(0.021**2 / 3)


@pytest.mark.slow
def test_slip_agrees_with_the_thesis_and_with_its_corrections(document):
    (blind,) = find(document, "by the 12 states")
    assert abs(blind["simulated"]) < 0.01 < blind["beside"]["true slip"]
    for terrain in ("tiles", "grass", "firm soil gravel"):
        (steady,) = find(document, f"Steady slip on {terrain}, by")
        low, high = steady["printed_interval"]
        assert low <= steady["beside"]["true"] <= high
        assert steady["beside"]["vio15"] == pytest.approx(steady["beside"]["true"], abs=0.004)
        assert steady["verdict"] == ("as printed" if terrain == "tiles" else "assumed")
    for biased in find(document, "straight on|arc"):
        assert biased["simulated"] < 0.96 * biased["beside"]["true"]
    early, printed_remedy, matched = find(document, "Smallest slip")
    assert early["simulated"] < printed_remedy["simulated"] < -0.1 < matched["simulated"]
    thesis, vio15 = find(document, "without the camera, by")
    assert abs(thesis["simulated"]) < 0.01
    off = vio15["simulated"] - vio15["beside"]["true"]
    assert abs(off) < 3 * vio15["beside"]["standard deviation by the filter"]


@pytest.mark.slow
def test_table_8_1_is_reproduced_and_its_iteration_corrected(document):
    cases = find(document, "Rate sent to the wheel, case")
    assert [case["verdict"] for case in cases] == ["as printed"] * 8
    assert [round(case["simulated"], 3) for case in cases] == [case["printed_interval"][0] for case in cases]
    oscillating, normalised = find(document, "Fraction of the")
    assert {oscillating["verdict"], normalised["verdict"]} == {"corrected"}
    assert oscillating["simulated"] == pytest.approx(1.0)
    assert normalised["spread"] == pytest.approx([0.5, 0.56], abs=0.005)


@pytest.mark.slow
def test_terrain_recognition_has_the_honest_figure_beside_the_one_by_windows(document):
    rows = [found for found in document["rows"] if "8.1" in found["experiment"]]
    at_random, by_run, weakest, level, difficulty = rows
    assert {at_random["verdict"], by_run["verdict"], level["verdict"]} == {"not printed"}
    assert by_run["simulated"] < at_random["simulated"]
    assert by_run["spread"][0] <= by_run["simulated"] <= by_run["spread"][1]
    assert weakest["simulated"] == min(weakest["beside"].values())
    assert level["simulated"] > by_run["simulated"]
    assert difficulty["verdict"] == "as printed"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_rows_and_another_others(document):
    for experiment, run in (("zero-slip wheel rows", slip_bias), ("Loss of the camera", camera_lost)):
        rows = [found for found in document["rows"] if experiment in found["experiment"]]
        assert rows
        again = run(SEED, True).rows
        assert [found["simulated"] for found in rows] == [found.simulated for found in again]
        assert [found["why"] for found in rows] == [found.why for found in again]
    assert [found.simulated for found in slip_bias(SEED + 1, True).rows] != [
        found["simulated"] for found in document["rows"] if "zero-slip wheel rows" in found["experiment"]
    ]


@pytest.mark.parametrize(
    ("name", "as_printed", "expected"),
    [
        ("slip14", True, (9, 12)),
        ("slip14", False, (10, 12)),
        ("vio12", False, (10, 10)),
        ("vio15", False, (16, 16)),
    ],
)
def test_all_states_are_observable_only_with_a_speed_over_ground(name, as_printed, expected):
    assert straight_line_rank(name, load_robot("agrimaro"), as_printed) == expected
