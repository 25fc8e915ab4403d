"""Controllers made by hand: what they are given is held against the log, what they tell against motion."""

import dataclasses
import math

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.logs.read import read_run
from terrain.logs.schema import signal_set_of
from terrain.logs.write import write_run
from terrain.records import Command
from terrain.robots import load_robot
from terrain.simulation.conditions import Conditions, Faults
from terrain.simulation.dynamic.plant import make_plant, start_state, uniform_profile
from terrain.simulation.dynamic.simulate import COMMAND_CHANNELS, Drive, simulate
from terrain.simulation.dynamic.step import advance, settle
from terrain.simulation.scenario import make_scenario
from terrain.simulation.sensors import BODY_ROW, Gnss
from terrain.terramechanics.soil import load_soil, soil_names

ROBOT = load_robot("agrimaro")
SOILS = {name: load_soil(name) for name in soil_names()}
STAND = Command(np.zeros(3), np.zeros(3), np.zeros(3), {})
HILLY = Conditions(grade_ratio=(0.05, -0.03), undulation_ratio=0.02, payload_kg=15.0, leg_backlash_rad=0.02)


class Listener:
    """A controller that keeps what it is given and asks another one what to do."""

    def __init__(self, controller):
        self.controller, self.samples = controller, []

    def __call__(self, sample):
        self.samples.append(sample)
        return self.controller(sample)

    def received(self, stream):
        given = [sample.readings[stream] for sample in self.samples if stream in sample.readings]
        return np.concatenate([r.time_s for r in given]), np.vstack([r.values for r in given])


def kinematic(sample):
    """Command the wheel speeds of the desired twist, with the steering straight ahead."""
    wheel = np.full(3, sample.twist[0] / 0.2) + sample.twist[2] * np.array([0.0, 0.0, 0.756 / 0.2])
    steer = np.array([-1.0, 1.0, 0.0]) * math.atan2(0.5075 * sample.twist[2], max(sample.twist[0], 0.1))
    return Command(wheel, steer, sample.twist, {})


def play_back(run):
    rows = iter(run.streams["commands"].values)

    def controller(sample):
        row = next(rows)
        return Command(row[3:6], row[6:], row[:3], {})

    return controller


def run_of(scenario, terrain, controller=None, seed=0, duration_s=None, **options):
    drive = make_scenario(scenario, ROBOT, terrain, duration_s)
    return simulate(ROBOT, drive, SOILS, seed, controller=controller, **options)


def wheels_of(stream, pattern):
    return np.column_stack([stream.channel(pattern.format(i)) for i in (1, 2, 3)])


@pytest.mark.parametrize(
    ("scenario", "terrain", "options"),
    [
        (
            "complex",
            "grass",
            {"conditions": HILLY, "gnss": Gnss(rate_hz=7.0), "faults": Faults(gnss_lost_s=((3.0, 5.0),))},
        ),
        ("straight", "tiles", {"faults": Faults(camera_lost_s=((2.0, 3.51), (4.0, 4.001)))}),
        ("course", ["tiles", "snow", "grass"], {"duration_s": 25.0}),
    ],
)
def test_the_readings_of_a_controller_equal_the_log(scenario, terrain, options, tmp_path):
    listener = Listener(kinematic)
    run = run_of(scenario, terrain, listener, 3, **options)
    drive = make_scenario(scenario, ROBOT, terrain, options.get("duration_s"))
    ticks_s = np.array([sample.time_s for sample in listener.samples])
    np.testing.assert_array_equal(ticks_s, drive.time_s)
    np.testing.assert_array_equal([sample.twist for sample in listener.samples], drive.twist)
    sensed = set(run.streams) - {"commands", "truth"}
    assert set().union(*(sample.readings for sample in listener.samples)) == sensed
    for name in sensed:
        stream = run.streams[name]
        time_s, values = listener.received(name)
        n = np.searchsorted(
            stream.time_s, ticks_s[-1], side="right"
        )  # after the last tick no controller runs
        assert time_s.tobytes() == stream.time_s[:n].tobytes()
        assert values.tobytes() == stream.values[:n].tobytes()
        for before_s, sample in zip([-1.0, *ticks_s[:-1]], listener.samples, strict=True):
            stamps = sample.readings[name].time_s if name in sample.readings else np.empty(0)
            assert ((stamps > before_s) & (stamps <= sample.time_s)).all()
    assert all(len(sample.readings["wheels"].time_s) == 1 for sample in listener.samples)
    for start_s, end_s in options.get("faults", Faults()).camera_lost_s:
        inside = [s for s in listener.samples if start_s + 0.02 <= s.time_s < end_s]
        assert not any("odometry" in sample.readings for sample in inside)
    truth = run.streams["truth"]
    for label in run.labels:
        for sample in listener.samples:
            if label.start_s <= sample.time_s < label.end_s:
                assert sample.terrain == label.terrain
    known = [sample.terrain for sample in listener.samples]
    assert (("" in known) and len(set(known)) > 2) == (scenario == "course")
    assert read_run(write_run(run, tmp_path)).streams["truth"].channels == truth.channels


def test_commands_played_back_give_the_motion_of_the_run_they_are_from():
    """The only difference is the millisecond that a command of the loop comes later."""
    for scenario, terrain in (("complex", "grass"), ("straight", "firm_soil_gravel")):
        plain = run_of(scenario, terrain, seed=5)
        played = run_of(scenario, terrain, play_back(plain), 5)
        np.testing.assert_array_equal(plain.streams["commands"].values, played.streams["commands"].values)
        one, other = (run.streams["truth"] for run in (plain, played))
        distance_m = np.abs(one.channel("speed_x_mps")).sum() / 100
        for name, atol in (("position_x_m", 2e-3), ("position_y_m", 2e-3), ("yaw_rad", 2e-3)):
            assert np.abs(one.channel(name) - other.channel(name)).max() < atol * max(1.0, distance_m / 10)
        lag = one.channel("speed_x_mps") - other.channel("speed_x_mps")
        assert np.abs(lag).max() < 5e-3  # 1 m/s2 for a millisecond, and what roughness makes of it
        slower = run_of(scenario, terrain, play_back(plain), 5, command_delay_s=0.1)
        late = slower.streams["truth"].channel("speed_x_mps")[10:] - one.channel("speed_x_mps")[:-10]
        assert np.abs(late).max() < 0.1
        assert (
            np.abs(slower.streams["truth"].channel("speed_x_mps") - one.channel("speed_x_mps")).max() > 0.08
        )


@pytest.mark.parametrize("delay", [1, 7, 20, 33, 500])
def test_pieces_between_commands_are_the_drive_in_which_each_step_has_its_own(delay):
    rng = np.random.default_rng(delay)
    soil = SOILS["clay"]
    conditions = Conditions(
        payload_kg=10.0, payload_m=(0.1, 0.0), grade_ratio=(0.03, 0.02), leg_backlash_rad=0.02
    )
    plant, profile = make_plant(ROBOT, conditions), uniform_profile(ROBOT, soil, roughness_m3=1e-4)
    n, substeps = 60, 20
    wheel, steer = 4 * rng.random((n, 3)), 0.3 * rng.standard_normal((n, 3))
    noise = rng.standard_normal((n * substeps, 3))
    start = start_state(np.zeros(3))
    settle(plant, profile, start)
    one, other = start.copy(), start.copy()
    pieces, whole = np.empty(n * substeps, BODY_ROW), np.empty(n * substeps, BODY_ROW)
    drive = Drive(plant, profile, one, noise, pieces)
    for k in range(n):
        assert drive.until(k * substeps + 1)
        drive.command(k * substeps + delay, wheel[k], steer[k])
    assert drive.until(n * substeps)
    tick = (np.arange(n * substeps) - delay) // substeps
    held_wheel, held_steer = (np.where(tick[:, None] >= 0, rows[tick], 0.0) for rows in (wheel, steer))
    advance(plant, profile, other, held_wheel, held_steer, 1, noise, whole)
    assert one.tobytes() == other.tobytes()
    assert pieces.tobytes() == whole.tobytes()


@pytest.mark.parametrize("delay_s", [0, 0.01, 0.05, np.float64(0.123), 0.5])
def test_wheels_stand_until_the_first_command_arrives(delay_s):
    def at_once(sample):
        return STAND._replace(wheel_radps=np.full(3, 3.0), steer_rad=np.full(3, 0.2))

    run = run_of("stand", "tiles", at_once, duration_s=2.0, command_delay_s=delay_s)
    truth = run.streams["truth"]
    turning = truth.time_s[np.abs(wheels_of(truth, "wheel_{}_radps")).max(axis=1) > 0]
    assert delay_s < turning[0] <= delay_s + 0.02
    assert (run.streams["commands"].values[:, 3:6] == 3.0).all()  # as decided, not as delayed
    np.testing.assert_allclose(wheels_of(truth, "wheel_{}_radps")[-1], 3.0, atol=0.1)
    np.testing.assert_allclose(wheels_of(truth, "steer_{}_rad")[-1], 0.2, atol=0.025)


def test_a_loop_over_the_camera_drives_at_the_speed_that_slip_takes_away():
    """On grass an eighth of the wheel speed is lost; an integral of the speed's error brings it back."""
    gain = {"ratio": 1.0}

    def controller(sample):
        if "odometry" in sample.readings and sample.twist[0] > 0.99:
            speed_mps = np.hypot(*sample.readings["odometry"].values[:, [7, 9]].T).mean()
            gain["ratio"] += 0.02 * (sample.twist[0] - speed_mps)
        wheel = np.full(3, gain["ratio"] * sample.twist[0] / 0.2)
        return Command(wheel, np.zeros(3), sample.twist, {"gain_ratio": gain["ratio"]})

    run = run_of("straight", "grass", controller, 2, command_delay_s=0.02)
    truth, control = run.streams["truth"], run.streams["control"]
    late = truth.time_s > 12.0
    assert truth.channel("speed_x_mps")[late].mean() == pytest.approx(1.0, abs=0.01)
    assert run_of("straight", "grass", seed=2).streams["truth"].channel("speed_x_mps")[-500:].mean() < 0.9
    assert control.channels == ("gain_ratio",)
    assert len(control) == len(run.streams["commands"])
    assert control.values[-1] == gain["ratio"] > 1.1
    assert signal_set_of("control", "gain_ratio") is None
    assert list(run.streams)[-2:] == ["control", "truth"]


def test_the_same_controller_and_seed_give_the_same_log_and_no_status_no_stream():
    one, again = (run_of("arc", "snow", kinematic, 4, 8.0, gnss=Gnss()) for _ in range(2))
    assert "control" not in one.streams
    for name, stream in one.streams.items():
        assert stream.values.tobytes() == again.streams[name].values.tobytes()
    assert one.streams["commands"].channels == COMMAND_CHANNELS


def test_leg_backlash_deflects_the_robot_unseen_by_the_steering_encoder():
    runs = [
        run_of(
            "starts", "grass", seed=1, duration_s=20.0, conditions=Conditions(leg_backlash_rad=backlash_rad)
        )
        for backlash_rad in (0.0, 0.03)
    ]
    firm, loose = (run.streams["truth"] for run in runs)
    assert np.abs(firm.channel("steer_3_rad")).max() <= ROBOT.steering.dead_band_rad
    leg = loose.channel("steer_3_rad") - firm.channel("steer_3_rad")  # it steers straight ahead in both
    assert np.abs(leg).max() == pytest.approx(0.03, abs=1e-9)
    assert np.ptp(leg) == pytest.approx(0.06, abs=1e-9)
    np.testing.assert_array_equal(runs[0].streams["steering"].values, runs[1].streams["steering"].values)
    drift_m = loose.channel("position_y_m") - firm.channel("position_y_m")
    assert np.abs(drift_m).max() > 0.02  # it goes off to the side


@pytest.mark.parametrize("delay_s", [-0.01, 0.51, math.nan, math.inf, "soon", None, True])
def test_an_invalid_delay_is_refused(delay_s):
    for controller in (None, kinematic):
        with pytest.raises(ConfigError, match=r"command_delay_s is .*, a time from 0 to 0.5 s is required"):
            run_of("straight", "grass", controller, duration_s=4.0, command_delay_s=delay_s)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"wheel_radps": np.zeros(2)}, "wheel_radps of its command at 1.02 s is .*, 3 finite numbers"),
        ({"wheel_radps": np.array([0.0, math.nan, 0.0])}, "wheel_radps of its command at 1.02 s"),
        ({"steer_rad": [0.0, math.inf, 0.0]}, "steer_rad of its command at 1.02 s"),
        ({"steer_rad": "left"}, "steer_rad of its command at 1.02 s is 'left'"),
        ({"twist": np.zeros((3, 1))}, "twist of its command at 1.02 s"),
        ({"status": {}}, "at 1.02 s has nothing, that of the first has gain_ratio: the same names"),
        ({"status": {"gain_ratio": 1.0, "more_ratio": 1.0}}, "at 1.02 s has gain_ratio, more_ratio, that of"),
        ({"status": {"gain_ratio": "high"}}, "status of its command at 1.02 s: could not convert"),
        ({"status": None}, "status of its command at 1.02 s"),
    ],
)
def test_an_invalid_command_is_refused_with_its_time(changed, message):
    def controller(sample):
        command = STAND._replace(status={"gain_ratio": math.nan})
        return command._replace(**changed) if sample.time_s > 1.01 else command

    with pytest.raises(DataError, match=message) as error:
        run_of("straight", "grass", controller, duration_s=4.0)
    assert "\n" not in str(error.value)


def test_a_status_without_a_unit_is_refused():
    with pytest.raises(DataError, match="status of its command at 0 s: channel 'mood' does not end in"):
        run_of("straight", "grass", lambda sample: STAND._replace(status={"mood": 1.0}), duration_s=4.0)


@pytest.mark.parametrize(
    ("section", "changes"),
    [
        ("body", {"yaw_inertia_kgm2": 1e-9}),
        ("body", {"tyre_stiffness_npm": 1e12}),
        (None, {"mass_kg": 1e9}),
        ("motors", {"friction_nm": 1e9}),  # found in the drive; the others before it
    ],
)
def test_a_robot_whose_motion_blows_up_is_refused_and_its_controller_sees_none_of_it(section, changes):
    if section is None:
        robot = dataclasses.replace(ROBOT, **changes)
    else:
        robot = ROBOT.with_parts(**{section: dataclasses.replace(getattr(ROBOT, section), **changes)})
    listener = Listener(lambda sample: kinematic(sample)._replace(status={"gain_ratio": 1.0}))
    drive = make_scenario("arc", ROBOT, "grass", 5.0)
    with pytest.raises(ConfigError, match="its motion cannot be integrated"):
        simulate(robot, drive, SOILS, 0, controller=listener)
    for sample in listener.samples:
        assert all(np.isfinite(reading.values).all() for reading in sample.readings.values())
