"""Papers: rules and rows, each paper with few and short runs, and the known results."""

import doctest
import math
import re
import runpy
import sys
from pathlib import Path

import claims
import danzi
import deremetz
import pytest
import tazzari
import yamauchi

from pipelines.report.pages import html_page
from terrain.control.car_following import SlipSource
from terrain.errors import ConfigError
from terrain.robots import load_robot

FOLDER, SEED = Path(__file__).parents[2] / "examples" / "papers", 3


def rows(paper, *only, seed=SEED):
    return claims.reproduce(paper, seed, quick=True, only=only).rows


def find(found, pattern):
    return [row for row in found if re.search(pattern, row.what)]


def one(found, pattern):
    (row,) = find(found, pattern)
    return row


def test_the_examples_of_docstrings_run():
    for module in (claims, danzi, deremetz, tazzari, yamauchi):
        assert doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE).failed == 0


@pytest.mark.parametrize(
    ("simulated", "printed", "spread", "agrees"),
    [
        (1.0, (1.0, 2.0), None, True),
        (2.0, (1.0, 2.0), None, True),
        (2.1, (1.0, 2.0), None, False),
        (2.1, (1.0, 2.0), (1.5, 2.7), False),  # an interval is compared with the mean
        (2.1, (1.6, 1.6), (1.5, 2.7), True),  # one printed number is of one run
        (2.1, (1.4, 1.4), (1.5, 2.7), False),
        (0.1 + 0.2, (0.3, 0.3), None, True),
        (-0.3, (-0.5, -0.1), None, True),
        (0.0, (0.0, 0.0), None, True),
    ],
)
def test_a_number_agrees_inside_what_is_printed(simulated, printed, spread, agrees):
    assert claims.agrees(simulated, printed, spread) is agrees


@pytest.mark.parametrize(
    "fault",
    [
        *({"what": " "}, {"why": ""}, {"unit": ""}, {"simulated": math.nan}, {"spread": (2.0, 1.0)}),
        *({"beside": {"true": math.inf}}, {"printed_interval": (math.nan, 1.0)}),
    ],
)
def test_an_incomplete_row_is_refused(fault):
    texts = dict.fromkeys(("experiment", "what", "where", "printed", "unit", "why"), "depth")
    whole = {**texts, "simulated": 1.5, "verdict": claims.Verdict.AS_PRINTED}
    claims.Row(**whole)
    with pytest.raises(ValueError, match=r"^row "):
        claims.Row(**(whole | fault))


def test_a_claim_without_its_number_and_an_unknown_paper_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match=r"claims and numbers differ: \{'depth'\}"):
        claims.rows_of("moor", {"depth": {}}, claims.Finding({}))
    with pytest.raises(ConfigError, match="no paper 'newton' to reproduce; there are danzi, deremetz, tazz"):
        claims.reproduce("newton")


def test_the_papers_are_listed_and_an_unknown_one_is_exit_code_2(monkeypatch, capsys):
    for arguments, exit_code in (([], 0), (["newton"], 2)):
        monkeypatch.setattr(sys, "argv", [str(FOLDER), *arguments])
        with pytest.raises(SystemExit) as stopped:
            runpy.run_path(str(FOLDER), run_name="__main__")
        assert stopped.value.code == exit_code
    listed = capsys.readouterr().out
    assert [line.split()[0] for line in listed.splitlines()] == ["danzi", "deremetz", "tazzari", "yamauchi"]
    assert "Deremetz et al., ICRA 2017: 5 experiments" in listed


def test_assumed_numbers_are_those_with_an_assumed_source():
    names = {number.name for number in claims.assumed_numbers(["robots/agrimaro", "soils/grass"])}
    assert {"mass_kg", "wheel_radius_m", "sensors.wheels_rate_hz", "friction_angle_rad"} <= names
    assert not {"track_m", "steering.dead_band_rad", "camera.lever_x_m"} & names


@pytest.mark.slow
@pytest.mark.parametrize(
    ("paper", "n_rows", "n_figures"),
    [("danzi", 45, 10), ("tazzari", 28, 10), ("yamauchi", 35, 6), ("deremetz", 20, 9)],
)
def test_every_experiment_gives_its_rows_and_figures(paper, n_rows, n_figures, tmp_path):
    steps = []
    result = claims.reproduce(paper, SEED, lambda *step: steps.append(step), quick=True)
    assert [step[1] for step in steps] == list(range(1, steps[0][2] + 1))
    assert (len(result.rows), len(result.figures)) == (n_rows, n_figures)
    assert sum(result.verdicts.values()) == n_rows
    assert all(figure.caption for figure in result.figures)
    report = claims.report_of(result)
    assert "try it out" in report.answer
    assert result.rows[0].why in str(report.details)
    assert result.about in html_page(report).replace("&#39;", "'")
    JUDGE[paper](result.rows)


def judge_danzi(found):
    corrected = (
        "sharpest left turn|Independent states|Yaw from the camera|Forward speed from the camera|dead band"
    )
    assert [row.verdict for row in find(found, corrected)] == ["corrected"] * 5
    assert one(found, "Independent states").simulated == 9
    yaw = one(found, "Yaw from the camera")
    assert (round(yaw.simulated, 6), yaw.printed_interval) == (30.0, (-90.0, -90.0))
    assert one(found, "dead band").simulated == pytest.approx(0.021**2 / 3)
    blind = one(found, "by the 12 states")
    assert abs(blind.simulated) < 0.01 < blind.beside["true slip"]
    for terrain in ("tiles", "grass", "firm soil gravel"):
        steady = one(found, f"Steady slip on {terrain}, by")
        low, high = steady.printed_interval
        assert low <= steady.beside["true"] <= high
        assert steady.beside["vio15"] == pytest.approx(steady.beside["true"], abs=0.004)
        assert steady.verdict == ("as printed" if terrain == "tiles" else "assumed")
    for biased in find(found, "straight on|arc"):
        assert biased.simulated < 0.96 * biased.beside["true"]
    early, remedy, matched = find(found, "Smallest slip")
    assert early.simulated < remedy.simulated < -0.1 < matched.simulated
    thesis, vio15 = find(found, "without the camera, by")
    assert abs(thesis.simulated) < 0.01
    off = vio15.simulated - vio15.beside["true"]
    assert abs(off) < 3 * vio15.beside["standard deviation by the filter"]
    at_random, by_run, weakest, level, difficulty = (row for row in found if "8.1" in row.experiment)
    assert by_run.simulated < at_random.simulated
    assert by_run.spread[0] <= by_run.simulated <= by_run.spread[1]
    assert weakest.simulated == min(weakest.beside.values())
    assert level.simulated > by_run.simulated
    assert difficulty.verdict == "as printed"


def judge_tazzari(found):
    for row in find(found, "^Position error of the observer|^Error of the efficiencies, "):
        assert row.verdict == "as printed"
    for speed, bar_s in ((0.3, 30.0), (0.6, 7.0), (1, 4.0)):
        assert one(found, f"at {speed} m/s, L and Lambda").simulated <= bar_s
        assert one(found, f"at {speed} m/s, normalised").beside["within 2 %"] <= 4.0
    for row in find(found, "raw fixes of 2 cm"):
        assert row.simulated <= 0.005 < 2 * row.beside["normalised gain"]
    for row in find(found, "under disturbances"):
        assert row.simulated < row.beside["bound"] < 10 * row.simulated
    assert one(found, "^Speed sideways.*circle").verdict == "differs"
    assert one(found, "^Speed sideways.*straight").verdict == "as printed"
    inverse = one(found, "inverted")
    assert inverse.simulated == pytest.approx(inverse.beside["simulated vehicle"], rel=0.01)
    assert one(found, "at rest").simulated == 0
    for quantity, least in (("Forward", 1.5), ("Turning", 5.0)):
        driven = one(found, f"{quantity} speed, root mean square")
        assert least * driven.simulated < driven.beside["without compensation"]


def judge_yamauchi(found):
    row = one(found, "Error of n where the simulator")
    assert max(abs(error) for error in row.beside.values()) <= 0.02
    gains = find(found, "^Fall of the position RMSE against .* with drift in turns")
    assert len(gains) == 4
    for row in gains:
        assert row.spread[0] > 0.5
        assert min(row.beside.values()) > 0.5
        assert "0.5 is exceeded" in row.why
    plain = one(found, "against gyrodometry, as printed, turning uphill")
    assert plain.printed_interval == (0.685, 0.685)
    assert one(found, "judged turning downhill").simulated < 0 < plain.simulated
    row = one(found, "Exponent n by fixes")
    assert abs(row.simulated - row.beside["by cameras"]) < 3 * row.beside["std"] + 0.05
    assert all(gain.simulated > 0.5 for gain in find(found, "without fixes"))


def judge_deremetz(found):
    assert one(found, "^Largest lateral error at 5 m/s, multi-model$").verdict == "as printed"
    assert one(found, "^Largest lateral error at 5 m/s, no observer$").simulated > 0.5
    assert one(found, "^Largest lateral error at 6 m/s with the preview$").spread[1] < 0.6
    assert one(found, "^Smallest cornering stiffness").verdict == "corrected"
    for row in find(found, "^Median error of the cornering stiffness"):
        assert row.spread[1] < 0.2


JUDGES = judge_danzi, judge_tazzari, judge_yamauchi, judge_deremetz
JUDGE = {judge.__name__.removeprefix("judge_"): judge for judge in JUDGES}


def test_table_8_1_is_reproduced_and_its_iteration_corrected():
    *cases, oscillating, normalised = rows("danzi", "traction_control")
    assert [case.verdict for case in cases] == ["as printed"] * 8
    assert [round(case.simulated, 3) for case in cases] == [case.printed_interval[0] for case in cases]
    assert {oscillating.verdict, normalised.verdict} == {"corrected"}
    assert oscillating.simulated == pytest.approx(1.0)
    assert normalised.spread == pytest.approx([0.5, 0.56], abs=0.005)


def test_all_states_are_observable_only_with_a_speed_over_ground():
    for name, as_printed, expected in (
        *(("slip14", True, (9, 12)), ("slip14", False, (10, 12))),
        *(("vio12", False, (10, 10)), ("vio15", False, (16, 16))),
    ):
        assert danzi.straight_line_rank(name, load_robot("agrimaro"), as_printed) == expected, name


def test_misprints_of_tazzari_are_corrected():
    regressor, lyapunov = rows("tazzari", "misprints")
    assert {regressor.verdict, lyapunov.verdict} == {"corrected"}
    assert regressor.beside["rank as printed"] == 1
    assert regressor.beside["with (11) as printed"] == pytest.approx(0.13)
    assert regressor.simulated < 1e-5
    assert lyapunov.simulated == pytest.approx(1.0)
    assert lyapunov.beside["with V as printed"] > 2


def test_misprints_of_yamauchi_are_corrected_and_the_compaction_is_independent_of_the_slope():
    fall, root, thrust, reverse = rows("yamauchi", "force_balance")
    assert fall.verdict == "as printed"
    assert {root.verdict, thrust.verdict, reverse.verdict} == {"corrected"}
    assert root.simulated == pytest.approx(1.0)
    assert thrust.simulated == pytest.approx(0.2131, abs=1e-4)
    assert reverse.simulated == pytest.approx(-2.5, abs=0.01)


def test_judged_runs_are_none_of_those_for_training():
    training = {run.seed for run in yamauchi.turning_runs(SEED, 3, (yamauchi.UPHILL,))}
    trial = claims.Trial(SEED, False, {})
    judged = {run.seed for runs in yamauchi.judged_runs(trial, yamauchi.UPHILL).values() for run in runs}
    assert len(judged) == 80
    assert not training & judged


def test_printed_line_2_of_deremetz_is_unstable_and_every_source_of_slip_is_compared():
    for speed_mps in (1.0, 3.0, 5.0, 8.0):
        growth = [deremetz.fastest_growth_ps(deremetz.adap2e(), speed_mps, sign) for sign in (1.0, -1.0)]
        assert growth[0] > 0.0 > growth[1]
    assert {variant.source for variant in deremetz.VARIANTS.values()} == set(SlipSource)
