"""Which runs are held out of a diagnosis."""

import pytest

from terrain.discrepancy.hold_out import split_runs
from terrain.errors import DataError
from terrain.records import RunLog


def test_every_terrain_is_held_out_in_proportion_and_the_seed_chooses_runs():
    runs = [RunLog(f"{name}{i}", "husky", {}, ((0.0, 1.0, name),)) for name in "ab" for i in range(8)]
    used, held = split_runs(runs, None, 0)
    assert sorted(run.terrains for run in held) == [("a",)] * 2 + [("b",)] * 2
    assert {run.run_id for run in used} | {run.run_id for run in held} == {run.run_id for run in runs}
    assert split_runs(runs, None, 0) == (used, held)
    assert any(split_runs(runs, None, seed)[1] != held for seed in range(1, 4))
    assert split_runs(runs[:5], None, 0) == (runs[:5], [])
    assert split_runs(runs, 0, 0) == (runs, [])
    with pytest.raises(DataError, match="--hold-out is 14 of 16"):
        split_runs(runs, 14, 0)
