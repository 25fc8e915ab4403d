"""Round trips within half a resolution, saturation that never wraps, and NaN for what was not measured."""

import math
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.data.can_codec import Drop, Frame, decode, encode, load_layout
from pipelines.data.can_logs import Receiver
from pipelines.data.can_signals import OPTIONAL, QUATERNION, SIGNALS, as_sent, channels_of
from terrain.robots import load_robot

LAYOUT = load_layout()
ROBOT = load_robot("agrimaro")
PLANS = {
    (stream, signal.column): signal
    for stream, plans in LAYOUT.by_stream.items()
    for plan in plans
    for signal in plan.signals
}
STREAMS = sorted(SIGNALS)
REAL_PART = ("odometry", QUATERNION[3])
"""A channel that is not sent: it follows from others."""


def bounds(stream, column):
    """Least and largest value of a channel, and its resolution."""
    if (stream, column) == REAL_PART:
        return 0.0, 1.0, math.nan
    plan = PLANS[stream, column]
    return plan.factor * plan.low, plan.factor * plan.high, plan.factor * plan.scale


def values_of(stream, strategy=None):
    """Values of all channels of a stream, within their ranges unless a strategy is given."""
    rows = [
        st.floats(*bounds(stream, column)[:2], allow_nan=False) if strategy is None else strategy
        for column in range(len(channels_of(stream)))
    ]
    return st.tuples(*rows)


def round_trip(stream, values, counter=0, clipped=None):
    """Return the values that are decoded from the frames of some."""
    found = [math.inf] * len(values)  # of a channel that is not sent
    for frame in encode(LAYOUT, stream, values, counter, clipped=clipped):
        assert len(frame.data) == 8
        part = decode(LAYOUT, frame)
        assert part.stream == stream
        assert part.counter == counter % (16 if stream == "odometry" else 256)
        for column, value in zip(part.columns, part.values, strict=True):
            found[column] = value
    return found


@pytest.mark.parametrize("stream", STREAMS)
@settings(max_examples=60)
@given(data=st.data())
def test_values_come_back_within_half_a_resolution(stream, data):
    values = data.draw(values_of(stream))
    counter = data.draw(st.integers(0, 10_000))
    for column, (sent, found) in enumerate(zip(values, round_trip(stream, values, counter), strict=True)):
        if (stream, column) == REAL_PART:
            continue
        assert abs(found - sent) <= bounds(stream, column)[2] * 0.5 * (1 + 1e-6)


@pytest.mark.parametrize("stream", STREAMS)
@settings(max_examples=60)
@given(data=st.data())
def test_any_number_is_sent_within_range_and_never_wraps(stream, data):
    """A value beyond is the end of the range, counted; one that is not finite is not measured."""
    values = data.draw(values_of(stream, st.floats(allow_nan=True, allow_infinity=True)))
    clipped = Counter()
    n_beyond = 0
    for column, (sent, found) in enumerate(zip(values, round_trip(stream, values, 0, clipped), strict=True)):
        if (stream, column) == REAL_PART:
            continue
        low, high, resolution = bounds(stream, column)
        if not math.isfinite(sent):
            assert math.isnan(found)
        elif low <= sent <= high:
            assert abs(found - sent) <= resolution * 0.5 * (1 + 1e-6)
        else:
            assert found == pytest.approx(low if sent < low else high, abs=1e-9)
            n_beyond += not (low - resolution / 2 <= sent <= high + resolution / 2)
    assert sum(clipped.values()) >= n_beyond
    assert n_beyond or sum(clipped.values()) <= len(values)


@pytest.mark.parametrize("stream", STREAMS)
@settings(max_examples=150)
@given(data=st.data())
def test_any_bytes_are_decoded_to_values_in_range_or_refused(stream, data):
    """Bytes of a damaged frame: no exception, no infinity, nothing beyond the bounds of the DBC."""
    plan = data.draw(st.sampled_from(LAYOUT.by_stream[stream]))
    payload = data.draw(st.binary(min_size=0, max_size=8))
    part = decode(LAYOUT, Frame(1.0, plan.message.frame_id, payload))
    if len(payload) != 8:
        assert part is Drop.LENGTH
    elif not isinstance(part, Drop):
        for column, value in zip(part.columns, part.values, strict=True):
            low, high, _ = bounds(stream, column)
            assert math.isnan(value) or low - 1e-9 <= value <= high + 1e-9


@pytest.mark.parametrize("stream", ["corrections", "status", "twist"])
def test_each_wrong_bit_of_a_checked_message_is_found(stream):
    (frame,) = encode(LAYOUT, stream, [0.1] * len(channels_of(stream)), 77)
    for bit in range(64):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert decode(LAYOUT, frame._replace(data=bytes(data))) is Drop.CHECKSUM
    other = frame._replace(arbitration_id=0x101 if stream != "corrections" else 0x102)
    assert decode(LAYOUT, other) is Drop.CHECKSUM, "the identifier is checked too"


@pytest.mark.parametrize(
    ("frame", "drop"),
    [
        (Frame(0.0, 0x40, b"", is_error=True), Drop.BUS_OFF),
        (Frame(0.0, 0x04, b"", is_error=True), Drop.ERROR),
        (Frame(0.0, 0x120, b"", is_remote=True), Drop.REMOTE),
        (Frame(0.0, 0x7FF, bytes(8)), Drop.UNKNOWN),
        (Frame(0.0, 0x120, bytes(8), is_extended=True), Drop.UNKNOWN),
        (Frame(0.0, 0x120, bytes(7)), Drop.LENGTH),
        (Frame(0.0, 0x110, bytes(8)), Drop.CHECKSUM),
        (Frame(math.nan, 0x120, bytes(8)), Drop.TIME),
    ],
)
def test_a_frame_that_is_not_used_says_why(frame, drop):
    assert decode(LAYOUT, frame) is drop


def test_what_was_not_measured_is_nan_and_no_zero():
    found = round_trip("wheels", [1.0, math.nan, -3.0, math.nan, 0.0, 2.0])
    assert [math.isnan(value) for value in found] == [False, True, False, True, False, False]
    parts = [decode(LAYOUT, frame) for frame in encode(LAYOUT, "wheels", [math.nan] * 6, 0)]
    assert [part.n_out_of_range for part in parts] == [0, 0], "no value out of range was sent"


def test_resolutions_are_far_below_the_noise_and_ranges_cover_the_robot():
    """Rounding adds less than 3 % to a sensor's variance; rates and speeds cover the limits of the robot."""
    sensors, camera = ROBOT.equipment.sensors, ROBOT.equipment.camera
    noise = {
        ("wheels", 0): sensors.motor_std_radps,
        ("wheels", 3): sensors.current_std_a,
        ("steering", 0): sensors.steering_std_rad,
        ("imu", 0): sensors.gyro_std_radps,
        ("imu", 3): sensors.accel_std_mps2,
        ("imu", 6): sensors.tilt_std_rad,
        ("imu", 8): sensors.yaw_std_rad,
        ("odometry", 0): camera.position_std_m,
        ("odometry", 3): camera.yaw_std_rad / 2,
        ("odometry", 7): camera.speed_std_mps,
        ("odometry", 10): camera.yaw_rate_std_radps,
    }
    for place, std in noise.items():
        assert bounds(*place)[2] ** 2 / 12 < 0.03 * std**2, place
    motors = ROBOT.equipment.motors
    assert bounds("wheels", 0)[1] > 2 * motors.reduction_ratio * motors.speed_max_radps
    assert bounds("corrections", 0)[1] > 1.5 * motors.speed_max_radps
    for stream, column in (("steering", 0), ("imu", 6), ("imu", 8)):
        assert bounds(stream, column)[1] > math.pi
    assert bounds("twist", 0)[1] > 1.5 * motors.speed_max_radps * ROBOT.wheel_radius_m


def test_the_dbc_has_every_signal():
    for stream, names in SIGNALS.items():
        assert LAYOUT.columns(stream) == set(range(len(names))) - ({6} if stream == "odometry" else set())
    assert len(OPTIONAL) > 4


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_a_rotation_comes_back_whatever_the_sign_of_its_quaternion(given_q):
    """The angle between the rotation that was sent and the one that is received is that of rounding."""
    length = math.hypot(*given_q)
    quaternion = [part / length for part in given_q]
    sent = as_sent("odometry", [0.0] * 3 + quaternion + [0.0] * 7)
    receiver = Receiver(LAYOUT, ("odometry",))
    for frame in encode(LAYOUT, "odometry", sent, 0):
        receiver.take(frame)
    found = receiver.readings(1.0)["odometry"].values[0, 3:7]
    along = abs(sum(a * b for a, b in zip(found, quaternion, strict=True)))
    assert math.hypot(*found) == pytest.approx(1.0, abs=1e-5)
    assert along > 1.0 - 3e-6  # beside half a turn the real part follows by a square root
