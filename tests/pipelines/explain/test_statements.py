"""Sentences of channels: the factor between measured and simulated comes back, all that is found is there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pipelines.explain.statements import notes_of, statements_of, would_have_shown
from terrain.discrepancy.compared import (
    ComparedRun,
    Slope,
    off_by,
    rms_of,
    slope_through_zero,
    slopes_of,
    terrains_apart,
)
from terrain.discrepancy.robot_terms import in_robot_terms
from terrain.discrepancy.runs import TerrainMatch, measured_channels
from terrain.discrepancy.verdict import (
    Cause,
    ChannelVerdict,
    Covariance,
    Diagnosis,
    Limit,
    RuledOut,
    Tier,
    Unexplained,
    Value,
    Varying,
)
from terrain.effects import CHANNELS
from terrain.robots import load_robot

HUSKY = load_robot("husky")
YAW, CURRENT = "yaw_rate_radps", "current_a"
TRACK_VALUE = Value("effective_track_ratio", 1.5, "ratio", 1.47, 1.53)
TRACK = Cause("effective_track", (), (TRACK_VALUE,), 0.5, (0.4, 0.6), (YAW,), 16.0, 1.0)


def a_run(seed, factor=1.0, level=0.0, std=0.02, channel=YAW, terrain="grass", after=None, n=200):
    c, noise, time_s = (
        CHANNELS.index(channel),
        np.random.default_rng(seed).standard_normal(n),
        np.arange(n) / 6.25,
    )
    before, fixed, measured = np.full((3, n, len(CHANNELS)), np.nan)
    before[:, c] = np.sin(0.1 * np.arange(n) + seed)
    measured[:, c] = factor * before[:, c] + level + noise * std / np.sqrt(np.mean(noise**2))
    fixed[:, c] = (after or 0.0) * before[:, c]
    simulated = before, None if after is None else fixed
    about = f"r{seed}", terrain, False, time_s, np.ones(n)
    return ComparedRun(*about, measured, *simulated, {"time_s": time_s})


def runs_of(n, *options, **more):
    return [a_run(seed, *options, **more) for seed in range(n)]


def a_diagnosis(**more):
    none = ("causes", "ambiguous_sets", "unexplained", "detection_limits", "not_shown", "ruled_out")
    empty = dict.fromkeys((*none, "excluded_runs", "clocks"), ())
    empty |= {name: {} for name in ("ambiguous_values", "residual_before", "residual_after")}
    empty |= {"robot": "husky", "verdict": None, "next_drive": None, "n_runs": 8}
    return Diagnosis(**(empty | {"covariance": Covariance((), np.empty((0, 0)))} | more))


def channels_of(runs, causes=(), rms=None):
    """Return the verdicts of channels as runs are compared, or with errors that are given."""
    verdicts = []
    for name in measured_channels(runs):
        after = rms_of(runs, name, True) if runs[0].after is not None else math.nan
        errors = rms or (rms_of(runs, name, False), after)
        none = math.nan, (math.nan, math.nan)
        verdicts.append(
            ChannelVerdict(
                name, None, tuple(c.name for c in causes), *errors, *none, True, math.nan, *none, none[1]
            )
        )
    return tuple(verdicts)


def sentence(runs, rms=None, **more):
    channels = channels_of(runs, more.get("causes", ()), rms)
    (statement,) = statements_of(a_diagnosis(channels=channels, **more), HUSKY, runs)
    return statement.text


def test_the_factor_or_level_comes_back_within_its_error_although_some_runs_are_stalled():
    for factor in (0.1, 0.4, 0.9, 1.3, -0.97):
        runs = runs_of(20, factor)
        slope = slopes_of(runs)[YAW]
        assert abs(slope.ratio - factor) < 4 * max(slope.std, 0.002)
        stalled = [run._replace(measured=0.0 * run.measured) for run in runs[:2]]
        assert slopes_of([*runs, *stalled])[YAW].ratio == pytest.approx(factor, abs=0.03)
    # the slope scales with what is measured, and is that of the least sum of absolute deviations
    x, y = np.random.default_rng(3).standard_normal((2, 101))
    least = slope_through_zero(x, y)
    assert slope_through_zero(x, -2.0 * y) == pytest.approx(-2.0 * least)
    grid = np.linspace(-3.0, 3.0, 6001)
    assert np.abs(y - least * x).sum() <= np.abs(y - grid[:, None] * x).sum(axis=1).min() + 1e-9
    assert math.isnan(slope_through_zero(np.zeros(3), y[:3]))
    # a level is no factor, and what agrees has neither
    for level in (2.0, 0.0):
        slope = slopes_of(runs_of(6, level=level, std=0.1))[YAW]
        assert math.isnan(slope.ratio)
        assert slope.level == pytest.approx(level or math.nan, abs=0.03, nan_ok=True)


def test_a_channel_states_factor_cause_in_the_robots_quantities_and_its_error_on_held_out_runs():
    runs = runs_of(8, 0.4, after=0.4)
    assert sentence(runs, (0.746, 0.148), causes=(TRACK,)) == (
        "yaw rate (gyro): the simulation turns 2.5 times too fast; with an effective track of 1.43 m "
        "(described: 0.571 m) its error falls from 0.75 to 0.15 rad/s on data held out."
    )
    assert "from 0.43 to 0.02 rad/s on data held out" in sentence(runs, causes=(TRACK,))


LATE_VALUE = Value("clock_offset_s", -0.27, "s", -0.28, -0.26)
LATE = TRACK._replace(name="clock_offset", parameters=(LATE_VALUE,), tier=Tier.CANDIDATE, reason="why")
RIVALS = {
    "payload": (Value("payload_ratio", 0.2, "ratio", 0.1, 0.3),),
    "motor_constant": (Value("motor_constant_ratio", 0.25, "ratio", 0.2, 0.3),),
}


@pytest.mark.parametrize(
    ("runs", "findings", "stated"),
    [
        (
            runs_of(8, 0.4, std=0.2, after=0.4),
            {"causes": (TRACK,), "unexplained": (Unexplained(YAW, "acceleration", 9.0, 0.1),)},
            "; 0.2 rad/s rms remain, which depend on acceleration.",
        ),
        (
            [a_run(1, std=0.2)],
            {"unexplained": (Unexplained(YAW, "clock_offset", 9.0, 0.0),), "candidates": (LATE,)},
            "apart, which looks like the wheels logged 0.27 s late, a candidate that did not earn its name.",
        ),
        (
            runs_of(4),
            {},
            "yaw rate (gyro): measured and simulated agree to 0.02 rad/s rms on data held out.",
        ),
        (
            runs_of(6, level=2.0, channel=CURRENT, std=0.1),
            {"unexplained": (Unexplained(CURRENT, "constant", 9.0, 0.9),)},
            "sum of the motor currents: simulated, it is 2 A too small throughout.",
        ),
        (
            runs_of(6, channel=CURRENT),
            {"varying": (Varying("payload", "payload_ratio", "ratio", (), 0.1, 0.14, 9.0, (), CURRENT),)},
            "the payload differs from run to run by 14 %.",
        ),
        # a cause that leaves the error of its channel does not reduce it
        (
            runs_of(8, 0.9, std=0.5, after=0.999),
            {"causes": (TRACK,)},
            "its error stays at 0.51 rad/s on data held out.",
        ),
        (
            runs_of(8, after=1.5),
            {"causes": (TRACK,)},
            "its error rises from 0.02 to 0.35 rad/s on data held out.",
        ),
        (
            runs_of(6, 1.2, channel=CURRENT),
            {"ambiguous_sets": (tuple(RIVALS),), "ambiguous_values": RIVALS},
            "explains it, and these runs do not distinguish which.",
        ),
    ],
)
def test_what_was_found_of_a_channel_is_stated(runs, findings, stated):
    assert sentence(runs, **findings).endswith(stated)


def test_factors_and_levels_in_words():
    for channel, slope, text in (
        (YAW, Slope(0.02, 0.001), "the simulation turns more than 20 times too fast"),
        (YAW, Slope(-0.97, 0.01), "the simulation turns backward"),
        ("accel_x_mps2", Slope(-1.0, 0.01), "simulated, it is of the wrong sign"),
        ("speed_x_mps", Slope(2.0, 0.1), "the simulation drives 2 times too slowly"),
        ("speed_x_mps", Slope(level=-0.05), "the simulation is 0.05 m/s too fast throughout"),
        (YAW, Slope(level=0.01), "measured is 0.01 rad/s more to the left throughout"),
    ):
        assert off_by(channel, slope.ratio, slope.level) == text


def test_only_the_sum_of_a_described_lever_and_the_one_found_counts():
    def place(robot, x_m, y_m=0.001):
        values = (
            Value("lever_x_m", x_m, "m", x_m - 0.01, x_m + 0.01),
            Value("lever_y_m", y_m, "m", y_m - 0.02, y_m + 0.02),
        )
        return in_robot_terms("lever_arm", values, robot)

    robots = [HUSKY.with_parts(camera=replace(HUSKY.camera, lever_x_m=x_m)) for x_m in (0.35, 0.1, -0.35)]
    places = [place(*given).partition(" (")[0] for given in zip(robots, (-0.23, 0.02, 0.0), strict=True)]
    assert places == ["the measured point 0.12 m ahead of the centre"] * 2 + [
        "the measured point 0.35 m behind the centre"
    ]
    assert place(HUSKY, -0.23, 0.1) == (
        "the measured point 0.12 m ahead and 0.10 m left of the centre (described: 0.35 m, assumed)"
    )


def test_terrains_that_differ_or_are_bumpy_are_named_where_runs_differ_only():
    runs = [a_run(i, 0.6 - 0.1 * (i > 4), terrain="sand" if i > 4 else "asphalt") for i in range(10)]
    doubtful = a_diagnosis(causes=(TRACK._replace(caveat="it differs from run to run by 0.3 ratio"),))
    apart = terrains_apart(doubtful.differing_channels, runs)
    assert {label: round(slope.ratio, 2) for label, slope in apart.items()} == {"asphalt": 0.6, "sand": 0.5}
    assert terrains_apart(a_diagnosis(causes=(TRACK,)).differing_channels, runs) == {}
    alike = [run._replace(terrain="ab"[i % 2]) for i, run in enumerate(runs[:5])]
    assert terrains_apart(doubtful.differing_channels, alike) == {}
    first, second = notes_of(a_diagnosis(), [TerrainMatch("gravel", "gravel", 0.25)], apart)
    assert "25 % of the measured tilt" in first
    assert "measured over simulated is 0.60 on asphalt and 0.50 on sand." in second
    assert "Explain each by itself with --terrain asphalt or --terrain sand." in second
    assert notes_of(a_diagnosis(), [TerrainMatch("grass", "grass", 1.0)], {}) == ()


def test_what_could_not_have_been_seen_is_not_ruled_out():
    missed = Limit("payload_ratio", np.inf, "ratio", "slopes")
    effects = (RuledOut("payload", "no", 0.0), RuledOut("gyro_bias", "no", 0.0))
    seen = would_have_shown(a_diagnosis(ruled_out=effects, not_shown=(missed,)))
    assert [effect.name for effect in seen] == ["gyro_bias"]
