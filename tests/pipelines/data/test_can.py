"""CAN: values come back, damaged frames do not, frames of one instant are a sample, and a log is its run."""

import copy
import math
import re
import sys
from collections import Counter

import can
import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.data.can_frames import (
    INCOMPLETE_S,
    OPTIONAL,
    QUATERNION,
    QUEUE,
    READERS,
    SIGNALS,
    Drop,
    Receiver,
    decode,
    encode,
    load_layout,
)
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError
from terrain.files.names import data_folder
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, TWIST, WHEELS_CHANNELS
from terrain.robots import load_robot

from .foreign_bags import refused

LAYOUT = load_layout()
ROBOT = load_robot("agrimaro")
TEXT = (data_folder("can") / "agrimaro.dbc").read_text()
PLANS = {
    (stream, signal.column): signal
    for stream, plans in LAYOUT.by_stream.items()
    for plan in plans
    for signal in plan.signals
}
STREAMS = sorted(SIGNALS)
REAL_PART = ("odometry", QUATERNION[3])
"""A channel that is not sent: it follows from others."""


def frame_of(arbitration_id, data=b"", **fields):
    return can.Message(**{"arbitration_id": arbitration_id, "data": data, "is_extended_id": False} | fields)


def changed(frame, **fields):
    """Return a copy of a frame with other fields."""
    other = copy.copy(frame)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


def bounds(stream, column):
    """Least and largest value of a channel, and its resolution."""
    if (stream, column) == REAL_PART:
        return 0.0, 1.0, math.nan
    plan = PLANS[stream, column]
    return plan.factor * plan.low, plan.factor * plan.high, plan.factor * plan.scale


@pytest.mark.parametrize("stream", STREAMS)
@settings(max_examples=40)
@given(data=st.data())
def test_any_number_comes_back_within_half_a_resolution_and_never_wraps(stream, data):
    """A value beyond is the end of the range, counted; one that is not finite is not measured."""
    width = len(SIGNALS[stream])
    rows = [st.floats(*bounds(stream, column)[:2]) | st.floats() for column in range(width)]
    values, counter = data.draw(st.tuples(*rows)), data.draw(st.integers(0, 10_000))
    clipped, n_beyond = Counter(), 0
    parts = [decode(LAYOUT, frame) for frame in encode(LAYOUT, stream, values, counter, clipped=clipped)]
    assert {(part.stream, part.counter) for part in parts} == {
        (stream, counter % (16 if stream == "odometry" else 256))
    }
    found = [pair for part in parts for pair in part.values.items()]
    assert {column for column, _ in found} == {column for of, column in PLANS if of == stream}
    for column, seen in found:
        sent, (low, high, resolution) = values[column], bounds(stream, column)
        if not math.isfinite(sent):
            assert math.isnan(seen)
        elif low <= sent <= high:
            assert abs(seen - sent) <= resolution * 0.5 * (1 + 1e-6)
        else:
            assert seen == pytest.approx(low if sent < low else high, abs=1e-9)
            n_beyond += not (low - resolution / 2 <= sent <= high + resolution / 2)
    assert n_beyond <= sum(clipped.values()) <= len(values)


@pytest.mark.parametrize("stream", STREAMS)
@settings(max_examples=40)
@given(data=st.data())
def test_any_bytes_are_decoded_to_values_in_range_or_refused(stream, data):
    """Bytes of a damaged frame: no exception, no infinity, nothing beyond the bounds of the DBC."""
    plan = data.draw(st.sampled_from(LAYOUT.by_stream[stream]))
    payload = data.draw(st.binary(min_size=0, max_size=8))
    part = decode(LAYOUT, frame_of(plan.message.frame_id, payload))
    if len(payload) != 8:
        assert part is Drop.LENGTH
    elif not isinstance(part, Drop):
        for column, value in part.values.items():
            low, high, _ = bounds(stream, column)
            assert math.isnan(value) or low - 1e-9 <= value <= high + 1e-9


def test_each_wrong_bit_of_a_checked_message_is_found():
    for stream in ("corrections", "status", "twist"):
        (frame,) = encode(LAYOUT, stream, [0.1] * len(SIGNALS[stream]), 77)
        for bit in range(64):
            data = bytearray(frame.data)
            data[bit // 8] ^= 1 << bit % 8
            assert decode(LAYOUT, changed(frame, data=bytes(data))) is Drop.CHECKSUM
        other = changed(frame, arbitration_id=0x101 if stream != "corrections" else 0x102)
        assert decode(LAYOUT, other) is Drop.CHECKSUM, "the identifier is checked too"


def test_a_frame_that_is_not_used_says_why():
    for frame, drop in (
        (frame_of(0x40, is_error_frame=True), Drop.BUS_OFF),
        (frame_of(0x04, is_error_frame=True), Drop.ERROR),
        (frame_of(0x120, is_remote_frame=True), Drop.REMOTE),
        (frame_of(0x7FF, bytes(8)), Drop.UNKNOWN),
        (frame_of(0x120, bytes(8), is_extended_id=True), Drop.UNKNOWN),
        (frame_of(0x120, bytes(8), timestamp=math.nan), Drop.TIME),
    ):
        assert decode(LAYOUT, frame) is drop


def test_resolutions_are_far_below_the_noise_and_ranges_cover_the_robot():
    """Rounding adds less than 3 % to a sensor's variance; rates and speeds cover the limits of the robot."""
    sensors, camera = ROBOT.sensors, ROBOT.camera
    imu = (sensors.gyro_std_radps, sensors.accel_std_mps2, sensors.tilt_std_rad, sensors.yaw_std_rad)
    seen = (camera.position_std_m, camera.yaw_std_rad / 2, camera.speed_std_mps, camera.yaw_rate_std_radps)
    noise = {
        "wheels": zip((0, 3), (sensors.motor_std_radps, sensors.current_std_a), strict=True),
        "steering": [(0, sensors.steering_std_rad)],
        "imu": zip((0, 3, 6, 8), imu, strict=True),
        "odometry": zip((0, 3, 7, 10), seen, strict=True),
    }
    for stream, column, std in ((name, *each) for name, rows in noise.items() for each in rows):
        assert bounds(stream, column)[2] ** 2 / 12 < 0.03 * std**2, (stream, column)
    motors = ROBOT.motors
    assert bounds("wheels", 0)[1] > 2 * motors.reduction_ratio * motors.speed_max_radps
    assert bounds("corrections", 0)[1] > 1.5 * motors.speed_max_radps
    for stream, column in (("steering", 0), ("imu", 6), ("imu", 8)):
        assert bounds(stream, column)[1] > math.pi
    assert bounds("twist", 0)[1] > 1.5 * motors.speed_max_radps * ROBOT.wheel_radius_m


def test_the_signals_of_a_stream_are_in_the_order_of_its_columns():
    for stream, names in SIGNALS.items():
        assert LAYOUT.columns(stream) == set(range(len(names))) - ({6} if stream == "odometry" else set())
    columns = {"wheels": WHEELS_CHANNELS, "steering": STEERING_CHANNELS, "imu": IMU_CHANNELS, "twist": TWIST}
    for stream, channels in (columns | {"odometry": CAMERA_CHANNELS}).items():
        assert tuple(SIGNALS[stream]) == channels


@given(q=st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_a_rotation_comes_back_whatever_the_sign_of_its_quaternion(as_sent, q):
    """The angle between the rotation that was sent and the one that is received is that of rounding."""
    quaternion = [part / math.hypot(*q) for part in q]
    sent = as_sent("odometry", [0.0] * 3 + quaternion + [0.0] * 7)
    _, found = received(encode(LAYOUT, "odometry", sent, 0), ("odometry",))
    seen = found["odometry"].values[0, 3:7]
    along = abs(sum(a * b for a, b in zip(seen, quaternion, strict=True)))
    assert math.hypot(*seen) == pytest.approx(1.0, abs=1e-5)
    assert along > 1.0 - 3e-6  # beside half a turn the real part follows by a square root


def frames(counter, time_s=1.0, stream="imu"):
    width = {"imu": 9, "wheels": 6}[stream]
    return encode(LAYOUT, stream, [counter + 0.1 * k for k in range(width)], counter, time_s)


def received(sent, streams=("imu", "wheels"), now_s=10.0):
    receiver = Receiver(LAYOUT, streams)
    for frame in sent:
        receiver.take(frame)
    return receiver, receiver.readings(now_s)


def test_a_sample_has_the_stamp_of_its_first_frame_whatever_their_order():
    rates, accels, attitude = frames(0, 1.0)
    wheels = frames(4, 1.0, "wheels")
    late = changed(accels, timestamp=1.001), wheels[1], attitude, changed(rates, timestamp=1.002), wheels[0]
    _, found = received([attitude, *late])
    assert found["imu"].time_s.tolist() == [1.0]
    np.testing.assert_allclose(found["imu"].values, [np.arange(9) * 0.1], atol=3e-4)
    np.testing.assert_allclose(found["wheels"].values, [4 + np.arange(6) * 0.1], atol=1e-2)


def test_a_lost_frame_is_nan_in_its_part_only_and_an_incomplete_sample_waits():
    for lost in (0, 1, 2):
        sent = [f for k in range(3) for j, f in enumerate(frames(k, 1.0 + 0.01 * k)) if (k, j) != (1, lost)]
        receiver, found = received(sent)
        gone = np.isnan(found["imu"].values)
        assert gone.sum() == 3
        assert gone[1, 3 * lost : 3 * lost + 3].all()
        assert receiver.dropped == {"imu: part missing": 1}
        assert (np.diff(found["imu"].time_s) > 0).all()
    receiver = Receiver(LAYOUT, ("imu",))
    receiver.take(frames(0, 1.0)[0])
    assert receiver.readings(1.0 + 0.5 * INCOMPLETE_S) == {}
    assert len(receiver.readings(1.001 + INCOMPLETE_S)["imu"].time_s) == 1
    for late in frames(0, 1.03)[1:]:
        receiver.take(late)
    assert receiver.readings(2.0) == {}, "its other frames are too late"
    assert receiver.dropped == {"imu: part missing": 1, "imu: repeated or late": 2}


def test_what_is_no_new_sample_is_dropped_and_counted():
    """A counter that stands still, frames of this side that come back, and what is never read."""
    receiver, found = received([f for k in range(5) for f in frames(3, 1.0 + 0.01 * k)])
    assert (len(found["imu"].time_s), receiver.dropped["imu: repeated or late"]) == (1, 12)
    receiver, found = received(encode(LAYOUT, "corrections", [1.0, 1.0, 1.0], 0))
    assert (found, receiver.dropped) == ({}, {"corrections: not read here": 1})
    receiver, found = received([f for k in range(QUEUE + 50) for f in frames(k, 1.0 + 0.01 * k, "wheels")])
    assert len(found["wheels"].time_s) == QUEUE
    assert found["wheels"].time_s[-1] == pytest.approx(1.0 + 0.01 * (QUEUE + 49))
    assert receiver.dropped == {"wheels: queue full": 50}


MOTORS = 'SG_ MotorRate1 : 0|18@1- (0.002,0) [-262.142|262.142] "rad/s"'


def test_a_dbc_that_does_not_fit_is_one_sentence(tmp_path, monkeypatch):
    for old, new, sentence in (
        (" SG_ MotorRate1 ", " SG_ Speed1 ", "lacks the signal 'MotorRate1'"),
        (MOTORS, MOTORS.replace('"rad/s"', '"m/s"'), "of motor_1_radps: unit 'm/s' does not suit it"),
        (MOTORS, MOTORS.replace('"rad/s"', '""'), "of motor_1_radps: unit '' is unknown"),
        (MOTORS, MOTORS.replace("(0.002,0)", "(0,0)"), "scale"),
        (MOTORS, MOTORS.replace("[-262.142|262.142]", "[300|400]"), "no value between its bounds"),
        (" SG_ CameraConfidence ", " SG_ MotorRate1 ", "'MotorRate1' is in the messages"),
        (" SG_ MotorCurrent1 ", " SG_ SteeringAngle1 ", "'SteeringAngle1'"),
        (" SG_ SteeringAngle3 ", " SG_ MotorRate4 ", "'SteeringAngle3'"),
        ("BO_ 288 MotorRates: 8", "BO_ 288 MotorRates: 4", "is no DBC"),
        ("BO_ 288 MotorRates: 8", "BO_ 288 MotorRates: 64", "64 bytes"),
        ("BO_ 288", "BO_ two", "is no DBC"),
        (' SG_ DesiredSpeedX : 0|16@1- (0.0001,0) [-3.2767|3.2767] "m/s" OnboardPC\n', "", "DesiredSpeedX"),
        (" SG_ Gyro", " SG_ Rate", "lacks the signal 'GyroX' and 2 more"),
        (TEXT, "", "robot.dbc"),
        (TEXT, "VERSION", "robot.dbc"),
        (TEXT, "\x00\x01" * 99, "robot.dbc"),
        (TEXT, TEXT[: len(TEXT) // 3], "robot.dbc"),
    ):
        assert old in TEXT
        (tmp_path / "robot.dbc").write_text(TEXT.replace(old, new))
        with pytest.raises(ConfigError, match=re.escape(sentence)) as raised:
            load_layout(tmp_path / "robot.dbc")
        assert "\n" not in str(raised.value)
    with pytest.raises(ConfigError, match="cannot be opened"):
        load_layout(tmp_path / "none.dbc")
    monkeypatch.setitem(sys.modules, "cantools", None)
    with pytest.raises(ConfigError, match=r"terrain-slip\[can\]"):
        load_layout()


def test_what_no_controller_needs_may_lack(tmp_path):
    text = TEXT.replace(" SG_ CameraPosition", " SG_ Place").replace(" SG_ TargetSlip", " SG_ Slip")
    (tmp_path / "robot.dbc").write_text(text)
    layout = load_layout(tmp_path / "robot.dbc")
    for stream in ("odometry", "status"):
        lacking = set(range(len(SIGNALS[stream]))) - layout.columns(stream)
        assert lacking
        assert {tuple(SIGNALS[stream])[column] for column in lacking} <= OPTIONAL
    assert "CameraPosition" not in {plan.message.name for plan in layout.by_stream["odometry"]}


OWN = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 2566844926 Fast: 8 ECU
 SG_ MotorRate1 : 7|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ MotorRate2 : 23|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ MotorRate3 : 39|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ Alive : 55|4@0+ (1,0) [0|15] "" ECU
BO_ 513 Multiplexed: 8 ECU
 SG_ Which M : 0|8@1+ (1,0) [0|2] "" ECU
 SG_ MotorCurrent1 m0 : 8|16@1- (1,0) [0|0] "mA" ECU
 SG_ MotorCurrent2 m1 : 8|16@1- (1,0) [0|0] "mA" ECU
 SG_ MotorCurrent3 m2 : 8|16@1- (1,0) [0|0] "mA" ECU
BO_ 514 Angles: 8 ECU
 SG_ SteeringAngle1 : 0|32@1- (1,0) [-180|180] "deg" ECU
 SG_ SteeringAngle2 : 32|16@1- (0.01,0) [-180|180] "deg" ECU
 SG_ SteeringAngle3 : 48|16@1- (0.01,0) [-180|180] "deg" ECU
SIG_VALTYPE_ 514 SteeringAngle1 : 1;
"""


def test_another_dbc_with_units_and_layouts_of_its_own_is_read(tmp_path):
    """Big-endian, an offset, rpm, an extended identifier, multiplexed currents in mA, a float in degrees."""
    (tmp_path / "own.dbc").write_text(OWN)
    layout = load_layout(tmp_path / "own.dbc", complete=False)
    receiver = Receiver(layout, ("wheels", "steering"))
    database = cantools.database.load_file(tmp_path / "own.dbc")
    sent = [("Fast", {"MotorRate1": 600, "MotorRate2": -1200.5, "MotorRate3": 0, "Alive": 0})]
    sent += [("Multiplexed", {"Which": i, f"MotorCurrent{i + 1}": 1000 * (i - 1)}) for i in range(3)]
    sent += [("Angles", {"SteeringAngle1": 90.0, "SteeringAngle2": -45.0, "SteeringAngle3": 200.0})]
    for name, values in sent:
        message = database.get_message_by_name(name)
        data = database.encode_message(name, values, strict=False)
        receiver.take(frame_of(message.frame_id, data, is_extended_id=message.is_extended_frame))
    readings = receiver.readings(3.0)
    rpm = 2 * math.pi / 60
    np.testing.assert_allclose(
        readings["wheels"].values, [[600 * rpm, -1200.5 * rpm, 0.0, -1.0, 0.0, 1.0]], rtol=1e-9
    )
    np.testing.assert_allclose(readings["steering"].values[0, :2], [math.pi / 2, -math.pi / 4], rtol=1e-6)
    assert math.isnan(readings["steering"].values[0, 2]), "200 degrees are beyond the bounds"
    assert receiver.dropped == {"steering: out of range": 1}
    frame, *_ = encode(layout, "steering", [math.nan, 99.0, -99.0], 0)
    part = decode(layout, frame)
    assert math.isnan(part.values[0])
    assert [part.values[1], part.values[2]] == pytest.approx([math.pi, -math.pi])


def write(path, frames, start_s=1.7e9):
    """Write frames as a log, with frames of other devices between them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with can.Logger(path) as log:
        for number, frame in enumerate(frames):
            sent = changed(frame, timestamp=start_s + frame.timestamp)
            log(sent)
            if number % 100 == 0:
                log(changed(sent, arbitration_id=0x7F0, data=b"other", dlc=5))


@pytest.mark.parametrize("suffix", [suffix for suffix in READERS if suffix != ".trc"])
def test_a_log_is_the_run_that_was_sent(tmp_path, estimated_run, run_frames, suffix):
    run = estimated_run
    write(tmp_path / "GRASS" / f"one{suffix}", run_frames(LAYOUT, run))
    (found,) = load_runs(tmp_path, layout="can")
    assert (found.run_id, found.robot, found.terrains) == ("GRASS_one", "agrimaro", ("GRASS",))
    assert set(found.streams) == {"wheels", "steering", "imu", "odometry", "commands"}
    assert set(found.dropped) == {"unknown id"}
    for name in ("wheels", "steering", "imu", "odometry"):
        sent, read = run.streams[name], found.streams[name]
        np.testing.assert_allclose(read.time_s, sent.time_s, atol=2e-4)
        for column, channel in enumerate(SIGNALS[name]):
            if channel in sent.channels and channel != "confidence_ratio":
                step = 1e-5 if (name, column) == REAL_PART else PLANS[name, column].scale
                np.testing.assert_allclose(read.channel(channel), sent.channel(channel), atol=step)


def test_lost_and_damaged_frames_are_refused_or_counted(tmp_path, estimated_run, run_frames):
    frames = run_frames(LAYOUT, estimated_run)
    imu = [place for place, frame in enumerate(frames) if frame.arbitration_id == 0x141]
    twist = [place for place, frame in enumerate(frames) if frame.arbitration_id == 0x110]
    frames[twist[9]] = changed(frames[twist[9]], data=bytes(8))
    del frames[imu[-1]], frames[imu[20]]  # one in the last sample, which nothing follows
    write(tmp_path / "drive.log", frames)
    refused(r"drive\.log.*--repair", tmp_path, layout="can")
    (found,) = load_runs(tmp_path, layout="can", repair=True)
    assert dict(found.dropped) == {
        "unknown id": -(-len(frames) // 100),
        "wrong checksum": 1,
        "imu: part missing": 2,
    }
    assert np.isnan(found.streams["imu"].channel("accel_x_mps2")).sum() == 2
    assert not found.labels


def test_a_log_without_the_messages_or_of_another_kind_is_one_sentence(tmp_path):
    refused("holds no run", tmp_path, layout="can")
    write(tmp_path / "a" / "other.asc", encode(LAYOUT, "corrections", [0.0] * 3, 0))
    refused("no frame of the messages", tmp_path, layout="can")
    refused("is no DBC", tmp_path, layout="can", mapping=tmp_path / "a" / "other.asc")
    (tmp_path / "a" / "a.blf").write_bytes(b"no log at all" * 50)
    refused("is no log of a CAN", tmp_path, layout="can")
