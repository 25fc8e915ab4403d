"""A session gives the commands of a pilot and the terrain of an observer, whatever is sent to it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pipelines.live.chain import CommandStatus
from pipelines.live.classifying import Classifier
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.session import (
    NO_SAMPLE,
    NO_WHEELS,
    NOT_FOLLOWED,
    TWIST_FRESH_S,
    Hello,
    RobotSession,
    Served,
)
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.estimation.live import CHANNELS
from terrain.logs.replay import replay
from terrain.robots import load_robot

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
SENT = {name: tuple(names) for name, names in CHANNELS.items() if name != "gnss"}
NOW_S = 500.0
"""Of the local clock, where the robot's is 0."""


def agrimaro(model=None, channels=SENT):
    request = Hello(session="one", robot="agrimaro", streams=channels, control=True)
    return RobotSession(request, Served(1, model, "test", TABLE), ROBOT)


def mower(model):
    request = Hello(
        session="m", robot="mower", streams={"imu": ["accel_z_mps2"], "wheels": ["speed_left_mps"]}
    )
    return RobotSession(request, Served(1, model, "test", TABLE), None)


def send(session, sample):
    """Send each row of a sample as a message of its own, as it comes; the newest stamp is now."""
    for stamp in sorted({t for reading in sample.readings.values() for t in reading.time_s.tolist()}):
        streams = {
            name: (times[times == stamp].tolist(), values[times == stamp].tolist())
            for name, (times, values) in sample.readings.items()
            if stamp in times
        }
        session.put(streams, None, NOW_S + stamp)
    session.put(None, sample.twist.tolist(), NOW_S + sample.time_s)


def drive(session, samples, change=lambda session, sample: None):
    outputs = []
    for sample in samples:
        send(session, sample)
        change(session, sample)
        outputs.append(session.step(NOW_S + sample.time_s))
    return outputs


@pytest.fixture(scope="module")
def samples(survey):
    return [sample for sample in replay(survey) if sample.time_s < 16.0]


@pytest.fixture(scope="module")
def plain(samples, swerve_model):
    """The outputs of a session that is driven as it is."""
    return drive(agrimaro(swerve_model), samples)


def test_two_sessions_see_what_observers_alone_see_and_do_not_know_of_each_other(mower_model, two_drives):
    runs = two_drives[0], two_drives[4]
    sessions, observers = ([make(mower_model) for _ in runs] for make in (mower, Observer))
    for pair in zip(*map(replay, runs), strict=True):
        for session, observer, sample in zip(sessions, observers, pair, strict=True):
            (output,) = drive(session, [sample])
            observer.update(sample.readings)
            assert output.observation["terrain"] == (observer.belief.terrain or None)
            assert output.command is None
    assert [session.chain.belief.terrain for session in sessions] == ["a", "b"]
    assert output.observation["window"]["start_s"] == 10.0


def test_columns_are_taken_by_name_and_what_is_not_sent_is_unknown(samples, plain, swerve_model):
    turned = [
        sample._replace(
            readings={n: r._replace(values=r.values[:, ::-1]) for n, r in sample.readings.items()}
        )
        for sample in samples[:400]
    ]
    found = drive(agrimaro(swerve_model, {name: names[::-1] for name, names in SENT.items()}), turned)
    for output, desired in zip(found, plain, strict=False):
        np.testing.assert_array_equal(output.command.wheel_radps, desired.command.wheel_radps)
    rates = [
        sample._replace(readings={"wheels": wheels._replace(values=wheels.values[:, :3])})
        for sample in samples[:200]
        if (wheels := sample.readings.get("wheels"))
    ]
    outputs = drive(agrimaro(channels={"wheels": SENT["wheels"][:3]}), rates)
    seen = outputs[-1].observation
    assert (seen["sensors"]["gyro"], seen["sensors"]["wheel_1"]) == ("lost", "fresh")
    assert np.isnan(seen["current_a"]).all()
    assert all(np.isfinite(o.command.wheel_radps).all() for o in outputs)


def test_commands_are_those_of_a_pilot_that_is_given_the_samples_at_once(samples, plain, swerve_model):
    """Also where messages are late, of a robot that says at which time of its own it asks for a step."""
    rng, now_s, n_driving = np.random.default_rng(2), NOW_S, 0
    session, pilot = agrimaro(swerve_model), LivePilot(ROBOT, TABLE, Classifier(swerve_model, ROBOT))
    for sample, ticked in zip(samples, plain, strict=True):
        now_s = max(now_s, NOW_S + sample.time_s + rng.exponential(0.05))
        streams = {name: (t.tolist(), values.tolist()) for name, (t, values) in sample.readings.items()}
        session.put(streams, sample.twist.tolist(), now_s)
        output, desired = session.step(now_s, sample.time_s), pilot.take(sample).command
        assert output.time_s == sample.time_s
        np.testing.assert_array_equal(output.command.wheel_radps, desired.wheel_radps)
        np.testing.assert_array_equal(output.command.steer_rad, desired.steer_rad)
        assert (ticked.status, ticked.time_s) == (CommandStatus.OK, pytest.approx(sample.time_s, abs=1e-9))
        np.testing.assert_allclose(ticked.command.wheel_radps, desired.wheel_radps, atol=1e-6)
        n_driving += float(np.abs(desired.wheel_radps).max()) > 1.0
    assert n_driving > 350
    last, driving = plain[-1].observation, plain[600].observation
    assert (last["terrain"], last["target_of"]) == ("grass", "grass")
    assert np.isfinite(driving["slip_ratio"]).all()
    assert driving["sensors"]["gyro"] == "fresh"


def test_a_desired_motion_that_is_too_old_stops_the_robot_until_a_new_one_comes(samples):
    def lose_it(session, sample):  # the samples come
        if 3.0 <= sample.time_s < 7.0:
            session._twist_s = min(session._twist_s, NOW_S + 3.0)

    forward = [sample._replace(twist=np.array([0.5, 0.0, 0.0])) for sample in samples[:500]]
    for output in (outputs := drive(agrimaro(), forward, lose_it)):
        lost = 3.0 + TWIST_FRESH_S < output.time_s < 7.0
        assert (output.status is CommandStatus.NO_TWIST) is lost, output.time_s
        assert not (lost and output.time_s > 5.5 and output.command.wheel_radps.any())
    assert np.abs(outputs[-1].command.wheel_radps).max() > 1.0


def test_a_robot_begins_with_its_steering_where_it_is_and_stands_until_that_is_known():
    session = agrimaro()
    angles_rad = ROBOT.steering_zeros_rad + np.array([1.4, 1.5, 1.6])
    wheels, unknown = [[0.0], [[0.0] * 6]], [[0.0], [[math.nan] * 3]]
    for streams in (None, {"wheels": wheels}, {"steering": unknown}):
        session.put(streams, [0.0, 0.5, 0.0], NOW_S)
        output = session.step(NOW_S)
        assert output.status is CommandStatus.NO_SAMPLES
        assert not output.command.wheel_radps.any()
        assert math.isnan(output.time_s) is (streams is None)
        assert set(output.observation["sensors"].values()) == {"lost"} or streams is not None
    session.put({"steering": [[0.02], [angles_rad.tolist()]]}, [0.0, 0.5, 0.0], NOW_S + 0.02)
    output = session.step(NOW_S + 0.02)
    assert output.status is CommandStatus.OK
    assert np.abs(output.command.steer_rad - [1.4, 1.5, 1.6]).max() < 0.2


@pytest.mark.parametrize("follows", [True, False])
def test_wheels_that_do_not_do_what_is_commanded_are_the_reason_of_an_unknown_slip(follows):
    streams = {"wheels": ["speed_left_mps", "speed_right_mps"], "imu": ["gyro_z_radps"]}
    request = Hello(session="h", robot="husky", streams=streams, control=True, follows=follows)
    session = RobotSession(request, Served(1, None, "", TABLE), load_robot("husky"))
    for time_s in np.arange(0.0, 4.0, 0.02).tolist():
        rows = {
            "wheels": ([time_s], [[1.0, 1.0 + 0.01 * math.sin(50.0 * time_s)]]),
            "imu": ([time_s], [[0.0]]),
        }
        session.put(rows, [0.1, 0.0, 0.0], NOW_S + time_s)
        step = session.step(NOW_S + time_s)
    assert (step.observation["slip_unknown"] == NOT_FOLLOWED) == follows


def test_over_a_link_that_is_late_slip_is_known_and_of_a_stream_that_stops_it_is_not():
    streams = {"wheels": ["speed_left_mps", "speed_right_mps"], "gnss": ["velocity_x_mps", "velocity_y_mps"]}
    request = Hello(session="h", robot="husky", streams=streams, control=True, follows=False)
    session = RobotSession(request, Served(1, None, "", TABLE), load_robot("husky"))
    for time_s in np.arange(0.0, 8.0, 0.02).tolist():
        if time_s < 7.0:
            rows = {"wheels": ([time_s], [[0.6, 0.6 + 0.01 * math.sin(50.0 * time_s)]])}
            rows |= {"gnss": ([time_s], [[0.5, 0.002 * math.cos(time_s)]])}
            session.put(rows, None, NOW_S + time_s + (0.2 if time_s > 5.0 else 0.0))
        seen = session.step(NOW_S + time_s + (0.2 if time_s > 5.0 else 0.0)).observation
        if 3.0 < time_s < 6.5:
            assert seen["slip_ratio"] == pytest.approx([0.167, 0.167], abs=0.05)
    assert (seen["slip_unknown"], list(seen["slip_ratio"])) == (
        NO_WHEELS,
        pytest.approx([math.nan] * 2, nan_ok=True),
    )


def test_before_the_first_sample_a_driven_robot_is_not_said_to_have_no_filter():
    assert agrimaro().step(NOW_S).observation["slip_unknown"] == NO_SAMPLE


@pytest.mark.parametrize("fault", ["raises", {"wheel_radps": math.nan}, {"steer_rad": math.inf}])
def test_a_step_that_fails_commands_to_stand(samples, monkeypatch, fault):
    session = agrimaro()
    drive(session, samples[:100])
    steer_rad, step = session.step(NOW_S + 2.1).command.steer_rad, session.chain.step

    def broken(sample):
        if fault == "raises":
            raise ZeroDivisionError("unforeseen")
        return step(sample)._replace(**{name: np.array([1.0, value, 1.0]) for name, value in fault.items()})

    monkeypatch.setattr(session.chain, "step", broken)
    output = session.step(NOW_S + 3.0)
    assert output.status is (CommandStatus.FAILED if fault == "raises" else CommandStatus.NOT_FINITE)
    assert not output.command.wheel_radps.any()
    assert output.command.steer_rad.tolist() == steer_rad.tolist()
    assert ("unforeseen" in output.failure) is (fault == "raises")
    monkeypatch.undo()
    session.put(None, [0.5, 0.0, 0.0], NOW_S + 3.1)
    assert session.step(NOW_S + 3.1).status is CommandStatus.OK


def swap_at(time_s, model):
    """What serves another model at a time."""

    def swap(session, sample):
        if abs(sample.time_s - time_s) < 1e-6:
            session.swap(Served(session.served.number + 1, model, "again", TABLE))

    return swap


def test_a_swap_to_the_same_windows_loses_none(samples, plain, swerve_model):
    swapped = drive(agrimaro(swerve_model), samples[:500], swap_at(samples[250].time_s, swerve_model))
    assert swapped[-1].observation["served"] == 2
    for one, other in zip(plain, swapped, strict=False):
        assert one.observation["terrain"] == other.observation["terrain"]
        np.testing.assert_array_equal(one.command.wheel_radps, other.command.wheel_radps)


def test_a_swap_to_other_windows_goes_on_with_them_and_a_model_can_come_after_the_robot(
    mower_model, two_drives, samples, swerve_model
):
    shorter = mower_model._replace(info=replace(mower_model.info, stride_s=1.0))
    outputs = drive(mower(mower_model), replay(two_drives[4]), swap_at(5.0, shorter))
    starts = {
        round(o.observation["window"]["start_s"], 6) for o in outputs if o.observation["window"] is not None
    }
    assert sorted(starts) == [0.0, 2.0, *np.arange(5.0, 10.5, 1.0).tolist()]
    late = drive(agrimaro(), samples[:600], swap_at(samples[50].time_s, swerve_model))
    assert late[-1].observation["terrain"] == "grass"


def test_what_cannot_be_served_is_refused_in_one_sentence_and_changes_nothing(mower_model, swerve_model):
    session, driven = mower(mower_model), agrimaro(swerve_model)
    others = Served(2, swerve_model, "other", replace(TABLE, robot="husky"))
    with pytest.raises(DataError, match="neither measured nor estimated"):
        session.swap(Served(2, swerve_model, "other", TABLE))
    with pytest.raises(ConfigError, match="is of the robot 'husky', not of 'agrimaro'"):
        driven.swap(others)
    for one in (session, driven):
        with pytest.raises(DataError, match="cannot be replaced by none"):
            one.swap(Served(2, None, "", TABLE))
    assert (session.served.number, session.chain.model, driven.served.number) == (1, mower_model, 1)
    unknown = {"control": True}, "has no description here: commands cannot be given to it"
    for asked, fault in (unknown, ({}, "no model is served: only a robot that asks for commands can be")):
        with pytest.raises((ConfigError, DataError), match=fault):
            RobotSession(
                Hello(session="one", robot="r", streams=SENT, **asked), Served(1, None, "", TABLE), None
            )


def test_streams_that_stop_are_lost_and_come_back_and_a_silent_robots_terrain_becomes_unknown(
    mower_model, two_drives, samples
):
    session, silent = mower(mower_model), list(replay(two_drives[4]))
    for sample in silent:
        if 4.0 < sample.time_s < 6.0:
            sample.readings.pop("imu", None)
    for output in (outputs := drive(session, silent)):
        health, time_s = output.observation["sensors"]["imu"], output.time_s
        assert health == "fresh" or 4.0 <= time_s <= 6.1, time_s
        assert health == "lost" or not 4.6 < time_s < 6.0, time_s
    assert session.chain.belief.terrain == "b"
    for k in range(300):
        seen = session.step(NOW_S + outputs[-1].time_s + 0.1 * (k + 1)).observation
    assert (seen["terrain"], set(seen["sensors"].values())) == (None, {"lost"})
    driven = agrimaro()
    drive(driven, samples[:250])
    for k in range(100):  # messages without samples do not drive it on
        driven.put(None, [0.5, 0.0, 0.0], NOW_S + 5.0 + 0.1 * k)
        output = driven.step(NOW_S + 5.0 + 0.1 * k)
    assert set(output.observation["sensors"].values()) == {"lost"}
    assert output.command.status["stale_s"] > 5.0
    assert not np.isfinite(output.observation["slip_ratio"]).any()


def test_what_is_kept_is_as_old_as_the_last_sample_over_any_number_of_restarts(
    mower_model, two_drives, monkeypatch
):
    clock = {"now_s": 1000.0}
    monkeypatch.setattr("pipelines.live.session.time", lambda: clock["now_s"])
    session, again, third = (mower(mower_model) for _ in range(3))
    drive(session, replay(two_drives[4]))
    clock["now_s"] = 1008.0
    again.restore(session.state())
    assert again.restored.terrain == "b"
    clock["now_s"] = 1016.0  # it sent nothing meanwhile
    third.restore(again.state())
    assert third.restored.terrain == ""


def test_samples_that_come_too_late_are_named_within_five_seconds_and_no_longer_than_they_do(
    samples, swerve_model
):
    """The wheels come 0.4 s after the other streams from 3 s to 9 s, in order."""
    session, texts, waiting = agrimaro(swerve_model), {}, []
    for sample in samples:
        now_s, readings = sample.time_s, dict(sample.readings)
        if "wheels" in readings:
            waiting.append((now_s + 0.4 * (3.0 <= now_s < 9.0), readings.pop("wheels")))
        due = [reading for due_s, reading in waiting if due_s <= now_s]
        waiting = [(due_s, reading) for due_s, reading in waiting if due_s > now_s]
        for name, reading in (*readings.items(), *(("wheels", reading) for reading in due)):
            session.put({name: (reading.time_s.tolist(), reading.values.tolist())}, None, NOW_S + now_s)
        session.put(None, sample.twist.tolist(), NOW_S + now_s)
        session.step(NOW_S + now_s)
        texts[now_s] = session.late
    named = {time_s: text for time_s, text in texts.items() if text}
    assert 3.0 < min(named) <= 8.0
    assert all(text.startswith("no terrain: samples come late by 4") for text in named.values())
    assert texts[max(texts)] == ""
    assert session.content()["late"] is None
