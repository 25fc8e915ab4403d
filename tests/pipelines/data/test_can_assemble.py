"""Frames of one instant make one sample; what is lost, late or repeated is NaN or dropped, and counted."""

import numpy as np
import pytest

from pipelines.data.can_codec import encode, load_layout
from pipelines.data.can_logs import INCOMPLETE_S, QUEUE, Receiver

LAYOUT = load_layout()


def frames(counter, time_s=1.0, stream="imu"):
    width = {"imu": 9, "wheels": 6}[stream]
    return encode(LAYOUT, stream, [counter + 0.1 * k for k in range(width)], counter, time_s)


def received(sent, streams=("imu", "wheels"), now_s=10.0):
    receiver = Receiver(LAYOUT, streams)
    for frame in sent:
        receiver.take(frame)
    return receiver, receiver.readings(now_s)


def test_a_sample_has_the_stamp_of_its_first_frame():
    rates, accels, attitude = frames(0, 1.0)
    _, found = received([rates, accels._replace(time_s=1.001), attitude._replace(time_s=1.002)])
    assert found["imu"].time_s.tolist() == [1.0]
    np.testing.assert_allclose(found["imu"].values, [np.arange(9) * 0.1], atol=3e-4)


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_lost_frame_is_nan_in_its_part_only(lost):
    sent = [f for k in range(3) for j, f in enumerate(frames(k, 1.0 + 0.01 * k)) if (k, j) != (1, lost)]
    receiver, found = received(sent)
    gone = np.isnan(found["imu"].values)
    assert gone.sum() == 3
    assert gone[1, 3 * lost : 3 * lost + 3].all()
    assert receiver.dropped == {"imu: part missing": 1}
    assert (np.diff(found["imu"].time_s) > 0).all()


def test_an_incomplete_sample_waits_and_is_used_in_the_end():
    receiver = Receiver(LAYOUT, ("imu",))
    receiver.take(frames(0, 1.0)[0])
    assert receiver.readings(1.0 + 0.5 * INCOMPLETE_S) == {}
    assert len(receiver.readings(1.001 + INCOMPLETE_S)["imu"].time_s) == 1
    for late in frames(0, 1.03)[1:]:
        receiver.take(late)
    assert receiver.readings(2.0) == {}, "its other frames are too late"
    assert receiver.dropped == {"imu: part missing": 1, "imu: repeated or late": 2}


def test_a_counter_that_stands_still_gives_no_new_sample():
    receiver, found = received([f for k in range(5) for f in frames(3, 1.0 + 0.01 * k)])
    assert len(found["imu"].time_s) == 1
    assert receiver.dropped["imu: repeated or late"] == 12


def test_streams_are_taken_in_any_order_of_their_frames():
    mixed = [f for pair in zip(frames(0), reversed(frames(0)), strict=True) for f in pair]
    wheels = frames(4, 1.0, "wheels")
    _, found = received([mixed[0], wheels[1], mixed[2], wheels[0], mixed[4]])
    assert set(found) == {"imu", "wheels"}
    assert np.isfinite(found["imu"].values).all()


def test_frames_of_this_side_that_come_back_are_counted():
    receiver, found = received(encode(LAYOUT, "corrections", [1.0, 1.0, 1.0], 0))
    assert found == {}
    assert receiver.dropped == {"corrections: not read here": 1}


def test_memory_is_bounded_when_nothing_is_read():
    receiver, found = received([f for k in range(QUEUE + 50) for f in frames(k, 1.0 + 0.01 * k, "wheels")])
    assert len(found["wheels"].time_s) == QUEUE
    assert found["wheels"].time_s[-1] == pytest.approx(1.0 + 0.01 * (QUEUE + 49))
    assert receiver.dropped == {"wheels: queue full": 50}
