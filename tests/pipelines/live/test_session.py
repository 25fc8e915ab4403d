"""A session gives the commands of a pilot and the terrain of an observer, whatever is sent to it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.live.arrivals import StreamHealth
from pipelines.live.chain import CommandStatus
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.session import TWIST_FRESH_S, RobotSession, Served, SessionRequest
from pipelines.live.terrain_source import Classifier
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.estimator import CHANNELS
from terrain.logs.replay import SENSORS, replay
from terrain.records import Reading, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
SENT = {name: tuple(names) for name, names in CHANNELS.items() if name != "gnss"}
NOW_S = 500.0
"""Of the local clock, where the robot's is 0."""


@pytest.fixture(scope="module")
def log():
    return simulate_run(ROBOT, "grass", "survey", 6, duration_s=25.0)


def agrimaro(model=None, channels=SENT, control=True):
    request = SessionRequest("one", "agrimaro", channels, control)
    return RobotSession(request, Served(1, model, "test", TABLE), ROBOT)


def mower(model, robot="mower"):
    request = SessionRequest("m", robot, {"imu": ("accel_z_mps2",), "wheels": ("speed_left_mps",)})
    return RobotSession(request, Served(1, model, "test", TABLE), None)


def send(session, sample, twist=None):
    """Send each row of a sample as a message of its own, as it comes; the newest stamp is now."""
    stamps = sorted({t for reading in sample.readings.values() for t in reading.time_s.tolist()})
    for stamp in stamps:
        streams = {
            name: (times[times == stamp].tolist(), values[times == stamp].tolist())
            for name, (times, values) in sample.readings.items()
            if stamp in times
        }
        session.put(streams, None, NOW_S + stamp)
    session.put(None, sample.twist.tolist() if twist is None else twist, NOW_S + sample.time_s)


def drive(session, log, change=lambda session, sample: None):
    outputs = []
    for sample in replay(log):
        send(session, sample)
        change(session, sample)
        outputs.append(session.step(NOW_S + sample.time_s))
    return outputs


@pytest.fixture(scope="module")
def plain(log, swerve_model):
    """The outputs of a session that is driven as it is."""
    return drive(agrimaro(swerve_model), log)


def steered(pilot, log):
    """A pilot that begins with the steering where it is measured first."""
    pilot.start_steering(log.streams["steering"].values[0])
    return pilot


def test_commands_are_those_of_a_pilot_that_is_given_the_samples_at_once(log, plain, swerve_model):
    outputs = plain
    pilot = steered(LivePilot(ROBOT, TABLE, Classifier(swerve_model, ROBOT)), log)
    n_driving = 0
    for output, sample in zip(outputs, replay(log), strict=True):
        desired = pilot.step(sample)
        assert output.status is CommandStatus.OK
        assert output.time_s == pytest.approx(sample.time_s, abs=1e-9)
        np.testing.assert_allclose(output.command.wheel_radps, desired.wheel_radps, atol=1e-6)
        np.testing.assert_allclose(output.command.steer_rad, desired.steer_rad, atol=1e-6)
        n_driving += float(np.abs(desired.wheel_radps).max()) > 1.0
    assert n_driving > 500
    assert outputs[-1].observation.terrain == "grass"
    assert outputs[-1].observation.target["traction"].terrain == "grass"
    assert np.isfinite(outputs[600].observation.slip_ratio).all()
    assert outputs[600].observation.sensors["gyro"] == "fresh"


def test_terrain_is_that_of_an_observer_for_a_robot_without_a_description(mower_model, two_drives):
    run = two_drives[4]
    outputs = drive(mower(mower_model), run)
    observer = Observer(mower_model)
    for output, sample in zip(outputs, replay(run), strict=True):
        observer.update(sample.readings)
        assert output.observation.terrain == observer.belief.terrain
        assert output.command is None
    assert outputs[-1].observation.terrain == "b"
    assert outputs[-1].observation.window.start_s == 10.0


def test_two_sessions_on_one_model_do_not_know_of_each_other(mower_model, two_drives):
    runs = two_drives[0], two_drives[3]
    sessions, both = (mower(mower_model, "one"), mower(mower_model, "two")), ([], [])
    for samples in zip(*map(replay, runs), strict=True):
        for session, sample, found in zip(sessions, samples, both, strict=True):
            send(session, sample)
            found.append(session.step(NOW_S + sample.time_s).observation)
    seen = [[(one.terrain, one.window and one.window[:4]) for one in found] for found in both]
    for run, found in zip(runs, seen, strict=True):
        alone = [output.observation for output in drive(mower(mower_model), run)]
        assert found == [(one.terrain, one.window and one.window[:4]) for one in alone]
    assert seen[0] != seen[1]


def test_columns_are_taken_by_name_and_what_is_not_sent_is_unknown(log, plain, swerve_model):
    session = agrimaro(swerve_model, {name: names[::-1] for name, names in SENT.items()})
    for sample, desired in zip(replay(log), plain, strict=True):
        turned = {
            name: reading._replace(values=reading.values[:, ::-1])
            for name, reading in sample.readings.items()
        }
        send(session, sample._replace(readings=turned))
        output = session.step(NOW_S + sample.time_s)
        np.testing.assert_array_equal(output.command.wheel_radps, desired.command.wheel_radps)
    fewer = agrimaro(channels={"wheels": SENT["wheels"][:3]})
    wheels = log.streams["wheels"]
    rates = Stream(wheels.time_s, wheels.values[:, :3], wheels.channels[:3])
    outputs = drive(fewer, replace(log, streams={"wheels": rates}))
    assert outputs[-1].observation.sensors["gyro"] == "lost"
    assert outputs[-1].observation.sensors["wheel_1"] == "fresh"
    assert np.isnan(outputs[-1].observation.current_a).all()
    assert all(np.isfinite(o.command.wheel_radps).all() for o in outputs)


def test_a_robot_that_asks_for_its_steps_gets_them_at_its_own_time_however_late_messages_are(log):
    rng, now_s = np.random.default_rng(2), NOW_S
    session, pilot = agrimaro(), steered(LivePilot(ROBOT, TABLE), log)
    for sample in replay(log):
        now_s = max(now_s, NOW_S + sample.time_s + rng.exponential(0.05))
        streams = {name: (t.tolist(), values.tolist()) for name, (t, values) in sample.readings.items()}
        session.put(streams, sample.twist.tolist(), now_s)
        output, desired = session.step(now_s, sample.time_s), pilot.step(sample)
        assert output.time_s == sample.time_s
        np.testing.assert_array_equal(output.command.wheel_radps, desired.wheel_radps)
        np.testing.assert_array_equal(output.command.steer_rad, desired.steer_rad)


def test_a_desired_motion_that_is_too_old_stops_the_robot_until_a_new_one_comes(log):
    session = agrimaro()
    seen = []
    for sample in replay(log):
        send(session, sample._replace(twist=np.array([0.5, 0.0, 0.0])))
        if 8.0 <= sample.time_s < 12.0:  # the desired motion is lost, the samples come
            session._twist_s = min(session._twist_s, NOW_S + 8.0)
        output = session.step(NOW_S + sample.time_s)
        seen.append((sample.time_s, output.status, float(np.abs(output.command.wheel_radps).max())))
    for time_s, status, fastest in seen:
        lost = 8.0 + TWIST_FRESH_S < time_s < 12.0
        assert (status is CommandStatus.NO_TWIST) is lost, time_s
        if lost and time_s > 10.5:
            assert fastest == 0.0
    assert seen[-1][2] > 1.0


def test_before_the_first_sample_the_command_is_to_stand():
    session = agrimaro()
    session.put(None, [1.0, 0.0, 0.0], NOW_S)
    output = session.step(NOW_S)
    assert output.status is CommandStatus.NO_SAMPLES
    assert not output.command.wheel_radps.any()
    assert math.isnan(output.time_s)
    assert set(output.observation.sensors.values()) == {"lost"}


@pytest.mark.parametrize(
    ("fault", "status"),
    [
        (ZeroDivisionError("unforeseen"), CommandStatus.FAILED),
        ({"wheel_radps": np.array([1.0, math.nan, 1.0])}, CommandStatus.NOT_FINITE),
        ({"steer_rad": np.array([0.0, math.inf, 0.0])}, CommandStatus.NOT_FINITE),
    ],
)
def test_a_step_that_fails_commands_to_stand(log, monkeypatch, fault, status):
    session = agrimaro()
    drive(session, replace(log, streams={k: v for k, v in log.streams.items() if k in SENSORS}))
    steer_rad = session.step(NOW_S + 20.0).command.steer_rad
    step = session.chain.step

    def broken(sample):
        if isinstance(fault, Exception):
            raise fault
        return step(sample)._replace(**fault)

    monkeypatch.setattr(session.chain, "step", broken)
    output = session.step(NOW_S + 30.0)
    assert output.status is status
    assert not output.command.wheel_radps.any()
    assert output.command.steer_rad.tolist() == steer_rad.tolist()
    assert ("unforeseen" in session.failure) is (status is CommandStatus.FAILED)
    monkeypatch.undo()
    session.put(None, [0.5, 0.0, 0.0], NOW_S + 30.1)
    assert session.step(NOW_S + 30.1).status is CommandStatus.OK


names = st.one_of(st.sampled_from(["imu", "wheels", "odometry"]), st.text(max_size=3))
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3), st.binary(max_size=3)
)
anything = st.recursive(
    leaves,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(names, inner, max_size=4)),
    max_leaves=12,
)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(anything, anything), max_size=6))
def test_whatever_is_sent_nothing_raises_and_commands_are_finite(messages):
    session = agrimaro()
    for k, (streams, twist) in enumerate(messages):
        session.put(streams, twist, NOW_S + k / 10)
        output = session.step(NOW_S + k / 10)
        for numbers in output.command[:3]:
            assert np.isfinite(numbers).all()


def test_what_was_refused_is_counted_by_reason():
    session = agrimaro()
    assert session.put({"imu": [[0.0], [[1.0] * 9]]}, None, 1.0) == 1
    for broken in ("text", [1], {"lidar": [[0.0], [[1.0]]]}, {"imu": 5}, {"imu": [[0.0], [[1.0]]]}):
        assert session.put(broken, None, 1.0) == 0
    session.put(None, [1.0, math.nan, 0.0], 1.0)
    session.put(None, "fast", 1.0)
    assert session.dropped == {
        "samples that are not given by stream": 2,
        "stream that was not announced": 1,
        "sample that is no pair of stamps and rows": 1,
        "imu: not rows of 9 numbers": 1,
        "twist that is not three numbers": 2,
    }


def test_a_swap_to_the_same_windows_loses_none(log, plain, swerve_model):
    def swap(session, sample):
        if 500 <= round(sample.time_s * 50) % 600 < 503:
            session.swap(Served(session.served.number + 1, swerve_model._replace(), "again", TABLE))

    swapped = drive(agrimaro(swerve_model), log, swap)
    assert swapped[-1].observation.served == 7
    for one, other in zip(plain, swapped, strict=True):
        assert one.observation.terrain == other.observation.terrain
        np.testing.assert_array_equal(one.command.wheel_radps, other.command.wheel_radps)


def test_a_swap_to_other_windows_goes_on_with_them(mower_model, two_drives):
    shorter = mower_model._replace(info=replace(mower_model.info, stride_s=1.0))
    starts = []

    def swap(session, sample):
        if abs(sample.time_s - 5.0) < 1e-6:
            session.swap(Served(2, shorter, "shorter", TABLE))

    for output in drive(mower(mower_model), two_drives[4], swap):
        if output.observation.window is not None:
            starts.append(round(output.observation.window.start_s, 6))
    assert sorted(set(starts)) == [0.0, 2.0, *np.arange(5.0, 10.5, 1.0).tolist()]


def test_a_swap_that_does_not_suit_is_refused_and_changes_nothing(mower_model, swerve_model):
    session = mower(mower_model)
    with pytest.raises(DataError, match="neither measured nor estimated"):
        session.swap(Served(2, swerve_model, "other", TABLE))
    assert (session.served.number, session.chain.model) == (1, mower_model)
    driven = agrimaro(swerve_model)
    with pytest.raises(ConfigError, match="is of the robot 'husky', not of 'agrimaro'"):
        driven.swap(Served(2, swerve_model, "other", replace(TABLE, robot="husky")))
    with pytest.raises(ConfigError, match="is of the robot 'husky', not of 'agrimaro'"):
        driven.check(Served(2, swerve_model, "other", replace(TABLE, robot="husky")))  # before any is swapped
    assert driven.served.number == 1
    for one in (session, driven):
        with pytest.raises(DataError, match="cannot be replaced by none"):
            one.swap(Served(2, None, "", TABLE))


def test_a_model_can_come_after_the_robot(log, swerve_model):
    session = agrimaro()

    def swap(session, sample):
        if session.served.model is None and sample.time_s > 5.0:
            session.swap(Served(2, swerve_model, "late", TABLE))

    assert drive(session, log, swap)[-1].observation.terrain == "grass"


@pytest.mark.parametrize(
    ("robot", "channels", "control", "fault"),
    [
        (None, SENT, True, "has no description here"),
        (load_robot("husky"), {"wheels": ("speed_left_mps",)}, True, "has no pilot, only 'swerve' has"),
        (ROBOT, {"imu": ("gyro_z_radps",)}, False, "no model is served"),
    ],
)
def test_a_request_that_cannot_be_served_is_refused_in_one_sentence(robot, channels, control, fault):
    request = SessionRequest("one", "r", channels, control)
    with pytest.raises((ConfigError, DataError), match=fault):
        RobotSession(request, Served(1, None, "", TABLE), robot)


def test_streams_that_stop_are_lost_and_come_back(mower_model, two_drives):
    session, seen = mower(mower_model), []
    for sample in replay(two_drives[4]):
        if 4.0 < sample.time_s < 6.0:
            sample.readings.pop("imu", None)
        send(session, sample)
        seen.append((sample.time_s, session.step(NOW_S + sample.time_s).observation.sensors["imu"]))
    for time_s, health in seen:
        if time_s < 4.0 or time_s > 6.1:
            assert health == "fresh", time_s
        elif 4.6 < time_s < 6.0:
            assert health == "lost", time_s


def test_a_robot_whose_sensors_died_is_not_driven_on_by_messages_without_samples(log):
    session = agrimaro()
    drive(session, log)
    for k in range(200):
        now_s = NOW_S + log.end_s + 0.05 * (k + 1)
        session.put(None, [0.5, 0.0, 0.0], now_s)
        output = session.step(now_s)
    assert set(output.observation.sensors.values()) == {"lost"}
    assert output.command.status["stale_s"] > 5.0
    assert not np.isfinite(output.observation.slip_ratio).any()


def test_a_robot_begins_with_its_steering_where_it_is_and_stands_until_that_is_known():
    session = agrimaro()
    angles_rad = ROBOT.steering_zeros_rad + np.array([1.4, 1.5, 1.6])
    wheels, unknown = [[0.0], [[0.0] * 6]], [[0.0], [[math.nan] * 3]]
    for streams in ({"wheels": wheels}, {"steering": unknown}):
        session.put(streams, [0.0, 0.5, 0.0], NOW_S)
        output = session.step(NOW_S)
        assert output.status is CommandStatus.NO_SAMPLES
        assert not output.command.wheel_radps.any()
    session.put({"steering": [[0.02], [angles_rad.tolist()]]}, [0.0, 0.5, 0.0], NOW_S + 0.02)
    output = session.step(NOW_S + 0.02)
    assert output.status is CommandStatus.OK
    assert np.abs(output.command.steer_rad - [1.4, 1.5, 1.6]).max() < 0.2


def test_a_silent_robots_terrain_becomes_unknown(mower_model, two_drives):
    session = mower(mower_model)
    last = drive(session, two_drives[4])[-1]
    assert last.observation.terrain == "b"
    for k in range(300):
        seen = session.step(NOW_S + last.time_s + 0.1 * (k + 1)).observation
    assert (seen.terrain, set(seen.sensors.values())) == ("", {"lost"})


def test_what_is_kept_is_as_old_as_the_last_sample_over_any_number_of_restarts(
    mower_model, two_drives, monkeypatch
):
    clock = {"now_s": 1000.0}
    monkeypatch.setattr("pipelines.live.session.time", lambda: clock["now_s"])
    session = mower(mower_model)
    drive(session, two_drives[4])
    clock["now_s"] = 1008.0
    again = mower(mower_model)
    assert again.restore(session.state()).belief.terrain == "b"
    clock["now_s"] = 1016.0  # it sent nothing meanwhile
    third = mower(mower_model)
    assert third.restore(again.state()).belief.terrain == ""


def test_a_stream_that_ended_before_the_clock_was_set_back_is_lost():
    health = StreamHealth({"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)})
    reading = Reading(np.array([0.0]), np.array([[0.1]]))
    health.take({"imu": reading, "wheels": reading}, 5000.0)
    for k in range(20):
        health.take({"imu": reading}, 1000.0 + 0.1 * k)
    assert health.health(1002.0) == {"imu": "fresh", "wheels": "lost"}
