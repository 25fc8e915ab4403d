"""Each rule by which a cause is withdrawn, alone, on runs in which it is known what is there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy import diagnose
from terrain.discrepancy.diagnose import (
    PROBE_ALIKE,
    PROBE_RATIO,
    channel_effects,
    constancy_of_cause,
    raw_gain,
    reasons_to_withdraw,
    shown_channels,
)
from terrain.discrepancy.probes import ProbeResult, probe_residuals
from terrain.discrepancy.search import cause_fit
from terrain.effects import BOUNDS, CHANNELS, effect_named
from terrain.robots import load_robot
from terrain.simulation.plants.planar import spread_numbers

STEADY = replace(simulation_of(load_robot("husky")), scatter={})
ALIKE = dict.fromkeys(spread_numbers("scatter"), 0.0)
"""A simulation of which nothing scatters, and runs that do not."""


def with_stream(run, name, change):
    """Return a run with changed values of a stream, of time and values."""
    stream = run.streams[name]
    return replace(run, streams={**run.streams, name: replace(stream, values=change(stream))})


@pytest.fixture(scope="module")
def yaw(hide, pose, solve):
    """A camera that is turned by 0.03 rad, and what was found."""
    problem = pose(hide({"camera_yaw_rad": 0.03}), ("camera_yaw", "gyro_scale", "payload", "accel_bias"))
    return problem, solve(problem)


def reason(problem, fit, probes=None):
    reasons = reasons_to_withdraw(problem, fit, probes or {})
    assert set(reasons) <= {cause.name for cause in fit.causes}
    return "; ".join(reasons.values())


def test_a_right_cause_has_no_reason(yaw):
    problem, fit = yaw
    (cause,) = fit.causes
    assert cause.name == "camera_yaw"
    assert reason(problem, fit, probe_residuals(fit.info, fit.names, fit.change)) == ""
    effects = channel_effects(fit, cause)
    assert effects["speed_y_mps"][1] < 0.5 * effects["speed_y_mps"][0]
    assert all(with_cause < 1.05 * without for without, with_cause, _ in effects.values())
    assert shown_channels(fit, cause)[0] == "speed_y_mps"
    assert not constancy_of_cause(fit, cause).varies
    # as if quick motion had asked for twice of it
    assert "has a smaller value in slow motion" in reason(problem, fit._replace(change=2 * fit.change))


def test_a_value_at_its_bound(hide, pose, solve):
    high = BOUNDS["gyro_scale_ratio"][1]
    problem = pose(hide({"gyro_scale_ratio": 0.99 * high}), ("gyro_scale", "camera_yaw"))
    fit = solve(problem)
    assert [cause.name for cause in fit.causes] == ["gyro_scale"]
    assert "ends at the bound of what it may be (0.1" in reason(problem, fit)
    # it is the bound of the sum where some of it is built in
    half = problem._replace(simulation=problem.simulation.with_effects({"gyro_scale_ratio": 0.5 * high}))
    rest = solve(half)
    assert rest.change[0] == pytest.approx(0.49 * high, rel=0.1)
    assert "at the bound" in reason(half, rest)
    # one that is near zero has an edge of its own
    effect = effect_named("rolling_resistance")
    names = tuple(p.name for p in effect.parameters)
    assert BOUNDS[names[0]] == (-0.05, 0.5)
    problem = SimpleNamespace(simulation=SimpleNamespace(effects={}))
    for value, at_bound in ((-0.045, False), (-0.0495, True), (0.45, False), (0.495, True)):
        fit = SimpleNamespace(names=names, change=np.array([value]))
        assert bool(diagnose._at_bound(problem, fit, effect)) == at_bound


def test_an_input_that_gains_much_beside_it_and_looks_like_it(yaw):
    problem, fit = yaw
    gain = raw_gain(fit, fit.causes[0])
    for channel, ratio, alike, speaks in (
        ("speed_y_mps", 1.1 * PROBE_RATIO, PROBE_ALIKE + 0.1, True),
        ("speed_y_mps", 0.9 * PROBE_RATIO, PROBE_ALIKE + 0.1, False),
        ("speed_y_mps", 1.1 * PROBE_RATIO, PROBE_ALIKE - 0.1, False),
        ("current_a", 1.1 * PROBE_RATIO, PROBE_ALIKE + 0.1, False),
    ):
        probe = ProbeResult(9.0, ratio * gain, {"camera_yaw_rad": alike})
        text = reason(problem, fit, {(channel, "time speed"): probe})
        assert ("depends on time speed beside it (z 9.0)" in text) == speaks, (channel, ratio, alike)


@pytest.mark.parametrize(
    ("main", "other", "expected"),
    [
        ((1000.0, 900.0, 50.0), (1000.0, 1090.0, -90.0), ""),
        ((1000.0, 900.0, 50.0), (1000.0, 1110.0, -90.0), ""),  # it does nothing there itself
        ((1000.0, 1110.0, 50.0), (1000.0, 900.0, 90.0), "speed_y_mps worse, by 11%"),
        ((1000.0, 1090.0, 50.0), (1000.0, 900.0, 90.0), ""),
        ((1000.0, 1110.0, 50.0), (5000.0, 4000.0, 90.0), "speed_y_mps worse, by 11%"),
        ((1000.0, 1110.0, 50.0), (5000.0, 3800.0, 90.0), ""),  # ten times that goes with it elsewhere
        ((1000.0, 1010.0, -5.0), (1000.0, 500.0, 90.0), "nothing in speed_y_mps, its"),
    ],
)
def test_a_channel_that_it_makes_worse_and_a_main_channel_that_gains_nothing(
    yaw, monkeypatch, main, other, expected
):
    given = {"speed_y_mps": main, "current_a": other}
    monkeypatch.setattr(diagnose, "channel_effects", lambda *_: given)
    text = reason(*yaw)
    assert expected in text
    assert bool(text) == bool(expected)


def test_what_a_cause_does_to_each_channel(hide, pose):
    """A heading that turns 10 % less is taken for a track: the gyro, which is right, becomes worse by it."""
    sound = hide({}, scatter=ALIKE, heading=True)
    noise = pose(sound, ("effective_track",), STEADY).at(STEADY.vector).noise
    slower = [with_stream(run, "lidar", lambda heading: 0.9 * heading.values) for run in sound]
    problem = pose(slower, ("effective_track",), STEADY)
    (track,) = problem.library
    fit = cause_fit(problem, problem.at(STEADY.vector, noise=noise), [track])
    effects = channel_effects(fit, track)
    heading, gyro = effects["heading_rate_radps"], effects["yaw_rate_radps"]
    assert heading[1] < 0.9 * heading[0]
    assert heading[2] > 0 > gyro[2]
    assert gyro[1] > 1.1 * gyro[0]
    for name, channel in effects.items():  # by hand
        c, residuals = CHANNELS.index(name), [white[:, :, CHANNELS.index(name)] for white in fit.info.white]
        squares = [
            sum(((white[-1] - x * white[0]) ** 2).sum() for white in residuals) for x in (0.0, fit.change[0])
        ]
        assert channel[:2] == pytest.approx(tuple(squares), rel=0.01), c


def test_what_runs_deviate_by_themselves_is_not_free(hide, pose, solve):
    """Gains of channels add up to that of the likelihood, in which a run's own deviation has its cost."""
    loose = replace(STEADY, scatter={"effective_track_ratio": 0.05})
    fit = solve(pose(hide({"gyro_bias_radps": 0.02}), ("gyro_bias",), loose))
    assert [cause.name for cause in fit.causes] == ["gyro_bias"]
    x, (a, g) = fit.change, fit.info.total(fit.names)
    effects = channel_effects(fit, fit.causes[0])
    gained = sum(without - with_cause for without, with_cause, _ in effects.values())
    assert gained == pytest.approx(2 * g @ x - x @ a @ x, rel=1e-6)


def test_a_cause_that_varies_takes_with_it_what_does_nothing_without_it(hide, pose, solve, monkeypatch):
    """And the one that has left is not withdrawn once more, though its value differs from run to run, too."""
    problem = pose(
        hide({"turn_side_slip_s": 0.2, "side_slip_build_up_s": 0.5}), ("turn_side_slip", "side_slip_build_up")
    )
    fit, withdrawn = solve(problem), {}
    both = {"turn_side_slip", "side_slip_build_up"}
    assert {cause.name for cause in fit.causes} == both
    monkeypatch.setattr(diagnose.constancy, "run_scatter", lambda *_: 9.0)
    left = diagnose._withdraw_varying(problem, fit, both, withdrawn)
    assert (left.causes, [*withdrawn]) == ((), ["turn_side_slip"])
    assert "differs from run to run, by 9 about a size of 0." in withdrawn["turn_side_slip"].reason
