"""Slip comes back from simulated logs, with an honest uncertainty, and says when it does not know."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.estimate import enriched, estimate_run, summarize
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults
from terrain.simulation.sensors import Gnss, Poses

ROBOT = load_robot("agrimaro")
LOST = Faults(camera_lost_s=((10.0, 13.0),), by_chance=False)


def drive(scenario="straight", seed=0, **options):
    return simulate_run(ROBOT, "grass", scenario, seed, **options)


@pytest.fixture(scope="module")
def straight():
    return drive()


@pytest.mark.parametrize(("scenario", "seed"), [("straight", 0), ("arc", 1)])
def test_slip_of_12_5_percent_is_found_by_15_states_and_read_low_by_the_thesis_own(scenario, seed):
    run = drive(scenario, seed=seed)
    row = summarize(estimate_run(run, ROBOT, "vio15"))
    true = row.slip_true_mean
    assert true == pytest.approx(0.125, abs=0.01)
    assert row.slip_mean == pytest.approx(true, abs=0.002)

    thesis = summarize(estimate_run(run, ROBOT, "vio12"))
    # 0.110 to 0.120 where 0.125 is true: wheel rows without slip pull the speed to that of the wheels
    assert 0.110 / 0.125 <= thesis.slip_mean / true <= 0.120 / 0.125


def test_encoders_alone_cannot_observe_slip_and_the_track_reports_it(straight):
    found = estimate_run(straight, ROBOT, "encoder12")
    row = summarize(found)
    assert row.slip_true_mean == pytest.approx(0.125, abs=0.004)
    assert row.slip_observable is False
    assert np.isnan(found.slip.mean).all()
    assert row.slip_mean == pytest.approx(0.0, abs=0.005)
    assert np.isnan(row.slip_std)


@pytest.mark.parametrize(
    ("robot", "name"),
    [("agrimaro", "vio15"), ("agrimaro", "slip"), ("orchard_ugv", "tracked"), ("adap2e", "sideslip-multi")],
)
def test_any_filter_gives_the_same_record_and_figures_of_the_same_definition(robot, name):
    """By the truth slip, position and steady motion are what they are, whichever filter found them."""
    robot = load_robot(robot)
    soil = "tilled_loam" if robot.drive == "tracked" else "grass"
    run = simulate_run(robot, soil, "straight", 4, poses=Poses(), duration_s=20.0)
    found = estimate_run(run, robot, name)
    row, n = summarize(found), len(found.track.time_s)
    assert row.finite
    assert found.status.shape == found.slip.stale.shape == (n,)
    assert sum(row.status_s.values()) == pytest.approx(np.ptp(found.track.time_s))
    assert list(row.slip) == list(found.slip.channels) == list(enriched(found).streams["slip"].channels)
    for name, each in row.slip.items():
        assert abs(each.mean - each.true_mean) < 0.03, name
        assert each.nees < 2.0 or name.endswith("_rad"), name
    if found.slip.ratios.channels:
        assert row.slip_mean == pytest.approx(row.slip_true_mean, abs=0.03)
        assert row.steady_s > 5.0
    assert row.position_rmse_m < 0.5
    assert np.isnan(row.nees) == (found.innovations == {})
    assert row.n_dropped + row.n_gated == sum(row.dropped.values())
    written = enriched(found).streams["state"].channels
    assert {"stale_ratio", "observer_code", *(f"std_{name}" for name in found.slip.channels)} <= set(written)


def test_a_truth_of_slip_alone_judges_the_slip_and_nothing_else():
    run = simulate_run(ROBOT, "grass", "straight", 4, poses=Poses(), duration_s=12.0)
    truth = run.streams["truth"]
    alone = Stream(truth.time_s, truth.columns(["slip_1_ratio"]), ("slip_1_ratio",))
    row = summarize(estimate_run(replace(run, streams={**run.streams, "truth": alone}), ROBOT, "slip"))
    assert row.slip["slip_1_ratio"].true_mean == pytest.approx(0.15, abs=0.03)
    assert np.isnan(
        [row.slip["slip_2_ratio"].true_mean, row.slip_true_mean, row.position_rmse_m, row.speed_rmse_mps]
    ).all()


def turned(run, angle_rad):
    """The run as a receiver tells it whose east is turned."""
    gnss = run.streams["gnss"]
    values = gnss.values.copy()
    turn = np.array([[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]])
    for columns in ([0, 1], [2, 3]):
        values[:, columns] = values[:, columns] @ turn
    return replace(run, streams={**run.streams, "gnss": Stream(gnss.time_s, values, gnss.channels)})


@pytest.mark.parametrize("angle_rad", [0.0, -2.9])
def test_the_heading_of_the_start_is_found_from_the_drive(angle_rad):
    run = turned(drive("arc", gnss=Gnss()), angle_rad)
    for name in ("encoder12", "vio15"):
        found = estimate_run(run, ROBOT, name)
        start, row = found.table.columns(["imu_yaw_rad"])[10, 0], summarize(found)
        assert abs(np.angle(np.exp(1j * (start - angle_rad)))) < 0.03
        assert row.slip_observable
    assert row.slip_mean == pytest.approx(row.slip_true_mean, abs=0.002)


def test_a_receiver_that_never_moved_is_left_out_and_counted():
    found = estimate_run(drive("stand", gnss=Gnss(), duration_s=5.0), ROBOT, "vio15")
    assert found.dropped == {"gnss: heading not observable in this run": 50}
    assert "gnss_position" not in found.track.sensors


@pytest.mark.parametrize("seed", [0, 1])
def test_a_camera_outage_of_3_s_makes_slip_stale_and_less_certain_but_close(seed):
    run = drive(seed=seed, faults=LOST)
    found = estimate_run(run, ROBOT, "vio15")
    time_s = found.slip.time_s
    lost = (time_s > 10.2) & (time_s < 13.0)
    assert found.slip.stale[lost].all()
    assert not found.slip.stale[(time_s > 2.0) & (time_s < 10.0)].any()
    truth = run.streams["truth"]
    true = np.mean(
        [np.interp(time_s, truth.time_s, truth.channel(f"slip_{i}_ratio")) for i in (1, 2, 3)], axis=0
    )
    assert found.slip.mean[lost].mean() == pytest.approx(true[lost].mean(), abs=0.015)
    std = found.slip.std.mean(axis=1)
    assert std[lost][-1] > 2 * std[(time_s > 9.0) & (time_s < 10.0)].max()
    assert (np.diff(std[lost][::25]) > 0).all()
    assert summarize(found).stale_s == pytest.approx(3.1, abs=0.1)

    thesis = estimate_run(run, ROBOT, "vio12")
    assert np.isnan(thesis.slip.mean[lost]).all()  # it would fall silently to 0
    assert abs(thesis.blind.mean[lost][-20:].mean()) < 0.02


@pytest.mark.parametrize(("stream", "channel"), [("wheels", "motor_1_radps"), ("steering", "angle_1_rad")])
def test_a_wheel_without_samples_has_no_slip(straight, stream, channel):
    sound, values = straight.streams[stream], straight.streams[stream].values.copy()
    values[sound.time_s > 10.0, sound.channels.index(channel)] = np.nan
    silent = Stream(sound.time_s, values, sound.channels)
    slip = estimate_run(replace(straight, streams={**straight.streams, stream: silent}), ROBOT, "vio15").slip
    late = slip.time_s > 10.7
    assert np.isnan(slip.mean[late, 0]).all()
    assert np.isfinite(slip.mean[late, 1:]).all()
    assert np.isfinite(slip.mean[(slip.time_s > 5.0) & (slip.time_s < 10.4)]).all()


def test_unknown_filters_and_tunings_are_refused_in_one_sentence(straight):
    with pytest.raises(
        ConfigError, match="'vio15' is not for robot agrimaro, whose drive is swerve: use vio12"
    ):
        estimate_run(straight, replace(ROBOT, filters=("vio12",)), "vio15")
    with pytest.raises(ConfigError, match="no tuning 'best'"):
        estimate_run(straight, ROBOT, "vio15", tuning="best")
