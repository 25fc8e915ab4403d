"""Tazzari et al., few and short runs: complete rows, a page, and the known results."""

import re

import pytest

from pipelines.reporting.json_file import as_json
from pipelines.reproduce.papers import PAPERS
from pipelines.reproduce.reproduce import reproduce
from pipelines.reproduce.tazzari.compensation import closed_loop
from pipelines.reproduce.tazzari.experiments import EXPERIMENTS
from pipelines.reproduce.tazzari.misprints import misprints
from pipelines.reproduce.tazzari.runs import seeds

SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("reproduced")


@pytest.fixture(scope="module")
def document(folder):
    """All experiments as JSON."""
    return as_json(reproduce("tazzari", folder, SEED, quick=True))


def find(document, pattern):
    return [row for row in document["rows"] if re.search(pattern, row["what"])]


def one(document, pattern):
    (row,) = find(document, pattern)
    return row


@pytest.mark.slow
def test_every_experiment_gives_rows_and_a_page(document, folder):
    assert {row["experiment"] for row in document["rows"]} == {each.title for each in EXPERIMENTS}
    page = (folder / "tazzari.html").read_text(encoding="utf-8")
    assert page.count("<img") == 10
    assert PAPERS["tazzari"].about in page


@pytest.mark.slow
def test_estimates_converge_as_the_paper_claims(document):
    for row in find(document, "^Position error of the observer|^Error of the efficiencies, "):
        assert row["verdict"] == "as printed"
    for speed, bar_s in ((0.3, 30.0), (0.6, 7.0), (1, 4.0)):
        assert one(document, f"at {speed} m/s, L and Lambda")["simulated"] <= bar_s
        assert one(document, f"at {speed} m/s, normalised")["beside"]["within 2 %"] <= 4.0
    for row in find(document, "raw fixes of 2 cm"):
        assert row["simulated"] <= 0.005 < 2 * row["beside"]["normalised gain"]


def test_misprints_are_corrected():
    regressor, lyapunov = misprints(SEED, True).rows
    assert {regressor.verdict, lyapunov.verdict} == {"corrected"}
    assert regressor.beside["rank as printed"] == 1
    assert regressor.beside["with (11) as printed"] == pytest.approx(0.13)
    assert regressor.simulated < 1e-5
    assert lyapunov.simulated == pytest.approx(1.0)
    assert lyapunov.beside["with V as printed"] > 2


@pytest.mark.slow
def test_a_bound_holds_and_the_model_has_no_motion_sideways(document):
    for row in find(document, "under disturbances"):
        assert row["simulated"] < row["beside"]["bound"] < 10 * row["simulated"]
    assert one(document, "^Speed sideways.*circle")["verdict"] == "differs"
    assert one(document, "^Speed sideways.*straight")["verdict"] == "as printed"
    inverse = one(document, "inverted")
    assert inverse["simulated"] == pytest.approx(inverse["beside"]["simulated vehicle"], rel=0.01)
    assert one(document, "at rest")["simulated"] == 0
    # of the forward speed the noise of a normalised gain, 0.5 % of 0.5 m/s, is most of what is left
    for quantity, least in (("Forward", 1.5), ("Turning", 5.0)):
        held = one(document, f"{quantity} speed, root mean square")
        assert least * held["simulated"] < held["beside"]["without compensation"]


def test_the_same_seed_gives_the_same_drive_and_another_another():
    first, again, other = (closed_loop(seed, 1.0, True) for seed in (*seeds(1, True)[:1], *seeds(1, True)))
    assert first.speed.tobytes() == again.speed.tobytes()
    assert first.speed.tobytes() != other.speed.tobytes()
