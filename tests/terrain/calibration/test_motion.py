"""Kinematics by whatever measured the motion: hidden numbers come back, and measured halves of drives agree."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from studies.intervals import RTK_TRUTH, rtk_run, skid_run

from pipelines.data.datasets import load_runs
from terrain.calibration.motion import (
    MISSING,
    fit_motion,
    motion_findings,
    parameters_of,
)
from terrain.calibration.motors import motor_constant
from terrain.calibration.sensors import mounting, standing
from terrain.errors import DataError
from terrain.logs.schema import GNSS_CHANNELS
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot

DT = 0.02


def poses_by(twist, lever, turned_rad, noise, seed):
    """Return poses (n, 3) of a sensor on a body that drives twists (n, 3), by complex numbers and not by the plant."""
    yaw = cumulative_trapezoid(twist[:, 2], dx=DT, initial=0.0)
    velocity = (twist[:, 0] + 1j * twist[:, 1]) * np.exp(1j * yaw)
    place = cumulative_trapezoid(velocity, dx=DT, initial=0.0) + np.exp(1j * yaw) * complex(*lever)
    rng = np.random.default_rng(seed)
    seen = np.column_stack([place.real, place.imag, yaw + turned_rad])
    return seen + rng.normal(size=seen.shape) * noise


def waves(rng, n, size):
    t = DT * np.arange(n)
    return (
        sum(size * np.sin(w * t + p) for w, p in zip((0.3, 0.7, 1.3), rng.uniform(0, 6, 3), strict=True))
        / 1.5
    )


def by_receiver(run, twist, lever, seed, delay_s=0.12, bias_radps=0.004, period_s=0.1):
    """Return a run with a receiver and a gyro in place of poses; a receiver has no heading."""
    rng, time_s = np.random.default_rng(seed), DT * np.arange(len(twist))
    path = poses_by(twist, lever, 0.0, 0.0, seed)
    at_s = np.arange(0.013, time_s[-1], period_s)
    fixes = [
        np.interp(at_s - delay_s, time_s, each) + rng.normal(0.0, 0.015, len(at_s)) for each in path[:, :2].T
    ]
    gyro = twist[:, 2] + bias_radps + rng.normal(0.0, 0.003, len(twist))
    streams = {name: stream for name, stream in run.streams.items() if name != "pose"}
    streams["gnss"] = Stream(at_s, np.column_stack(fixes), GNSS_CHANNELS[:2])
    return replace(run, streams=streams | {"imu": Stream(time_s, gyro[:, None], ("gyro_z_radps",))})


def mecanum_run(seed, n=3000, radius=1.05, distance=0.35, delay_s=0.04, receiver=False):
    robot, rng = load_robot("omnirobot"), np.random.default_rng(seed)
    twist = np.column_stack([waves(rng, n, s) for s in (0.2, 0.2, 0.6)])
    rows = np.array([[1, -1, -distance], [1, 1, distance], [1, 1, -distance], [1, -1, distance]])
    wheels = twist @ rows.T / radius
    time_s = DT * np.arange(n)
    pose = poses_by(twist, (0.05, -0.02), 0.03, (0.002, 0.002, 0.01), seed)
    run = RunLog(
        f"cart_{seed}",
        robot.name,
        {
            "wheels": Stream(time_s, wheels, robot.rate_channels),
            "pose": Stream(time_s + delay_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
        },
    )
    return by_receiver(run, twist, (0.05, -0.02), seed) if receiver else run


def tricycle_run(seed, n=3000, gain=0.6, offset=-0.04, wheelbase=1.5, radius=1.02, receiver=False):
    robot, rng = load_robot("pallet_truck"), np.random.default_rng(seed)
    speed, angle = 0.5 + waves(rng, n, 0.3), waves(rng, n, 0.6)
    steer = gain * angle + offset
    front = radius * speed
    twist = np.column_stack([front * np.cos(steer), 0 * steer, front * np.sin(steer) / wheelbase])
    time_s = DT * np.arange(n)
    pose = poses_by(twist, (1.8, 0.03), 0.02, (0.003, 0.003, 0.001), seed)
    run = RunLog(
        f"truck_{seed}",
        robot.name,
        {
            "wheels": Stream(time_s, speed[:, None], robot.rate_channels),
            "steering": Stream(time_s, angle[:, None], robot.steer_channels),
            "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
        },
    )
    return by_receiver(run, twist, (1.8, 0.03), seed) if receiver else run


def within(findings, truth, widest):
    """Assert that each number lies in its interval, or by a tenth of it or 2 mm outside, and how wide that is.

    The described tyres of the tricycle yield by 2.5 mm at its speed, those of these poses do not.
    """
    found = {each.parameter.removeprefix("identified."): each for each in findings}
    for name, value in truth.items():
        low, high = found[name].low, found[name].high
        slack = max(0.1 * (high - low), 0.002 * (name == "pose_x_m"))
        assert low - slack <= value <= high + slack, (name, value, low, high)
        assert high - low < widest[name], name


def test_numbers_of_a_mecanum_robot_come_back():
    findings = motion_findings([mecanum_run(0)], load_robot("omnirobot"))
    truth = {"rolling_radius_m": 0.07 * 1.05, "wheel_distance_m": 0.35, "pose_x_m": 0.05, "pose_y_m": -0.02}
    truth |= {"pose_yaw_rad": 0.03, "pose_delay_s": 0.04}
    widest = dict.fromkeys(truth, 0.02) | {"rolling_radius_m": 0.001, "wheel_distance_m": 0.01}
    within(findings, truth, widest)


def test_numbers_of_a_tricycle_come_back():
    findings = motion_findings([tricycle_run(0)], load_robot("pallet_truck"))
    truth = {"rolling_radius_m": 0.102, "wheelbase_m": 1.5, "steering_gain_ratio": 0.6, "pose_x_m": 1.8}
    truth |= {"steering_offset_rad": -0.04, "pose_y_m": 0.03, "pose_yaw_rad": 0.02}
    within(findings, truth, dict.fromkeys(truth, 0.08))


def test_what_a_drive_does_not_show_has_no_value():
    """Straight ahead nothing shows the distance of the wheels, nor where the sensor is."""
    run, robot = mecanum_run(3), load_robot("omnirobot")
    wheels = run.streams["wheels"].values.copy()
    wheels[:] = wheels.mean(axis=1, keepdims=True)
    twist = np.column_stack([1.05 * wheels[:, 0], 0 * wheels[:, :2]])
    pose = poses_by(twist, (0.05, 0.0), 0.0, (0.002, 0.002, 0.01), 3)
    streams = run.streams | {
        "wheels": Stream(run.streams["wheels"].time_s, wheels, robot.rate_channels),
        "pose": Stream(run.streams["wheels"].time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
    }
    found = {f.parameter: f for f in motion_findings([RunLog("a", robot.name, streams)], robot)}
    assert found["identified.rolling_radius_m"].determined
    for name in ("wheel_distance_m", "pose_x_m", "pose_y_m"):
        assert not found[f"identified.{name}"].determined


@pytest.mark.parametrize("slip_ratio", [0.0, 0.03])
def test_slip_of_a_fast_car_that_speeds_up_is_no_delay(slip_ratio):
    """At 20 m/s a slip of 3 % at the traction of its weight looks like poses that are 60 ms early."""
    robot, rng, n = load_robot("av21"), np.random.default_rng(3), 6000
    speed = 20.0 + waves(rng, n, 5.0)
    driven = speed / (1.0 - slip_ratio * np.gradient(speed, DT) / 9.81)
    pose = poses_by(np.column_stack([speed, 0 * speed, 0 * speed]), (0, 0), 0.0, (0.01, 0.01, 1e-3), 3)
    time_s, wheels = DT * np.arange(n), np.column_stack([driven] * len(robot.rate_channels))
    streams = {
        "wheels": Stream(time_s, wheels, robot.rate_channels),
        "steering": Stream(time_s, np.zeros((n, len(robot.steer_channels))), tuple(robot.steer_channels)),
        "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
    }
    ahead = ("wheel_radius_ratio", "camera_latency_s", "force_slip_ratio")
    names = [name for name in parameters_of(robot, "pose", False) if name in ahead]
    fitted = fit_motion([RunLog("car", robot.name, streams)], robot, "pose", names)
    place = fitted.names.index("camera_latency_s")
    assert abs(fitted.fit.value[place]) < max(2.5 * fitted.fit.std[place], 0.002)
    assert fitted.fit.std[place] < 0.01


@pytest.mark.parametrize("missing", ["wheels", "steering", "pose"])
def test_a_run_without_a_stream_is_one_sentence(missing):
    run, robot = tricycle_run(0, 400), load_robot("pallet_truck")
    streams = {name: stream for name, stream in run.streams.items() if name != missing}
    bare = RunLog("a", robot.name, streams)
    with pytest.raises(DataError, match=r"^run a: it has no"):
        fit_motion([bare], robot)
    found = motion_findings([bare], robot)
    assert len(found) >= 4
    assert all(not row.determined and row.note for row in found)
    assert missing != "pose" or found[0].note == MISSING


def test_a_short_drive_is_refused_with_how_long_it_has_to_be():
    with pytest.raises(DataError, match=r"legs of 1 s in which it moves .* at least 48 are required"):
        fit_motion([tricycle_run(0, 400)], load_robot("pallet_truck"))


def halves(run):
    """Return the first and the second half of a run."""
    middle_s = np.mean([run.streams["wheels"].time_s[[0, -1]]])
    for name, keep in (("first", np.less), ("second", np.greater_equal)):
        streams = {}
        for key, stream in run.streams.items():
            kept = keep(stream.time_s, middle_s)
            streams[key] = Stream(stream.time_s[kept], stream.values[kept], stream.channels)
        yield RunLog(f"{run.run_id}_{name}", run.robot, streams)


def agree(runs, robot, least):
    """Assert that numbers of first and second halves differ by less than their intervals; return how many have one."""
    first, second = (
        {f.parameter: f for f in motion_findings(list(half), robot)}
        for half in zip(*map(halves, runs), strict=True)
    )
    compared = 0
    for name, one in first.items():
        other = second[name]
        if one.determined and other.determined:
            compared += 1
            half = np.hypot(one.high - one.low, other.high - other.low) / 2
            assert abs(one.value - other.value) <= 1.2 * half, (name, one, other)  # of a dozen, one in 20
    assert compared >= least


@pytest.mark.parametrize(
    ("folder", "robot", "reading", "least"),
    [
        ("mecanum", "omnirobot", {"layout": "bag", "mapping": "omnirobot_topics"}, 5),
        ("tricycle", "pallet_truck", {}, 4),
        ("race_car", "av21", {"mapping": "race_car"}, 3),
    ],
)
@pytest.mark.slow
def test_measured_halves_agree(measured, folder, robot, reading, least):
    agree(load_runs(measured(folder), **reading), load_robot(robot), least)


def test_a_fit_names_its_values():
    fitted = fit_motion([mecanum_run(5)], load_robot("omnirobot"))
    assert abs(fitted.values["wheel_radius_ratio"] - 0.05) < 0.01


# -- robots that skid, by lidar ------------------------------------------------------------------------------------

HIDDEN = [(0.287, 1.8, 0.3, 0.05), (0.31, 1.5, 0.45, 0.12)]
WARTHOG, HUSKY = load_robot("warthog"), load_robot("husky").without("body", "motors", "camera", "sensors")


def by_name(findings):
    return {finding.parameter.partition(".")[2]: finding for finding in findings}


@pytest.mark.parametrize("hidden", HIDDEN)
def test_hidden_values_come_back_within_their_intervals(hidden):
    runs = [skid_run(*hidden, i) for i in range(12)]
    found = by_name(motion_findings(runs, WARTHOG, ("asphalt",)))
    widest = {
        "rolling_radius_m": 0.012,
        "effective_track_m": 0.1,
        "lidar_delay_s": 0.02,
        "wheels_delay_s": 0.02,
    }
    for (name, half), value in zip(widest.items(), hidden, strict=True):
        finding = found[name]
        assert finding.determined
        # 95 % of intervals hold the value; here each is widened to hold all
        assert abs(finding.value - value) < 1.5 * (finding.high - finding.low) / 2, (name, finding)
        assert finding.high - finding.low < 2 * half, name


def test_each_ground_has_its_track_and_hard_ground_the_radius():
    runs = [skid_run(0.29, 1.8, 0.3, 0.05, i) for i in range(6)]
    soft = [skid_run(0.29, 2.6, 0.3, 0.05, 50 + i, terrain="sand") for i in range(6)]
    both, alone = (by_name(motion_findings(some, WARTHOG, ("asphalt",))) for some in (runs + soft, runs))
    for name in ("rolling_radius_m", "effective_track_m"):
        assert both[name].value == alone[name].value
    assert both["effective_track_sand_m"].low < 2.6 < both["effective_track_sand_m"].high
    nowhere = by_name(motion_findings(soft, WARTHOG, ("asphalt",)))
    assert nowhere["effective_track_m"].value == pytest.approx(both["effective_track_sand_m"].value)
    assert "slip of 0 to 5 %" in nowhere["rolling_radius_m"].note


def test_sessions_that_differ_widen_the_interval():
    runs = [
        skid_run(0.29, track, 0.3, 0.05, 10 * k + i, session=f"s{k}")
        for k, track in enumerate((1.7, 1.75, 1.85, 1.9, 1.8))
        for i in range(5)
    ]
    by_session, by_run = (
        by_name(motion_findings(some, WARTHOG, ("asphalt",)))["effective_track_m"]
        for some in (runs, [replace(run, session="") for run in runs])
    )
    assert by_session.high - by_session.low > 1.3 * (by_run.high - by_run.low)
    assert by_session.low < 1.8 < by_session.high


def test_without_turns_or_gyro_it_is_unknown_and_not_zero():
    straight = []
    for i in range(6):
        run = skid_run(0.29, 1.8, 0.3, 0.05, i)
        still = dict(run.streams)
        for name, factors in (("imu", [0.0]), ("lidar", [1.0, 0.0, 0.0])):
            s = run.streams[name]
            still[name] = Stream(s.time_s, s.values * factors, s.channels)
        s = run.streams["wheels"]
        still["wheels"] = Stream(s.time_s, s.values[:, [0, 0]], s.channels)
        straight.append(replace(run, streams=still))
    found = by_name(motion_findings(straight, WARTHOG, ("asphalt",)))
    assert found["rolling_radius_m"].determined
    assert not found["effective_track_m"].determined
    assert found["effective_track_m"].note
    blind = [skid_run(0.29, 1.8, 0.3, 0.05, i) for i in range(6)]
    blind = [replace(run, streams={n: s for n, s in run.streams.items() if n != "imu"}) for run in blind]
    found = by_name(motion_findings(blind, WARTHOG, ("asphalt",)))
    assert "no run has a gyro" in found["wheels_delay_s"].note
    assert found["lidar_delay_s"].low < 0.25 < found["lidar_delay_s"].high  # behind the wheels: 0.3 - 0.05


@pytest.mark.parametrize("name", [pytest.param("warthog", marks=pytest.mark.slow), "marmotte"])
def test_what_the_package_states_is_what_measured_logs_show(measured_runs, name):
    folder = {"warthog": "drive_warthog_terrains", "marmotte": "drive_marmotte"}[name]
    robot = load_robot(name)
    runs = [run for run in measured_runs(folder, robot=name) if not {"sand", "gravel"} & set(run.terrains)]
    found = by_name(motion_findings(runs, robot, ("asphalt",)))
    for number, stated in robot.identified.items():
        half = (found[number].high - found[number].low) / 2
        assert abs(found[number].value - stated) < 2.5 * half, (number, found[number])
    assert found["rolling_radius_m"].low < 1.02 * robot.wheel_radius_m
    assert found["rolling_radius_m"].high > 0.98 * robot.wheel_radius_m


# -- by a receiver -------------------------------------------------------------------------------------------------


def rtk_runs(n=6, seed=0, **options):
    return [rtk_run(1000 * seed + k, **options)[0] for k in range(n)]


@pytest.fixture(scope="module")
def by_receiver_alone():
    """What six runs show of a skid-steer robot."""
    return by_name(motion_findings(rtk_runs(), HUSKY, ("asphalt",)))


def test_numbers_of_a_skid_steer_robot_come_back_by_a_receiver(by_receiver_alone):
    found = by_receiver_alone
    widest = {
        "rolling_radius_m": 0.004,
        "effective_track_m": 0.02,
        "wheels_delay_s": 0.005,
        "gnss_delay_s": 0.02,
    }
    widest |= {"lever_x_m": 0.02, "lever_y_m": 0.02}
    for name, truth in RTK_TRUTH.items():
        finding = found[name]
        std = (finding.high - finding.low) / 2 / 2.36  # of seven degrees of freedom
        assert abs(finding.value - truth) < 3.0 * std, (name, finding)
        assert finding.high - finding.low < widest[name], name
    assert "turns about" in found["lever_x_m"].note


def car_run(seed, n=2500, gain=1.06, offset=0.02, radius=1.03):
    """A car-like robot whose rear axle is measured; its tyres do not yield."""
    robot, rng = load_robot("adap2e"), np.random.default_rng(seed)
    speed, angle, time_s = 1.5 + waves(rng, n, 1.0), waves(rng, n, 0.25), DT * np.arange(n)
    steer = gain * angle + offset
    twist = np.column_stack([radius * speed, 0 * speed, radius * speed * np.tan(steer) / robot.wheelbase_m])
    wheels = Stream(time_s - 0.05, np.column_stack([speed] * len(robot.rate_channels)), robot.rate_channels)
    streams = {"wheels": wheels, "steering": Stream(time_s - 0.05, angle[:, None], robot.steer_channels)}
    return by_receiver(RunLog(f"car_{seed}", robot.name, streams), twist, (0.6, 0.2), seed)


def omni_run(seed, n=3000, radius=0.95, distance=0.13):
    """Three omni wheels 120 degrees apart from 60 degrees on, each driving counter-clockwise."""
    robot, rng = load_robot("robotino"), np.random.default_rng(seed)
    twist, time_s = np.column_stack([waves(rng, n, s) for s in (0.2, 0.2, 0.6)]), DT * np.arange(n)
    at = np.radians([60.0, 180.0, 300.0])
    rows = np.column_stack([-np.sin(at), np.cos(at), np.full(3, distance)])
    rates = twist @ rows.T / (radius * robot.wheel_radius_m) * robot.motors.reduction_ratio
    run = RunLog(f"omni_{seed}", robot.name, {"wheels": Stream(time_s, rates, robot.rate_channels)})
    return by_receiver(run, twist, (0.05, -0.02), seed)


def tracked_run(seed, n=2500, radius=0.97, track_m=0.9, period_s=0.1):
    robot, rng = load_robot("patako"), np.random.default_rng(seed)
    twist, time_s = np.column_stack([waves(rng, n, 0.4), np.zeros(n), waves(rng, n, 0.5)]), DT * np.arange(n)
    sides = np.column_stack([twist[:, 0] / radius + sign * twist[:, 2] * track_m / 2 for sign in (-1, 1)])
    run = RunLog(f"tracks_{seed}", robot.name, {"wheels": Stream(time_s, sides, robot.rate_channels)})
    return by_receiver(run, twist, (0.05, -0.02), seed, period_s=period_s)


DRIVES = {
    "mecanum": (partial(mecanum_run, receiver=True), "omnirobot"),
    "tricycle": (partial(tricycle_run, receiver=True), "pallet_truck"),
    "bicycle": (car_run, "adap2e"),
    "omni": (omni_run, "robotino"),
    "tracked": (tracked_run, "patako"),
}
OF_DRIVE = {
    "mecanum": {"rolling_radius_m": 0.0735, "wheel_distance_m": 0.35, "lever_x_m": 0.05, "lever_y_m": -0.02},
    "tricycle": {"rolling_radius_m": 0.102, "wheelbase_m": 1.5, "steering_gain_ratio": 0.6, "lever_x_m": 1.8}
    | {"steering_offset_rad": -0.04, "lever_y_m": 0.03},
    "bicycle": {"steering_offset_rad": 0.02, "lever_y_m": 0.2, "wheels_delay_s": -0.05},
    "omni": {"rolling_radius_m": 0.038, "wheel_distance_m": 0.13, "lever_x_m": 0.05, "lever_y_m": -0.02},
    "tracked": {"effective_track_m": 0.9, "lever_x_m": 0.05, "lever_y_m": -0.02},
}


def on_asphalt(run):
    return replace(run, labels=(Label(0.0, run.end_s, "asphalt"),))


@pytest.mark.parametrize("drive", DRIVES)
def test_a_receiver_shows_the_numbers_of_every_drive(drive):
    make, name = DRIVES[drive]
    robot = load_robot(name)
    found = by_name(motion_findings([on_asphalt(make(seed)) for seed in range(4)], robot, ("asphalt",)))
    for number, truth in (OF_DRIVE[drive] | {"gnss_delay_s": 0.12}).items():
        half = (found[number].high - found[number].low) / 2
        assert abs(found[number].value - truth) < 1.5 * half + 0.002 * (number == "lever_x_m"), (
            number,
            found[number],
        )
    if drive == "bicycle":
        assert found["effective_wheelbase_m"].value == pytest.approx(robot.wheelbase_m / 1.06, rel=0.03)


def test_a_slow_receiver_shows_the_same():
    fast, slow = (
        by_name(
            motion_findings(
                [on_asphalt(tracked_run(seed, period_s=period_s)) for seed in range(6)],
                load_robot("patako"),
                ("asphalt",),
            )
        )
        for period_s in (0.1, 1.0)
    )
    for name in ("effective_track_m", "gnss_delay_s"):
        assert abs(slow[name].value - fast[name].value) < (slow[name].high - slow[name].low)


def test_delays_by_a_receiver_and_a_radius_below_the_described_are_unknown_where_the_ground_may_be_soft():
    runs = rtk_runs(4)
    hard, soft = (
        by_name(motion_findings(some, HUSKY, ("asphalt",)))
        for some in (runs, [replace(r, labels=()) for r in runs])
    )
    for name in ("wheels_delay_s", "gnss_delay_s"):
        assert hard[name].high - hard[name].low < 0.05, name
        assert not soft[name].determined
        assert "on soft ground" in soft[name].note
    # wheels that roll further than the robot moves, by a quarter
    for run in (runs, [replace(each, labels=()) for each in runs]):
        wheels = [each.streams["wheels"] for each in run]
        faster = [replace(each, values=1.3 * each.values) for each in wheels]
        some = [replace(r, streams={**r.streams, "wheels": w}) for r, w in zip(run, faster, strict=True)]
        radius = by_name(motion_findings(some, HUSKY, ("asphalt",)))["rolling_radius_m"]
        assert radius.determined == (run is runs)
    assert "not apart from the slip" in radius.note


def test_a_gyro_without_rest_has_its_bias_by_the_receiver():
    made = [rtk_run(70 + k, rest_s=0.0, bias_radps=0.01 + 0.002 * np.sin(k)) for k in range(5)]
    fitted = fit_motion([run for run, _ in made], HUSKY, "gnss")
    assert np.abs(fitted.bias_radps - [bias for _, bias in made]).max() < 0.001
    found = by_name(motion_findings([run for run, _ in made], HUSKY))["gyro_bias_z_radps"]
    assert found.low < 0.01 + 0.002 * np.sin(np.arange(5)).mean() < found.high


def test_tight_turns_have_a_track_of_their_own():
    track_m = RTK_TRUTH["effective_track_m"]
    found = by_name(motion_findings(rtk_runs(6, seed=3, narrowing=0.3), HUSKY, ("asphalt",)))
    for name, factor in (("wide", 1.0 - 0.2 * 0.3), ("tight", 1.0 + 0.5 * 0.3)):
        finding = found[f"effective_track_{name}_m"]
        assert abs(finding.value - factor * track_m) < 1.5 * (finding.high - finding.low) / 2, finding
    same = by_name(motion_findings(rtk_runs(6, seed=3), HUSKY, ("asphalt",)))
    assert not same["effective_track_tight_m"].determined


def with_gnss(run, change):
    """Return a run whose fixes (n, 6) are changed."""
    gnss = run.streams["gnss"]
    values = change(gnss.values.copy())
    return replace(
        run, streams=run.streams | {"gnss": Stream(gnss.time_s, values, GNSS_CHANNELS[: values.shape[1]])}
    )


def test_speeds_alone_and_positions_alone_show_what_both_do():
    runs = rtk_runs(6)
    speeds = [
        replace(run, streams=run.streams | {"gnss": Stream(s.time_s, s.values[:, 2:4], GNSS_CHANNELS[2:4])})
        for run in runs
        for s in [run.streams["gnss"]]
    ]
    positions = [with_gnss(run, lambda values: values[:, :2]) for run in runs]
    for some in (speeds, positions):
        found = by_name(motion_findings(some, HUSKY, ("asphalt",)))
        for name in ("rolling_radius_m", "effective_track_m"):
            assert abs(found[name].value - RTK_TRUTH[name]) < 0.02 * RTK_TRUTH[name], name


def without_fix(values):
    values[:, 5] = 0.0
    return values


def test_without_a_fix_or_rest_alone_every_number_has_its_reason():
    unfixed = [with_gnss(run, without_fix) for run in rtk_runs(4)]
    found = by_name(motion_findings(unfixed, HUSKY, ("asphalt",)))
    assert found["effective_track_m"].note == "run run_000: it has no fixes (stream 'gnss')"
    standing_only = rtk_runs(4, n_turns=1, rest_s=60.0, turning=0.0)
    found = motion_findings(standing_only, HUSKY)
    assert all(not row.determined and row.note for row in found)


def test_one_run_without_a_gyro_or_with_a_gap_of_it_does_not_spoil_the_others():
    def of_imu(run, kept):
        s = run.streams["imu"]
        imu = {"imu": Stream(s.time_s[kept(s.time_s)], s.values[kept(s.time_s)], s.channels)}
        return replace(
            run, streams={n: v for n, v in run.streams.items() if n != "imu"} | (imu if kept(10.0) else {})
        )

    runs = rtk_runs(6)
    some = [
        of_imu(runs[0], lambda at_s: at_s < 0.0),
        of_imu(runs[1], lambda at_s: (at_s < 20.0) | (at_s > 24.0)),
    ]
    found = by_name(motion_findings([*some, *runs[2:]], HUSKY, ("asphalt",)))
    assert "run_000" not in found["effective_track_m"].runs
    for name in ("effective_track_m", "rolling_radius_m", "gnss_delay_s"):
        half = (found[name].high - found[name].low) / 2
        assert abs(found[name].value - RTK_TRUTH[name]) < 1.5 * half, name


def test_straight_driving_shows_the_radius_alone():
    straight = by_name(motion_findings(rtk_runs(turning=0.0), HUSKY, ("asphalt",)))
    assert straight["rolling_radius_m"].determined
    for name in ("effective_track_m", "lever_y_m", "gyro_scale_ratio"):
        assert not straight[name].determined, name
        assert straight[name].note


def test_one_run_is_cut_into_blocks_that_hold_it_alone():
    one = by_name(motion_findings(rtk_runs(1, n_turns=40), HUSKY, ("asphalt",)))
    assert "blocks of time of one run" in one["effective_track_m"].note
    short = by_name(motion_findings(rtk_runs(1, n_turns=4), HUSKY, ("asphalt",)))
    assert "are required" in short["effective_track_m"].note


def test_wheel_speeds_in_another_unit_are_no_rolling_radius():
    wrong = [
        replace(run, streams=run.streams | {"wheels": Stream(s.time_s, 3.6 * s.values, s.channels)})
        for run in rtk_runs(4)
        for s in [run.streams["wheels"]]
    ]
    found = by_name(motion_findings(wrong, HUSKY, ("asphalt",)))
    assert not any(row.determined for row in found.values())
    assert "compare wheel_radius_m, units and signs" in found["rolling_radius_m"].note


def test_noise_of_outliers_moves_little(by_receiver_alone):
    def jumps(values):
        values[50::97, :2] += 3.0
        values[120:140, :2] = np.nan
        return values

    plain, outlying = by_receiver_alone, [with_gnss(run, jumps) for run in rtk_runs()]
    jumping = by_name(motion_findings(outlying, HUSKY, ("asphalt",)))
    for name in ("rolling_radius_m", "effective_track_m", "gnss_delay_s"):
        width = plain[name].high - plain[name].low
        assert abs(plain[name].value - jumping[name].value) < 1.5 * width, name


def test_the_mounting_of_an_imu_comes_back():
    mount = (0.03, -0.05, 0.2)
    runs = rtk_runs(6, mount_rad=mount)
    rests = [stretch for run in runs for stretch in standing(run, HUSKY)]
    assert len(rests) == 6
    for finding, truth in zip(mounting(runs, rests, HUSKY), mount, strict=True):
        assert abs(finding.value - truth) < 1.5 * (finding.high - finding.low) / 2 + 1e-4, finding
        assert finding.high - finding.low < 0.03
    assert not any(row.determined for row in mounting(rtk_runs(2, turning=0.0), [], HUSKY)[:2])


def test_torque_of_an_ampere_comes_back_and_currents_without_sign_say_so():
    """60 kg and all that turns, on 30 N; the description has 57 kg."""
    robot, radius_m = replace(HUSKY, mass_kg=57.0), HUSKY.wheel_radius_m
    runs = rtk_runs(6, ampere_per_n=radius_m / 3.0, n_turns=30, turning=0.05)
    found = by_name(motor_constant(runs, robot))
    for name, truth in (("torque_per_current_nmpa", 3.0), ("resistance_n", 30.0)):
        assert found[name].low < truth < found[name].high, found[name]
        assert found[name].high - found[name].low < 0.3 * truth
    unsigned = []
    for run in runs:
        s = run.streams["wheels"]
        wheels = Stream(s.time_s, np.column_stack([s.values[:, :2], np.abs(s.values[:, 2:])]), s.channels)
        unsigned.append(replace(run, streams=run.streams | {"wheels": wheels}))
    assert "no sign" in motor_constant(unsigned, robot)[0].note
    assert (
        "no run has currents (current_left_a, current_right_a)" in motor_constant(rtk_runs(1), robot)[0].note
    )


@pytest.mark.slow
def test_intervals_by_a_receiver_hold_what_is_hidden():
    from studies import intervals

    rows = intervals.run(intervals.Settings(repeats=20, seed=300, uses="rtk")).rows
    assert {row.name for row in rows} == set(RTK_TRUTH)
    assert 0.9 <= np.mean([row.coverage for row in rows]) <= 0.99
    assert min(row.coverage for row in rows) >= 0.8
