"""Experiments of Deremetz et al.: rows are complete, verdicts those of the measured bars."""

from __future__ import annotations

import pytest

from pipelines.reproduce.deremetz.drives import VARIANTS, adap2e
from pipelines.reproduce.deremetz.experiments import EXPERIMENTS
from pipelines.reproduce.deremetz.misprints import fastest_growth_ps
from pipelines.reproduce.deremetz.stop import stop
from pipelines.reproduce.papers import PAPERS, assumed_numbers
from pipelines.reproduce.reproduce import reproduce
from pipelines.reproduce.results import Verdict
from terrain.control.car_following import SlipSource

SEED = 5


@pytest.mark.parametrize("speed_mps", [1.0, 3.0, 5.0, 8.0])
def test_printed_line_2_is_unstable_and_the_right_one_is_not(speed_mps):
    assert fastest_growth_ps(adap2e(), speed_mps, 1.0) > 0.0
    assert fastest_growth_ps(adap2e(), speed_mps, -1.0) < 0.0


def test_every_source_of_slip_is_compared():
    assert {variant.source for variant in VARIANTS.values()} == set(SlipSource)
    assert {"yaw_inertia_kgm2", "com_ahead_m"} <= {
        number.name for number in assumed_numbers(PAPERS["deremetz"].descriptions)
    }


def test_a_stop_is_as_the_paper_claims():
    finding = stop(SEED, quick=True)
    assert [row.verdict for row in finding.rows] == [Verdict.AS_PRINTED] * 3
    assert len(finding.pictures) == 3


@pytest.mark.slow
def test_the_page_is_made_and_its_verdicts_are_those_of_the_bars(tmp_path):
    steps = []
    result = reproduce("deremetz", tmp_path, SEED, lambda *step: steps.append(step), quick=True)
    assert len(steps) == len(EXPERIMENTS)
    assert result.report.is_file()
    rows = {each.row.what: each.row for each in result.rows}
    assert rows["Largest lateral error at 5 m/s, multi-model"].verdict is Verdict.AS_PRINTED
    assert rows["Largest lateral error at 5 m/s, no observer"].simulated > 0.5
    assert rows["Largest lateral error at 6 m/s with the preview"].spread[1] < 0.6
    signs = rows["Smallest cornering stiffness estimated at 5 m/s with the printed signs"]
    assert signs.verdict is Verdict.CORRECTED
    for speed in (4, 5):
        error = rows[f"Median error of the cornering stiffness at {speed} m/s, while excited"]
        assert error.spread[1] < 0.2
