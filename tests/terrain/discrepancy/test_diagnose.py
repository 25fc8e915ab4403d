"""Attribution: a hidden effect is named, and what no log distinguishes is ambiguous, on every drive."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from studies.blind_trials.drives import car_drives, rich_drives
from studies.blind_trials.limits import confusable_class, limits_of
from studies.blind_trials.trial import hidden_runs, simulation_of

import terrain.discrepancy.diagnose as diagnose_module
from pipelines.report.results import as_json
from terrain.discrepancy.diagnose import MIN_RUNS, diagnose
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.verdict import Tier
from terrain.effects import CURRENT, GYRO, HEADING, TURNING_CURRENT, effect_named
from terrain.errors import DataError
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground

pytestmark = pytest.mark.usefixtures("without_next_drive")
OVER = 4.0
"""Times the smallest amplitude that these drives could show."""

OF_WHEELS_AND_CURRENTS = {
    "husky": (
        "lever_arm imu_latency one_sided_radius camera_latency clock_rate scrub side_hill_slip "
        "turn_side_slip turn_drag ground_slip"
    ),
    "agrimaro": (
        "steering_offset_2 steering_backlash encoder_lag gyro_scale accel_bias force_slip viscous_drag "
        "wheel_scale_2 current_offset gyro_nonlinearity"
    ),
}
"""Effects of wheels, steering, sensors, clocks, masses, motors and the ground; some of each robot."""
WITHOUT_CURRENTS = (
    ("marmotte", {"turning_slip_ratio": 0.1}),
    ("adap2e", {"understeer_s2pm": 0.02, "cornering_stiffness_ratio": 0.4}),
    ("adap2e", {"side_hill_slip_ratio": 0.15}),
    ("adap2e", {"steering_offset_front_rad": 0.01}),
    ("adap2e", {"steering_backlash_rad": 0.01}),
    ("adap2e", {"steering_gain_ratio": 0.1}),
    ("agrimaro", {"steering_lag_s": 0.15}),
    ("adap2e", {"steering_lag_s": 0.2}),
    ("adap2e", {"steering_dead_zone_rad": 0.02}),
    ("adap2e", {"wheel_dead_zone_mps": 0.03}),
    ("marmotte", {"side_hill_slip_ratio": 0.2}),
    ("marmotte", {"ground_slip_ratio": 0.1}),
    ("patako", {"force_slip_ratio": 0.4}),
    ("patako", {"wheel_radius_ratio": 0.05}),
    ("patako", {"turning_slip_ratio": 0.5, "turning_slip_power_ratio": 0.4}),
)
"""What is hidden in tracked and car-like robots, whose logs have no currents."""
ALONE = [(robot, name) for robot, names in OF_WHEELS_AND_CURRENTS.items() for name in names.split()]
FAST = (ALONE[0], ("agrimaro", "steering_offset_2"), *WITHOUT_CURRENTS[:2])


class World:
    """A robot, six drives, and how small effects these could show."""

    def __init__(self, name):
        self.robot, rng = load_robot(name), np.random.default_rng(3)
        self.simulation = simulation_of(self.robot)
        car = name == "adap2e"
        self.drives = car_drives(rng, self.robot, 6, 40.0) if car else rich_drives(rng, 6, 30.0)
        self.limits = limits_of(self.robot, self.drives)

    def runs(self, hidden, outside=None):
        return hidden_runs(self.robot, self.drives, np.random.SeedSequence(11), hidden, outside)

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
    made = {}
    return lambda name: made.get(name) or made.setdefault(name, World(name))


def named(diagnosis):
    return [cause.name for cause in diagnosis.causes]


def are_right(diagnosis, hidden):
    """Return whether all hidden values are within four standard deviations of those stated."""
    values = {value.name: value for cause in diagnosis.causes for value in cause.parameters}
    assert set(values) == set(hidden), (diagnosis.verdict, diagnosis.ambiguous_sets)
    return all(abs(v.value - hidden[v.name]) < 4 * (v.high - v.low) / (2 * 2.13) for v in values.values())


@pytest.mark.parametrize(
    "name",
    ["agrimaro", *(pytest.param(name, marks=pytest.mark.slow) for name in ("husky", "adap2e", "marmotte"))],
)
def test_where_nothing_is_hidden_nothing_is_named(worlds, name):
    world = worlds(name)
    diagnosis = diagnose(world.runs({}), world.simulation)
    assert (diagnosis.robot, diagnosis.n_runs) == (name, 6)
    assert (diagnosis.causes, diagnosis.ambiguous_sets, diagnosis.varying) == ((), (), ())
    assert (diagnosis.excluded_runs, diagnosis.faults) == ((), ())
    assert len(diagnosis.ruled_out) == len(world.simulation.library)
    assert all(abs(clock.offset_s) < 0.02 for clock in diagnosis.clocks)
    assert json.loads(json.dumps(as_json(diagnosis), allow_nan=False))["verdict"] == diagnosis.verdict
    if name in ("adap2e", "marmotte"):
        assert CURRENT not in diagnosis.residual_before
        return
    # so short runs do not excite all that a Husky may lack
    assert diagnosis.verdict == (None if name == "agrimaro" else Tier.NOT_SHOWN)
    assert diagnosis.unexplained == ()
    assert {limit.name for limit in diagnosis.detection_limits} >= {"payload_ratio", "gyro_bias_radps"}
    # what is apart is noise, and what scatters from run to run: biases of the gyro, resistance of the ground to turns
    apart = {channel: residual.systematic for channel, residual in diagnosis.residual_before.items()}
    assert all(ratio < 0.4 for channel, ratio in apart.items() if channel not in (GYRO, TURNING_CURRENT)), (
        apart
    )


@pytest.mark.parametrize(
    ("robot", "effect"),
    [
        pytest.param(*case, marks=[pytest.mark.slow] * (case not in FAST))
        for case in [*ALONE, *WITHOUT_CURRENTS]
    ],
)
def test_what_is_hidden_is_named_with_its_value_and_nothing_beside_it(worlds, robot, effect):
    world = worlds(robot)
    hidden = world.hidden(effect) if isinstance(effect, str) else effect
    diagnosis = diagnose(world.runs(hidden), world.simulation)
    if not diagnosis.causes:
        assert effect in diagnosis.ambiguous_sets[0]
        assert set(diagnosis.ambiguous_sets[0]) <= world.twins(effect)
        return
    assert diagnosis.verdict == Tier.NAMED
    assert are_right(diagnosis, hidden)
    assert diagnosis.causes[0].held_out_gain > 0
    before, after = (
        sum(residual.systematic for residual in residuals.values())
        for residuals in (diagnosis.residual_before, diagnosis.residual_after)
    )
    assert after < before


def test_two_effects_are_named_beside_a_run_that_is_unfit_and_half_of_one_where_half_is_built_in(worlds):
    world = worlds("husky")
    track, payload = world.hidden("effective_track", over=8.0), world.hidden("payload")
    runs = list(world.runs(track | payload))
    wheels = runs[2].streams["wheels"]
    dead, at = wheels.values.copy(), wheels.channels.index("speed_left_mps")
    dead[:, at] = 0.0
    runs[2] = replace(runs[2], streams={**runs[2].streams, "wheels": replace(wheels, values=dead)})
    half = {name: 0.5 * value for name, value in track.items()}
    diagnosis = diagnose(runs, world.simulation.with_effects(half))
    assert [run.run_id for run in diagnosis.excluded_runs] == [runs[2].run_id]
    assert (diagnosis.n_runs, len(diagnosis.clocks)) == (5, 5)
    assert sorted(named(diagnosis)) == ["effective_track", "payload"]
    assert are_right(diagnosis, half | payload)
    parameters, matrix = diagnosis.covariance
    assert matrix.shape == (len(parameters),) * 2
    assert set(parameters) == set(track | payload) == set(diagnosis.values)
    stranger = replace(worlds("agrimaro").runs({})[0], run_id="x")
    for given, message in (
        (runs[:3], "only 2 of 3 are fit to be compared"),
        (runs[: MIN_RUNS - 1], "there are 2, at least 3"),
        ([*runs, runs[0]], "'run_01' is the id of 2 runs"),
        ([*runs, stranger], "run x is of the robot 'agrimaro'"),
    ):
        with pytest.raises(DataError, match=message) as error:
            diagnose(given, world.simulation)
        assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "half_rad"), [("husky", 0.15), ("adap2e", 0.2), ("marmotte", 0.1)])
def test_backlash_of_the_drive_is_named_with_its_size(worlds, robot, half_rad):
    diagnosis = diagnose(worlds(robot).runs({"drive_backlash_rad": half_rad}), worlds(robot).simulation)
    assert named(diagnosis) == ["drive_backlash"]
    assert diagnosis.values["drive_backlash_rad"] == pytest.approx(half_rad, rel=0.1)


@pytest.mark.slow
def test_an_effect_that_another_takes_the_place_of_comes_in_beside_it(worlds):
    hidden = {"turning_resistance_ratio": 0.7, "effective_track_ratio": 0.6}
    diagnosis = diagnose(worlds("husky").runs(hidden), worlds("husky").simulation)
    assert sorted(named(diagnosis)) == ["effective_track", "turning_resistance"]
    assert are_right(diagnosis, hidden)


def test_an_effect_of_no_library_or_without_its_entry_is_unexplained(worlds):
    world = worlds("husky")
    diagnosis = diagnose(world.runs({}, {"wheel_eccentricity_ratio": 0.03}), world.simulation)
    assert (diagnosis.verdict, named(diagnosis)) == (Tier.UNEXPLAINED, [])
    assert any("wheel" in left.input for left in diagnosis.unexplained)
    few = ("motor_constant", "payload", "current_offset", "wheel_radius", "scrub", "viscous_drag")
    library = [effect_named(name) for name in few]
    diagnosis = diagnose(world.runs(world.hidden("motor_drift", over=8.0)), world.simulation, library)
    assert (diagnosis.verdict, named(diagnosis)) == (Tier.CANDIDATE, [])
    assert any(left.channel == "current_a" for left in diagnosis.unexplained)
    # what resembles it most grows along a run: it is withdrawn with its values
    (withdrawn,) = [each for each in diagnosis.candidates if "depends on time" in each.reason]
    assert withdrawn.name == "motor_constant"
    assert len(withdrawn.parameters) == 1


@pytest.mark.slow
def test_what_a_withdrawn_cause_makes_is_unexplained_if_it_is_a_part_of_its_channel(worlds, monkeypatch):
    """A gyro that reads a quarter more than its range is plausible is no gyro scale, and most of its channel."""
    world = worlds("husky")
    monkeypatch.setattr(diagnose_module, "_probes", lambda *_: {})
    runs = world.runs({"gyro_scale_ratio": 0.13})
    stated = diagnose(runs, world.simulation)
    assert [left.input for left in stated.unexplained if left.channel == GYRO] == ["gyro_scale"]
    assert stated.unexplained[0].residual_ratio > 0.5
    monkeypatch.setattr(diagnose_module, "LITTLE_LEFT", 1.1)
    assert not diagnose(runs, world.simulation).unexplained


def without_camera(world, hidden):
    """Runs without camera, heading and currents: a gyro's scale and an effective track are one and the same."""
    runs = []
    for run in world.runs(hidden):
        wheels = run.streams["wheels"]
        speeds = Stream(wheels.time_s, wheels.values[:, :2], wheels.channels[:2])
        runs.append(replace(run, streams={"wheels": speeds, "imu": run.streams["imu"]}))
    return runs


def test_an_effect_comes_in_whose_place_a_cause_took_that_is_withdrawn(worlds, monkeypatch):
    world, withdrawn = worlds("husky"), []

    def once(problem, fit, probes):
        reasons = {} if withdrawn else {cause.name: "it cannot be" for cause in fit.causes}
        withdrawn.extend(reasons)
        return reasons

    monkeypatch.setattr(diagnose_module, "reasons_to_withdraw", once)
    library = [effect_named(name) for name in ("gyro_scale", "effective_track")]
    diagnosis = diagnose(without_camera(world, {"gyro_scale_ratio": 0.065}), world.simulation, library)
    assert len(withdrawn) == 1
    assert {cause.name for cause in diagnosis.built_in} == {effect.name for effect in library} - {*withdrawn}


def test_exact_twins_are_ambiguous_and_the_channel_that_distinguishes_them_is_named(worlds, monkeypatch):
    world = worlds("husky")
    monkeypatch.setattr(diagnose_module, "next_drive", next_drive)

    def diagnosed(ratio):
        return diagnose(without_camera(world, {"gyro_scale_ratio": ratio}), world.simulation)

    diagnosis = diagnosed(0.065)
    assert (diagnosis.verdict, named(diagnosis)) == (Tier.SET, [])
    assert {"gyro_scale", "effective_track"} <= set(diagnosis.ambiguous_sets[0])
    values = {v.name: v.value for values in diagnosis.ambiguous_values.values() for v in values}
    assert values["gyro_scale_ratio"] == pytest.approx(0.065, abs=0.01)
    assert 1 / (1 + values["effective_track_ratio"]) == pytest.approx(1.065, abs=0.02)
    assert HEADING in diagnosis.next_drive.reason
    # no gyro is 12 % off
    assert named(diagnosed(0.12)) == ["effective_track"]


def test_inputs_of_a_tilt_that_is_no_slope_are_no_evidence(worlds, monkeypatch):
    every = dict.fromkeys([("speed_x_mps", "grade"), ("speed_x_mps", "speed")])
    monkeypatch.setattr(diagnose_module, "probe_residuals", lambda *_: every)
    fit = SimpleNamespace(info=None, names=(), change=None)
    for ratio, names in ((1.0, ["grade", "speed"]), (0.4, ["speed"])):
        simulation = replace(worlds("husky").simulation, grounds={"grass": Ground(effective_ratio=ratio)})
        problem = SimpleNamespace(simulation=simulation, signals=(SimpleNamespace(terrain="grass"),))
        assert [name for _, name in diagnose_module._probes(problem, fit)] == names
