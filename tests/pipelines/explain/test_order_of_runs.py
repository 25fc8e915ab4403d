"""`explain` of runs that are not alike: a trend goes into the extended robot, a rogue run held out is named."""

import pytest

from pipelines.explain.explain import explain
from pipelines.report.terminal import terminal_text
from terrain.discrepancy.held_out import split_runs

N = 12
EFFECTS = ["camera_yaw", "wheel_radius", "effective_track"]


def test_the_extended_robot_has_the_latest_value_of_a_trend_and_no_gain_is_claimed_for_it(a_run):
    runs = [a_run(i, effects={"wheel_radius_ratio": -0.07 * i / (N - 1)}) for i in range(N)]
    result = explain(runs[::-1], "husky", effects=EFFECTS)
    (effect,) = result.diagnosis.varying
    assert effect.pattern == "trend"
    assert result.extended.effects["wheel_radius_ratio"] == pytest.approx(-0.07, rel=0.2)
    assert result.extended.effects_cov.shape == (1, 1)
    assert "wheel_radius_ratio" not in result.diagnosed.simulation.effects
    text = terminal_text(result.report).replace("\N{NO-BREAK SPACE}", " ")
    assert "The wheel radius falls by" in text
    assert f"over these {N} runs" in text
    assert "for which no gain is claimed" in text


def test_a_rogue_run_that_is_held_out_is_named_too_and_judges_nothing(a_run):
    plain = [a_run(i, effects={}) for i in range(N)]
    _, held_out = split_runs(plain, 3, 0)
    rogue = held_out[0].run_id
    runs = [
        a_run(i, effects={"wheel_radius_ratio": 0.08 * (run.run_id == rogue)}) for i, run in enumerate(plain)
    ]
    result = explain(runs, "husky", effects=EFFECTS, hold_out=3)
    (out,) = result.diagnosis.excluded_runs
    assert out.run_id == rogue
    assert "its wheel radius differs from theirs by" in out.reason
    assert rogue not in [run.run_id for run in result.diagnosed.judged]
