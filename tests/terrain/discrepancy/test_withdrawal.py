"""Each rule by which a cause is withdrawn, alone, on runs in which it is known what is there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy import withdrawal
from terrain.discrepancy.probes import ProbeResult, probe_residuals
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import Problem, _found, search
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.withdrawal import (
    PROBE_ALIKE,
    PROBE_RATIO,
    ChannelEffect,
    channel_effects,
    constancies,
    raw_gain,
    reasons_to_withdraw,
    shown_beside,
    shown_channels,
)
from terrain.effects import BOUNDS, CHANNELS, effect_named
from terrain.robots import load_robot
from terrain.simulation.planar.noise import Scatter

HUSKY = load_robot("husky")
SIMULATION = simulation_of(HUSKY)
STEADY, ALIKE = replace(SIMULATION, scatter={}), Scatter(*[0.0] * len(Scatter._fields))
"""A simulation of which nothing scatters, and runs that do not."""

N_RUNS, DURATION_S = 6, 30.0


def runs(hidden, **options):
    drives = rich_drives(np.random.default_rng(1), N_RUNS, DURATION_S)
    return hidden_runs(HUSKY, drives, np.random.SeedSequence(1), hidden, **options)


def with_gyro(run, change):
    """Return a run whose gyro shows ``change(time, turn)``."""
    imu = run.streams["imu"]
    values, at = imu.values.copy(), imu.channels.index("gyro_z_radps")
    values[:, at] = change(imu.time_s, values[:, at])
    return replace(run, streams={**run.streams, "imu": replace(imu, values=values)})


def problem(logs, library, simulation=SIMULATION):
    signals = tuple(signals_of(run, HUSKY) for run in logs)
    return Problem(signals, simulation, low_pass_of(signals), tuple(map(effect_named, library)))


def searched(asked):
    return search(asked, asked.at(asked.simulation.vector))


@pytest.fixture(scope="module")
def yaw():
    """A camera that is turned by 0.03 rad, and what was found."""
    asked = problem(runs({"camera_yaw_rad": 0.03}), ("camera_yaw", "gyro_scale", "payload", "accel_bias"))
    return asked, searched(asked)


def reason(asked, found, probes=None):
    reasons = reasons_to_withdraw(asked, found, probes or {})
    assert set(reasons) <= {cause.name for cause in found.causes}
    return "; ".join(reasons.values())


def test_a_right_cause_has_no_reason(yaw):
    asked, found = yaw
    assert [cause.name for cause in found.causes] == ["camera_yaw"]
    assert reasons_to_withdraw(asked, found, probe_residuals(found.info, found.names, found.change)) == {}
    effects = channel_effects(found, found.causes[0])
    assert effects["speed_y_mps"].with_cause < 0.5 * effects["speed_y_mps"].without
    assert all(each.with_cause < 1.05 * each.without for each in effects.values())
    assert shown_channels(found, found.causes[0])[0] == "speed_y_mps"
    assert not constancies(found)["camera_yaw"].varies


def test_a_value_at_its_bound():
    high = BOUNDS["gyro_scale_ratio"][1]
    asked = problem(runs({"gyro_scale_ratio": 0.99 * high}), ("gyro_scale", "camera_yaw"))
    found = searched(asked)
    assert [cause.name for cause in found.causes] == ["gyro_scale"]
    assert "ends at the bound of what it may be (0.1" in reason(asked, found)
    # it is the bound of the sum where some of it is built in
    half = asked._replace(simulation=asked.simulation.with_effects({"gyro_scale_ratio": 0.5 * high}))
    rest = searched(half)
    assert rest.change[0] == pytest.approx(0.49 * high, rel=0.1)
    assert "at the bound" in reason(half, rest)


def test_a_value_that_grows_along_a_run():
    grown = [with_gyro(run, lambda t, w: w * (1 + 0.16 * t / DURATION_S)) for run in runs({}, scatter=ALIKE)]
    asked = problem(grown, ("gyro_scale", "camera_yaw"), STEADY)
    found = searched(asked)
    assert [cause.name for cause in found.causes] == ["gyro_scale"]
    assert "depends on time: 0.0" in reason(asked, found)
    # what is left still has its shape, which is a second reason
    probes = probe_residuals(found.info, found.names, found.change)
    assert probes["yaw_rate_radps", "time turn"].significant


def test_a_nameless_input_that_gains_much_beside_it_and_looks_like_it(yaw):
    asked, found = yaw
    gain = raw_gain(found, found.causes[0])
    for channel, ratio, alike, speaks in (
        ("speed_y_mps", 1.1 * PROBE_RATIO, PROBE_ALIKE + 0.1, True),
        ("speed_y_mps", 0.9 * PROBE_RATIO, PROBE_ALIKE + 0.1, False),
        ("speed_y_mps", 1.1 * PROBE_RATIO, PROBE_ALIKE - 0.1, False),
        ("current_a", 1.1 * PROBE_RATIO, PROBE_ALIKE + 0.1, False),
    ):
        probe = ProbeResult(9.0, ratio * gain, {"camera_yaw_rad": alike})
        text = reason(asked, found, {(channel, "time speed"): probe})
        assert ("depends on time speed beside it (z 9.0)" in text) == speaks, (channel, ratio, alike)


def test_a_channel_that_it_makes_worse_and_a_main_channel_that_gains_nothing(yaw, monkeypatch):
    asked, found = yaw
    for main, other, expected in (
        (ChannelEffect(1000.0, 900.0, 50.0), ChannelEffect(1000.0, 1090.0, -90.0), ""),
        (ChannelEffect(1000.0, 900.0, 50.0), ChannelEffect(1000.0, 1110.0, -90.0), "current_a worse, by 11%"),
        (
            ChannelEffect(1000.0, 1010.0, -5.0),
            ChannelEffect(1000.0, 500.0, 90.0),
            "nothing in speed_y_mps, its",
        ),
    ):
        given = {"speed_y_mps": main, "current_a": other}
        monkeypatch.setattr(withdrawal, "channel_effects", lambda *_, given=given: given)
        text = reason(asked, found)
        assert expected in text
        assert bool(text) == bool(expected)


def test_what_a_cause_does_to_each_channel():
    """A heading that turns 10 % less is taken for a track: the gyro, which is right, becomes worse by it."""

    def slower(run):
        heading = run.streams["lidar"]
        return replace(run, streams={**run.streams, "lidar": replace(heading, values=0.9 * heading.values)})

    sound = runs({}, scatter=ALIKE, heading=True)
    statistics = problem(sound, ("effective_track",), STEADY).at(STEADY.vector).statistics
    asked = problem(map(slower, sound), ("effective_track",), STEADY)
    (track,) = asked.library
    info = asked.at(STEADY.vector, None, statistics)
    found = _found(asked, info, [track])
    effects = channel_effects(found, track)
    heading, gyro = effects["heading_rate_radps"], effects["yaw_rate_radps"]
    assert heading.with_cause < 0.9 * heading.without
    assert heading.held_out_gain > 0 > gyro.held_out_gain
    assert gyro.with_cause > 1.1 * gyro.without
    # by hand
    for channel, each in effects.items():
        c, without, with_cause = CHANNELS.index(channel), 0.0, 0.0
        for white, change in zip(info.white_residual, info.white_change, strict=True):
            without += (white[:, c] ** 2).sum()
            with_cause += ((white - found.change[0] * change[0])[:, c] ** 2).sum()
        assert (each.without, each.with_cause) == pytest.approx((without, with_cause), rel=0.01)


def test_a_value_that_differs_in_slow_motion(yaw):
    asked, found = yaw
    # as if quick motion had asked for twice of it
    assert "has a smaller value in slow motion" in reason(asked, found._replace(change=2 * found.change))


def test_what_runs_deviate_by_themselves_is_not_free():
    """Gains of channels add up to that of the likelihood, in which a run's own deviation has its cost."""
    loose = replace(STEADY, scatter={"effective_track_ratio": 0.05})
    asked = problem(runs({"gyro_bias_radps": 0.02}), ("gyro_bias",), loose)
    found = searched(asked)
    assert [cause.name for cause in found.causes] == ["gyro_bias"]
    info, at = found.info, found.info.places(found.names)
    x, a, g = found.change, info.a[:, at][:, :, at].sum(axis=0), info.g[:, at].sum(axis=0)
    effects = channel_effects(found, found.causes[0])
    gained = sum(each.without - each.with_cause for each in effects.values())
    assert gained == pytest.approx(2 * g @ x - x @ a @ x, rel=1e-6)


def test_beside_a_track_a_wheel_radius_shows_in_the_speed():
    asked = problem(runs({"effective_track_ratio": 0.5}), ("effective_track", "wheel_radius"))
    found = searched(asked)
    track, radius = asked.library
    assert found.causes == (track,)
    assert shown_beside(found, radius) == "speed_x_mps"
    assert shown_beside(found, track) == "yaw_rate_radps"


@pytest.mark.parametrize(
    ("value", "at_bound"), [(-0.045, False), (-0.0495, True), (0.45, False), (0.495, True)]
)
def test_a_bound_near_zero_has_an_edge_of_its_own(value, at_bound):
    effect = effect_named("rolling_resistance")
    names = tuple(p.name for p in effect.parameters)
    assert BOUNDS[names[0]] == (-0.05, 0.5)
    found = SimpleNamespace(names=names, change=np.array([value]))
    asked = SimpleNamespace(simulation=SimpleNamespace(effects={}))
    assert bool(withdrawal._at_bound(asked, found, effect)) == at_bound
