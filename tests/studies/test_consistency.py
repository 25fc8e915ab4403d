"""Consistency by terrain and group of states: of its seed alone, with intervals over runs."""

import json

import pytest

from pipelines.report.results import as_json
from studies import consistency
from studies.consistency import GROUPS, consistency_by_terrain
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")


@pytest.fixture(scope="module")
def rows():
    return consistency_by_terrain(ROBOT, 41, 1, n_jobs=1, terrains=("tiles", "tilled_loam"))


def test_every_group_of_every_terrain_has_a_mean_and_an_interval(rows):
    assert [row.terrain for row in rows] == ["tiles", "tilled_loam"]
    for row in rows:
        assert list(row.nees) == list(GROUPS)
        assert row.n_runs == row.slip_coverage.n == len(consistency.SCENARIOS)
        for value in (*row.nees.values(), row.slip_coverage):
            assert value.ci[0] < value.mean < value.ci[1]
        assert 0.3 < row.slip_coverage.mean <= 1.0


@pytest.mark.slow
def test_the_seed_alone_decides(rows):
    again = consistency_by_terrain(ROBOT, 41, 1, n_jobs=2, terrains=("tiles", "tilled_loam"))
    assert json.dumps(as_json(again)) == json.dumps(as_json(rows))
    (other,) = consistency_by_terrain(ROBOT, 42, 1, n_jobs=1, terrains=("tiles",))
    assert other.nees["slip_speed"].mean != rows[0].nees["slip_speed"].mean
