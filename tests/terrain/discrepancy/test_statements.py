"""Sentences of channels: the factor between measured and simulated comes back, all that is found is there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy.compared import ComparedRun, compare_runs
from terrain.discrepancy.held_out import ChannelGain, Gain, Reduction
from terrain.discrepancy.next_drive import next_command
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.robot_terms import in_robot_terms
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.statements import (
    Slope,
    acting_causes,
    notes_of,
    off_by,
    slope_through_zero,
    slopes_of,
    split_ruled_out,
    statements_of,
    terrains_apart,
)
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.verdict import (
    Cause,
    Diagnosis,
    Limit,
    NextDrive,
    RuledOut,
    Unexplained,
    Value,
    Varying,
    Verdict,
)
from terrain.effects import CHANNELS
from terrain.robots import load_robot
from terrain.simulation.planar.run import simulate_planar

HUSKY = load_robot("husky")
YAW, CURRENT = "yaw_rate_radps", "current_a"
TRACK = Cause(
    "effective_track",
    (),
    (Value("effective_track_ratio", 1.5, "ratio", 1.47, 1.53),),
    0.5,
    0.4,
    0.6,
    (YAW,),
    16.0,
    1.0,
)


def a_run(seed, factor=1.0, level=0.0, std=0.02, channel=YAW, terrain="grass", after=None, n=200):
    rng = np.random.default_rng(seed)
    before, measured = np.full((n, len(CHANNELS)), np.nan), np.full((n, len(CHANNELS)), np.nan)
    c = CHANNELS.index(channel)
    before[:, c] = np.sin(0.1 * np.arange(n) + seed)
    noise = rng.standard_normal(n)
    noise *= std / np.sqrt(np.mean(noise**2))
    measured[:, c] = factor * before[:, c] + level + noise
    fixed = None
    if after is not None:
        fixed = before.copy()
        fixed[:, c] *= after
    time_s = np.arange(n) / 6.25
    return ComparedRun(
        f"r{seed}", terrain, False, time_s, np.ones(n), measured, before, fixed, {"time_s": time_s}
    )


def a_diagnosis(**more):
    none = ("causes", "parameters", "ambiguous_sets", "unexplained", "limits", "not_excited", "ruled_out")
    empty = dict.fromkeys((*none, "excluded_runs", "clocks"), ())
    empty |= {name: {} for name in ("ambiguous_values", "residual_before", "residual_after")}
    empty |= {"robot": "husky", "verdict": Verdict.NONE, "next_drive": None, "n_runs": 8}
    empty["cov"] = np.empty((0, 0))
    return Diagnosis(**(empty | more))


def sentence(runs, gain=None, **more):
    (statement,) = statements_of(a_diagnosis(**more), HUSKY, runs, gain)
    return statement.text


@pytest.mark.parametrize("factor", [0.1, 0.4, 0.9, 1.3, -0.97])
def test_the_factor_comes_back_within_its_error_although_some_runs_are_stalled(factor):
    runs = [a_run(seed, factor) for seed in range(20)]
    found = slopes_of(runs)[YAW]
    assert abs(found.ratio - factor) < 4 * max(found.std, 0.002)
    stalled = [run._replace(measured=0.0 * run.measured) for run in runs[:2]]
    assert slopes_of([*runs, *stalled])[YAW].ratio == pytest.approx(factor, abs=0.03)


def test_a_slope_scales_with_what_is_measured_and_is_the_least_of_absolute_deviations():
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, 101))
    slope = slope_through_zero(x, y)
    assert slope_through_zero(x, -2.0 * y) == pytest.approx(-2.0 * slope)
    grid = np.linspace(-3.0, 3.0, 6001)
    cost = np.abs(y - grid[:, None] * x).sum(axis=1)
    assert np.abs(y - slope * x).sum() <= cost.min() + 1e-9
    assert math.isnan(slope_through_zero(np.zeros(3), y[:3]))


def test_a_level_is_no_factor_and_what_agrees_has_neither():
    found = slopes_of([a_run(seed, level=2.0, std=0.1) for seed in range(6)])[YAW]
    assert math.isnan(found.ratio)
    assert found.level == pytest.approx(2.0, abs=0.03)
    found = slopes_of([a_run(seed, std=0.1) for seed in range(6)])[YAW]
    assert math.isnan(found.ratio)
    assert math.isnan(found.level)


def test_a_channel_states_factor_cause_in_the_robots_quantities_and_its_error_on_held_out_runs():
    change = ChannelGain(0.746, 0.148, 3.0, 1.0, Reduction(0.96, 0.94, 0.97))
    gain = Gain(("a",), (), "runs", {YAW: change}, Reduction(0.5, 0.4, 0.6))
    runs = [a_run(seed, 0.4, after=0.4) for seed in range(8)]
    text = sentence(runs, gain, causes=(TRACK,))
    assert text == (
        "yaw rate (gyro): the simulation turns 2.5 times too fast; with an effective track of 1.43 m "
        "(described: 0.571 m) its error falls from 0.75 to 0.15 rad/s on held-out runs."
    )
    assert "from 0.43 to 0.02 rad/s on the runs compared" in sentence(runs, causes=(TRACK,))


def test_what_the_causes_leave_is_stated_with_what_it_depends_on():
    runs = [a_run(seed, 0.4, std=0.2, after=0.4) for seed in range(8)]
    left = (Unexplained(YAW, "acceleration", 9.0, 0.1),)
    text = sentence(runs, causes=(TRACK,), unexplained=left)
    assert text.endswith("; 0.2 rad/s rms remain, which depend on acceleration.")
    late = RuledOut(
        "clock_offset", "it depends on time", 9.0, (Value("clock_offset_s", -0.27, "s", -0.28, -0.26),)
    )
    left = (Unexplained(YAW, "clock_offset", 9.0, 0.0),)
    text = sentence([a_run(1, std=0.2)], unexplained=left, ruled_out=(late,))
    assert text.endswith("apart, which looks like the wheels logged 0.27 s late, a cause that was withdrawn.")


def test_agreement_a_level_and_a_difference_between_runs_are_stated():
    assert sentence([a_run(seed) for seed in range(4)]) == (
        "yaw rate (gyro): measured and simulated agree to 0.02 rad/s rms on the runs compared."
    )
    runs = [a_run(seed, level=2.0, channel=CURRENT, std=0.1) for seed in range(6)]
    text = sentence(runs, unexplained=(Unexplained(CURRENT, "constant", 9.0, 0.9),))
    assert text == "sum of the currents: simulated, it is 2 A too small throughout."
    varying = Varying("payload", "payload_ratio", "ratio", (), 0.1, 0.14, 9.0, (), CURRENT)
    assert "the payload differs from run to run by 14 %" in sentence(runs, varying=(varying,))


def test_a_cause_that_leaves_the_error_of_its_channel_is_not_said_to_reduce_it():
    runs = [a_run(seed, 0.9, std=0.5, after=0.999) for seed in range(8)]
    assert "its error stays at 0.5" in sentence(runs, causes=(TRACK,))
    runs = [a_run(seed, after=1.5) for seed in range(8)]
    assert "its error rises from 0.02 to 0.35 rad/s" in sentence(runs, causes=(TRACK,))


def test_rivals_are_given_where_runs_do_not_distinguish_them():
    values = {
        "payload": (Value("payload_ratio", 0.2, "ratio", 0.1, 0.3),),
        "motor_constant": (Value("motor_constant_ratio", 0.25, "ratio", 0.2, 0.3),),
    }
    runs = [a_run(seed, 1.2, channel=CURRENT) for seed in range(6)]
    text = sentence(runs, ambiguous_sets=(("payload", "motor_constant"),), ambiguous_values=values)
    assert "too small; a mass of 60 kg (described: 50 kg) or a torque constant of" in text
    assert text.endswith("explains it, and these runs do not distinguish which.")


@pytest.mark.parametrize(
    ("channel", "slope", "text"),
    [
        (YAW, Slope(0.02, 0.001), "the simulation turns more than 20 times too fast"),
        (YAW, Slope(-0.97, 0.01), "the simulation turns backward"),
        ("accel_x_mps2", Slope(-1.0, 0.01), "simulated, it is of the wrong sign"),
        ("speed_x_mps", Slope(2.0, 0.1), "the simulation drives 2 times too slowly"),
        (
            "speed_x_mps",
            Slope(math.nan, math.nan, -0.05, 0.001),
            "the simulation is 0.05 m/s too fast throughout",
        ),
        (YAW, Slope(math.nan, math.nan, 0.01, 0.001), "measured is 0.01 rad/s more to the left throughout"),
        (YAW, Slope(math.nan, math.nan), ""),
    ],
)
def test_factors_and_levels_in_words(channel, slope, text):
    assert off_by(channel, slope) == text


def test_only_the_sum_of_a_described_lever_and_the_one_found_counts():
    camera = HUSKY.camera

    def place(described_m, found_m):
        robot = HUSKY.with_parts(camera=replace(camera, lever_x_m=described_m))
        values = (
            Value("lever_x_m", found_m, "m", found_m - 0.01, found_m + 0.01),
            Value("lever_y_m", 0.001, "m", -0.01, 0.012),
        )
        return in_robot_terms("lever_arm", values, robot).partition(" (")[0]

    assert place(0.35, -0.23) == place(0.10, 0.02) == "the measured point 0.12 m ahead of the centre"
    assert place(-0.35, 0.0) == "the measured point 0.35 m behind the centre"


def test_an_assumed_number_stands_beside_the_value_that_rests_on_it():
    values = (Value("lever_x_m", -0.23, "m", -0.24, -0.22), Value("lever_y_m", 0.1, "m", 0.08, 0.12))
    assert in_robot_terms("lever_arm", values, HUSKY) == (
        "the measured point 0.12 m ahead and 0.10 m left of the centre (described: 0.35 m, assumed)"
    )


def test_terrains_are_compared_where_runs_differ_only():
    runs = [a_run(seed, 0.6, terrain="asphalt") for seed in range(5)]
    runs += [a_run(seed + 5, 0.5, terrain="sand") for seed in range(5)]
    doubtful = TRACK._replace(caveat="it differs from run to run by 0.3 ratio")
    apart = terrains_apart(a_diagnosis(causes=(doubtful,)), runs)
    assert {label: round(slope.ratio, 2) for label, slope in apart.items()} == {"asphalt": 0.6, "sand": 0.5}
    assert terrains_apart(a_diagnosis(causes=(TRACK,)), runs) == {}
    alike = [run._replace(terrain="ab"[i % 2]) for i, run in enumerate(runs[:5])]
    assert terrains_apart(a_diagnosis(causes=(doubtful,)), alike) == {}


def test_what_could_not_have_been_seen_is_not_ruled_out():
    missed = Limit("payload_ratio", np.inf, "ratio", "slopes")
    withdrawn = RuledOut("scrub", "no", 5.0, (Value("scrub_ratio", 0.1, "ratio", 0.0, 0.2),))
    effects = (withdrawn, RuledOut("payload", "no", 0.0), RuledOut("gyro_bias", "no", 0.0))
    first, second = split_ruled_out(a_diagnosis(ruled_out=effects, not_excited=(missed,)))
    assert [effect.name for effect in first] == ["scrub"]
    assert [effect.name for effect in second] == ["gyro_bias"]


def test_a_cause_acts_on_the_channels_that_it_changes():
    time_s = np.arange(1000) / 50
    twist = np.column_stack([0.5 * np.sin(0.6 * time_s), 0.0 * time_s, 0.5 * np.sin(0.9 * time_s)])
    signals = [signals_of(simulate_planar(HUSKY, twist, 1, run_id="a"), HUSKY)]
    yaw = Cause("camera_yaw", (), (Value("camera_yaw_rad", 0.1, "rad", 0.09, 0.11),), 0, 0, 0, (), 9.0, 1.0)
    diagnosis, simulation = a_diagnosis(causes=(TRACK, yaw)), Simulation(HUSKY)
    used = compare_runs(simulation, simulation.with_effects(diagnosis.values), signals, low_pass_of(signals))
    acting = acting_causes(simulation, diagnosis, signals, used)
    assert "yaw_rate_radps" in acting["effective_track"]
    assert "speed_y_mps" in acting["camera_yaw"]
    assert "yaw_rate_radps" not in acting["camera_yaw"]


def test_terrains_that_differ_or_are_bumpy_are_named():
    apart = {"ice": Slope(0.4, 0.01), "snow": Slope(0.5, 0.01)}
    first, second = notes_of(a_diagnosis(), [TerrainMatch("gravel", "gravel", 0.25)], apart)
    assert "25 % of the measured tilt" in first
    assert "measured over simulated is 0.40 on ice and 0.50 on snow." in second
    assert "Explain each by itself with --terrain ice or --terrain snow." in second
    assert notes_of(a_diagnosis(), [TerrainMatch("grass", "grass", 1.0)], {}) == ()


def test_the_next_drive_is_a_command_of_the_described_robot():
    coming = a_diagnosis(next_drive=NextDrive("climb", 6.0, "it parts them"))
    assert next_command(coming, "my robot.yaml", HUSKY, ()) == (
        "terrain simulate --robot 'my robot.yaml' --terrain grass --scenario climb --grade 6 --runs 8 "
        "--out next_drive"
    )
