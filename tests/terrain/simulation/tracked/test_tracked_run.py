"""Logs of a simulated tracked robot: streams that agree with the truth, given slip, bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.tracked import (
    QUIET,
    PrescribedSlip,
    Slope,
    Stretch,
    TrackedSensors,
    simulate_tracked,
    slipped_twist,
    tracks_on,
)
from terrain.terramechanics.soil import load_soil

UGV, PATAKO = load_robot("orchard_ugv"), load_robot("patako")


def channel(run, stream, name):
    found = run.streams[stream]
    return found.values[:, found.channels.index(name)]


def test_prescribed_slip_moves_the_robot_as_the_paper_states():
    belts = np.tile([0.4, 0.6], (501, 1))
    run = simulate_tracked(UGV, PrescribedSlip(1.1, 0.8), belts, 0, sensors=QUIET)
    assert channel(run, "truth", "speed_x_mps")[1:] == pytest.approx(np.full(1000, (0.44 + 0.48) / 2))
    assert channel(run, "truth", "yaw_rate_radps")[1:] == pytest.approx(np.full(1000, 0.48 - 0.44))
    assert channel(run, "truth", "slip_right_ratio")[-1] == pytest.approx(0.2)
    assert channel(run, "truth", "slip_left_ratio")[-1] == pytest.approx(-0.1 / 1.1)
    radius = 0.46 / 0.04
    assert channel(run, "pose", "position_y_m")[-1] == pytest.approx(radius * (1 - math.cos(0.4)), rel=1e-3)


@pytest.mark.parametrize("power", [0.3, 0.847, 1.0, 1.3])
@pytest.mark.parametrize("belts", [(0.02, 0.1), (-0.03, 0.1), (-0.1, -0.02), (0.05, -0.2)])
def test_prescribed_turning_slip_is_endos_law(power, belts):
    left, right = belts
    slip = PrescribedSlip(turning_loss_ratio=0.3, turning_exponent=power)
    tracks = tracks_on(replace(PATAKO, track_m=0.4), slip)[0]
    v_x, _, w = slipped_twist(tracks, *belts, 0.0, 0.0)
    slip_left, slip_right = 1 - (v_x - 0.2 * w) / left, 1 - (v_x + 0.2 * w) / right
    assert slip_left / slip_right == pytest.approx(-np.sign(left * right) * abs(right / left) ** power)
    assert w == pytest.approx(0.7 * (right - left) / 0.4)


@pytest.mark.parametrize("power", [0.5, 1.0, 1.5])
def test_prescribed_turning_slip_is_continuous_where_a_track_stops(power):
    slip = PrescribedSlip(turning_loss_ratio=0.3, turning_exponent=power)
    tracks = tracks_on(replace(PATAKO, track_m=0.4), slip)[0]
    for stopped in ((0.0, 0.1), (0.1, 0.0), (0.0, 0.0)):
        at = np.array(slipped_twist(tracks, *stopped, 0.0, 0.0))
        for nudge in (-1e-12, 1e-12):
            beside = slipped_twist(tracks, *(v or nudge for v in stopped), 0.0, 0.0)
            assert beside == pytest.approx(at, abs=2e-6)


def test_sensors_agree_with_the_truth_within_their_noise():
    belts = np.tile([0.03, 0.08], (801, 1))
    slope, sensors = Slope(math.radians(15.0), 0.4), TrackedSensors()
    run = simulate_tracked(
        PATAKO, load_soil("toyoura_sand"), belts, 3, slope=slope, yaw_rad=2.5, sensors=sensors
    )
    truth, gyro = run.streams["truth"], channel(run, "imu", "gyro_z_radps")
    bias = channel(run, "truth", "gyro_bias_z_radps")[0]
    error = gyro - bias - channel(run, "truth", "yaw_rate_radps")
    assert error.std() == pytest.approx(sensors.gyro_radps, rel=0.1)
    yaw = channel(run, "truth", "yaw_rad")
    assert np.std(wrapped(channel(run, "compass", "yaw_rad") - yaw[::10])) == pytest.approx(0.0087, rel=0.25)
    assert (channel(run, "gnss", "position_x_m") - truth.values[::10, 0]).std() == pytest.approx(
        0.02, rel=0.25
    )
    force = run.streams["imu"].values[:, 3:6]
    assert np.linalg.norm(force, axis=1).mean() == pytest.approx(9.81, abs=0.02)
    roll, pitch = channel(run, "truth", "roll_rad"), channel(run, "truth", "pitch_rad")
    assert np.cos(roll) * np.cos(pitch) == pytest.approx(np.full(len(roll), math.cos(math.radians(15.0))))
    turned = np.unwrap(yaw)[-1] - 2.5
    assert turned == pytest.approx(channel(run, "truth", "yaw_rate_radps").sum() * 0.01, rel=0.01)


def test_soil_changes_where_a_stretch_ends_and_labels_say_so():
    belts = np.full((1001, 2), 0.3)
    ground = [Stretch(load_soil("tilled_loam"), 2.0), Stretch(load_soil("dry_sand"))]
    run = simulate_tracked(UGV, ground, belts, 0, slope=Slope(0.2), sensors=QUIET)
    assert [label.terrain for label in run.labels] == ["tilled_loam", "dry_sand"]
    slip = channel(run, "truth", "slip_left_ratio")
    at = round(run.labels[0].end_s * 100)
    assert abs(channel(run, "truth", "position_x_m")[at] - 2.0) < 0.01
    assert abs(slip[at + 100 :].mean() - slip[100 : at - 50].mean()) > 0.002


def test_same_seed_same_bytes_and_another_seed_other_noise():
    belts = np.full((101, 2), 0.1)
    one, same, other = (simulate_tracked(PATAKO, PrescribedSlip(), belts, seed) for seed in (4, 4, 5))
    for name, stream in one.streams.items():
        assert stream.values.tobytes() == same.streams[name].values.tobytes()
    assert one.streams["imu"].values.tobytes() != other.streams["imu"].values.tobytes()


@pytest.mark.parametrize(
    ("ground", "speeds", "message"),
    [
        (load_soil("asphalt"), np.zeros((5, 2)), "soil 'asphalt' has the law 'magic'"),
        (PrescribedSlip(), np.zeros((5, 3)), "track_speed_mps has shape"),
        (PrescribedSlip(), np.full((5, 2), np.nan), "finite numbers"),
        ([], np.zeros((5, 2)), "no stretch is given"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_sentence(ground, speeds, message):
    with pytest.raises(ConfigError, match=message):
        simulate_tracked(PATAKO, ground, speeds, 0)
