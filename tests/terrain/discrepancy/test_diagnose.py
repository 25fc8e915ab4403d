"""Attribution: a hidden effect is named, and what no log distinguishes is ambiguous."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.limits import confusable_class, limits_of
from studies.blind_trials.trial import simulation_of

import terrain.discrepancy.diagnose as diagnose_module
from pipelines.report.results import as_json
from terrain.discrepancy.diagnose import MIN_RUNS, diagnose
from terrain.discrepancy.verdict import Verdict
from terrain.effects import GYRO, HEADING, effect_named
from terrain.errors import DataError
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.planar.model import Ground

OVER = 4.0
"""Times the smallest amplitude that these drives could show."""

EFFECTS = {
    "husky": (
        *("wheel_radius", "one_sided_radius", "effective_track", "camera_latency", "lever_arm", "clock_rate"),
        *("payload", "motor_drift", "scrub", "side_hill_slip", "turn_side_slip", "turn_drag", "imu_latency"),
    ),
    "agrimaro": (
        *("steering_offset_2", "steering_backlash", "encoder_lag", "camera_yaw", "gyro_scale", "accel_bias"),
        *("force_slip", "viscous_drag", "wheel_scale_2", "current_offset"),
    ),
}
"""Of wheels, steering, sensors, clocks, masses, motors and the ground; some of each robot."""


class World:
    """A robot, what it drives, and how small effects these drives could show."""

    def __init__(self, name):
        self.robot = load_robot(name)
        self.simulation = simulation_of(self.robot)
        self.drives = rich_drives(np.random.default_rng(3), 6, 40.0)
        self.limits = limits_of(self.robot, self.drives)

    def runs(self, hidden, outside=None, seed=11):
        return hidden_runs(self.robot, self.drives, np.random.SeedSequence(seed), hidden, outside)

    def hidden(self, name, over=OVER):
        effect = effect_named(name)
        direction = np.ones(len(effect.parameters)) / np.sqrt(len(effect.parameters))
        size = over * self.limits.of(effect, direction)
        return {p.name: size * x for p, x in zip(effect.parameters, direction, strict=True)}

    def twins(self, name):
        effect = effect_named(name)
        own = confusable_class(self.limits, effect, self.robot.drive)
        return own | {name, *(twin for twin, _ in effect.twins)}


@pytest.fixture(scope="module")
def worlds():
    return {name: World(name) for name in EFFECTS}


def named(found):
    return [cause.name for cause in found.causes]


def test_where_nothing_is_hidden_nothing_is_named(worlds):
    for name, world in worlds.items():
        found = diagnose(world.runs({}), world.simulation)
        assert (found.verdict, found.robot, found.n_runs) == (Verdict.NONE, name, 6)
        assert (found.causes, found.ambiguous_sets, found.unexplained, found.excluded_runs) == (
            (),
            (),
            (),
            (),
        )
        assert {limit.name for limit in found.limits} >= {"payload_ratio", "gyro_bias_radps"}
        assert len(found.ruled_out) == len(world.simulation.library)
        assert all(abs(clock.offset_s) < 0.02 for clock in found.clocks)
        # what is apart is noise, and what scatters from run to run: biases of the gyro
        apart = {channel: residual.systematic for channel, residual in found.residual_before.items()}
        assert all(ratio < 0.4 for channel, ratio in apart.items() if channel != GYRO), apart
        assert json.loads(json.dumps(as_json(found), allow_nan=False))["verdict"] == Verdict.NONE


@pytest.mark.parametrize(
    ("robot", "name"),
    [
        pytest.param(robot, name, marks=[pytest.mark.slow] * (i % 4 > 0))
        for robot in EFFECTS
        for i, name in enumerate(EFFECTS[robot])
    ],
)
def test_a_hidden_effect_is_named_with_its_value_and_nothing_beside_it(worlds, robot, name):
    world = worlds[robot]
    hidden = world.hidden(name)
    found = diagnose(world.runs(hidden), world.simulation)
    sets = [set(names) for names in found.ambiguous_sets]
    assert named(found) == [name] or (named(found) == [] and sets and name in sets[0] <= world.twins(name))
    if found.causes:
        assert found.verdict == Verdict.EXPLAINED
        for value in found.causes[0].values:
            std = (value.high - value.low) / (2 * 2.13)
            assert abs(value.value - hidden[value.name]) < 4 * std, value
        assert found.causes[0].gain_low > 0
        after = sum(x.systematic for x in found.residual_after.values())
        assert after < sum(x.systematic for x in found.residual_before.values())


@pytest.mark.parametrize(
    ("robot", "names"),
    [
        ("husky", ("effective_track", "payload")),
        pytest.param("agrimaro", ("steering_offset_1", "camera_latency"), marks=pytest.mark.slow),
    ],
)
def test_of_two_hidden_effects_both_are_named(worlds, robot, names):
    world = worlds[robot]
    hidden = {key: value for name in names for key, value in world.hidden(name).items()}
    found = diagnose(world.runs(hidden), world.simulation)
    assert sorted(named(found)) == sorted(names)
    assert found.cov.shape == (len(found.parameters),) * 2
    assert set(found.parameters) == set(hidden) == set(found.values)


def test_a_built_in_effect_is_not_found_again_and_half_of_one_is_found_by_half(worlds):
    world = worlds["husky"]
    hidden = world.hidden("effective_track", over=8.0)
    runs = world.runs(hidden)
    again = diagnose(runs, world.simulation.with_effects(hidden))
    assert again.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)  # so wide a track leaves no fast arcs
    half = {name: 0.5 * value for name, value in hidden.items()}
    (cause,) = diagnose(runs, world.simulation.with_effects(half)).causes
    assert cause.name == "effective_track"
    assert cause.values[0].low < half["effective_track_ratio"] < cause.values[0].high


def test_an_effect_of_no_library_is_unexplained(worlds):
    for world in worlds.values():
        found = diagnose(world.runs({}, {"wheel_eccentricity_ratio": 0.03}), world.simulation)
        assert found.verdict == Verdict.UNEXPLAINED
        assert named(found) == []
        assert any("wheel" in left.input for left in found.unexplained)


def test_an_effect_without_its_entry_is_unexplained(worlds):
    world = worlds["husky"]
    library = [effect for effect in world.simulation.library if effect.name != "motor_drift"]
    found = diagnose(world.runs(world.hidden("motor_drift", over=8.0)), world.simulation, library)
    assert named(found) == []
    assert found.verdict == Verdict.UNEXPLAINED
    assert any(left.channel == "current_a" for left in found.unexplained)
    # what resembles it most grows along a run: it is withdrawn with its values
    (withdrawn,) = [each for each in found.ruled_out if "depends on time" in each.reason]
    assert withdrawn.name == "motor_constant"
    assert len(withdrawn.values) == 1


def test_exact_twins_are_ambiguous_and_the_channel_that_distinguishes_them_is_named(worlds):
    """Without camera, heading and currents a gyro's scale and an effective track are one and the same."""
    world = worlds["husky"]
    runs = []
    for run in world.runs({"gyro_scale_ratio": 0.1}):
        wheels = run.streams["wheels"]
        speeds = Stream(wheels.time_s, wheels.values[:, :2], wheels.channels[:2])
        runs.append(replace(run, streams={"wheels": speeds, "imu": run.streams["imu"]}))
    found = diagnose(runs, world.simulation)
    assert found.verdict == Verdict.AMBIGUOUS
    assert named(found) == []
    assert {"gyro_scale", "effective_track"} <= set(found.ambiguous_sets[0])
    values = {value.name: value.value for each in found.ambiguous_values.values() for value in each}
    assert values["gyro_scale_ratio"] == pytest.approx(0.1, abs=0.01)
    assert 1 / (1 + values["effective_track_ratio"]) == pytest.approx(1.1, abs=0.02)
    assert found.next_drive is not None
    assert HEADING in found.next_drive.reason


def test_an_unfit_run_is_excluded_and_the_rest_is_diagnosed(worlds):
    world = worlds["husky"]
    runs = list(world.runs(world.hidden("payload")))
    imu = runs[2].streams["imu"]
    frozen = imu.values.copy()
    at = imu.channels.index("gyro_z_radps")
    frozen[1500:, at] = frozen[1500, at]
    runs[2] = replace(runs[2], streams={**runs[2].streams, "imu": replace(imu, values=frozen)})
    found = diagnose(runs, world.simulation)
    assert [run.run_id for run in found.excluded_runs] == [runs[2].run_id]
    assert (found.n_runs, len(found.clocks)) == (5, 5)
    assert named(found) == ["payload"]
    with pytest.raises(DataError, match="only 2 of 3 are fit to be compared") as error:
        diagnose(runs[:3], world.simulation)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_same_runs_give_the_same_answer(worlds):
    world = worlds["husky"]
    runs = world.runs(world.hidden("camera_yaw"))
    one, other = (as_json(diagnose(runs, world.simulation)) for _ in range(2))
    assert json.dumps(one) == json.dumps(other)


def test_runs_that_cannot_be_diagnosed_are_refused_in_one_sentence(worlds):
    world = worlds["husky"]
    runs = world.runs({})
    for given, message in (
        (runs[: MIN_RUNS - 1], "there are 2, at least 3"),
        ([*runs, runs[0]], "'run_01' is the id of 2 runs"),
        ([*runs, replace(worlds["agrimaro"].runs({})[0], run_id="x")], "run x is of the robot 'agrimaro'"),
    ):
        with pytest.raises(DataError) as error:
            diagnose(given, world.simulation)
        assert message in str(error.value)
        assert "\n" not in str(error.value)


def test_inputs_of_a_tilt_that_is_no_slope_are_no_evidence(worlds, monkeypatch):
    every = dict.fromkeys([("speed_x_mps", "grade"), ("speed_x_mps", "speed")])
    monkeypatch.setattr(diagnose_module, "probe_residuals", lambda *_: every)
    found = SimpleNamespace(info=None, names=(), change=None)
    signals = (SimpleNamespace(terrain="grass"),)
    for ratio, names in ((1.0, ["grade", "speed"]), (0.4, ["speed"])):
        ground = Ground(effective_ratio=ratio)
        simulation = replace(worlds["husky"].simulation, grounds={"grass": ground})
        problem = SimpleNamespace(simulation=simulation, signals=signals)
        assert [name for _, name in diagnose_module._probes(problem, found)] == names
