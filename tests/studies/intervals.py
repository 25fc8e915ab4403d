"""Coverage of the intervals of what is identified, over simulated repeats: soils, slip curves, sensors, robots.

A use draws data with numbers that it hides, identifies them, and looks whether the intervals contain them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.stats import truncnorm

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Table
from terrain.bootstrap import proportion_interval
from terrain.calibration.description import findings_of
from terrain.calibration.finding import Finding
from terrain.calibration.lag import STAMP_S
from terrain.calibration.motion import SLIP_RATIO as RADIUS_SLIP_RATIO
from terrain.calibration.motion import motion_findings
from terrain.calibration.odometry import SLIP, fit_odometry, legs_of_poses, level
from terrain.calibration.sensors import fit_gravity
from terrain.calibration.wheels import SLIP_RATIO
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.files.documents import read_yaml
from terrain.identify import Parameter, half_width, identify
from terrain.kinematics.wheels import rolling_matrix
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, Label, RunLog, Stream, TargetStatus
from terrain.robots import description_file, load_robot
from terrain.simulation.plants.tracks import PrescribedSlip
from terrain.simulation.run import learning_runs, simulate, six_positions_log
from terrain.simulation.scenario import make_scenario
from terrain.slip_learning.curve import (
    SHAPE_STD_RATIO,
    SYSTEMATIC_SLIP_STD,
    learn_curve,
    net_peak,
    traction_ratio,
)
from terrain.slip_learning.forces import RunBins
from terrain.slip_learning.learn import learn_terrain, terrain_runs
from terrain.slip_learning.rollers import roller_findings, steady_twist
from terrain.slip_learning.soil import (
    LAWS,
    SINKAGES,
    WHEELS,
    Law,
    Trials,
    fit_law,
    forces_of,
    parameters_of,
    sinkage_of,
)
from terrain.terramechanics.inflow_wheel import FORCE
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.traction import net_pull

EXAMPLE = "python tests/studies intervals --repeats 200 --seed 0"
WHEEL = WHEELS["testbed_smooth"]
SPEEDS_MMPS = (0.0, 3.0, 5.0, 8.0, 10.0, 12.0, 20.0, 40.0, 100.0)
NOMINAL_M = 0.3  #: Wheel radius by which logs of a skid-steer robot are made


class Interval(NamedTuple):
    """What was stated of a number, and the number; ``value`` where it is not the middle."""

    name: str
    low: float
    high: float
    truth: float
    value: float = np.nan


class Covered(NamedTuple):
    """Coverage of one number in one use, and the median and the largest of its errors."""

    use: str
    name: str
    n: int
    coverage: float
    interval: tuple[float, float]
    stated: float
    error_median: float
    error_largest: float


NOMINAL = load_robot("agrimaro")
HIDDEN = NOMINAL.with_parts(
    steering=replace(NOMINAL.steering, zero_1_rad=0.03, zero_2_rad=-0.02, zero_3_rad=0.015),
    motors=replace(NOMINAL.motors, reduction_ratio=9.4),
    camera=replace(NOMINAL.camera, time_constant_s=0.02, speed_std_mps=0.003),
    sensors=replace(
        NOMINAL.sensors,
        encoder_time_constant_s=0.08,
        gyro_bias_x_radps=0.004,
        gyro_bias_y_radps=-0.003,
        gyro_bias_z_radps=0.006,
        gyro_bias_std_radps=0.0015,
        gyro_std_radps=0.002,
        accel_std_mps2=0.015,
        accel_bias_x_mps2=0.1,
        accel_bias_y_mps2=-0.08,
        accel_bias_z_mps2=0.15,
        accel_scale_x_ratio=1.02,
        accel_scale_y_ratio=0.98,
        accel_scale_z_ratio=1.01,
        current_std_a=0.2,
        steering_std_rad=0.0012,
    ),
)
SOILS = {name: load_soil(name) for name in ("tiles", "grass")}


def drive_hidden(scenario, seed, terrain="tiles", duration_s=None, robot=HIDDEN, **options):
    drive = make_scenario(scenario, robot, terrain, duration_s, seed=seed)
    return simulate(robot, drive, SOILS, seed, run_id=f"{scenario}_{seed:03d}", **options)


def skid_run(radius_m, track_m, lidar_s, wheels_s, seed, terrain="asphalt", slip=0.01, n_steps=8, session=""):
    """A run of a robot whose radius, track and delays are known; lidar at 10 Hz, gyro at 50, wheels at 20."""
    rng = np.random.default_rng(seed)
    kernel = np.exp(-np.arange(60) / 15.0)
    n_samples = rng.integers(270, 331, n_steps)  # commands change at any phase of the sensors' samples
    speed = np.repeat(rng.uniform(-1.5, 1.5, n_steps), n_samples)
    turn = np.repeat(rng.uniform(-0.8, 0.8, n_steps) * rng.integers(0, 2, n_steps), n_samples)
    speed, turn = (np.convolve(signal, kernel / kernel.sum())[: len(signal)] for signal in (speed, turn))
    t = np.arange(len(speed)) / 100.0

    def late(signal, at_s, delay_s):
        return np.interp(at_s - delay_s, t, signal)

    imu_s, wheels_at_s, lidar_at_s = (np.arange(0.0, t[-1], step) for step in (0.02, 0.05, 0.1))
    rolled = speed / (1.0 - slip)
    # a nominal radius makes of a smaller one's turns a higher speed; the track is one of these speeds
    sides = [
        late(rolled * NOMINAL_M / radius_m + sign * turn * track_m / 2, wheels_at_s, wheels_s)
        for sign in (-1, 1)
    ]
    wheels = np.column_stack(sides) + rng.normal(0.0, 0.01, (len(wheels_at_s), 2))
    lidar = np.column_stack(
        [late(speed, lidar_at_s, lidar_s), 0.0 * lidar_at_s, late(turn, lidar_at_s, lidar_s)]
    )
    lidar += rng.normal(0.0, 0.03, lidar.shape)
    gyro = late(turn, imu_s, 0.0) + rng.normal(0.0, 0.01, len(imu_s))
    streams = {
        "wheels": Stream(wheels_at_s, wheels, ("speed_left_mps", "speed_right_mps")),
        "imu": Stream(imu_s, gyro[:, None], ("gyro_z_radps",)),
        "lidar": Stream(lidar_at_s, lidar, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")),
    }
    labels = (Label(0.0, float(t[-1]), terrain),) if terrain else ()
    return RunLog(f"run_{seed:03d}", "warthog", streams, labels, session=session)


RTK_STEP_S = 0.005
RTK_TRUTH = {
    "rolling_radius_m": 0.171,
    "effective_track_m": 0.95,
    "wheels_delay_s": 0.06,
    "gnss_delay_s": 0.13,
    "lever_x_m": 0.22,
    "lever_y_m": -0.1,
}


def rtk_run(
    seed,
    n_turns=12,
    terrain="asphalt",
    slip=0.01,
    turning=0.8,
    bias_radps=None,
    noise=1.0,
    rest_s=8.0,
    track_m=RTK_TRUTH["effective_track_m"],
    narrowing=0.0,
    mount_rad=(0.0, 0.0, 0.0),
    ampere_per_n=None,
):
    """A run that stands and then drives random speeds and turns; wheels 20 Hz, IMU 100, receiver 10."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(400, 900, n_turns)
    v, w = (
        np.repeat(values, lengths)
        for values in (rng.uniform(-0.6, 1.0, n_turns), rng.uniform(-1, 1, n_turns))
    )
    w = w * turning
    kernel = np.exp(-np.arange(400) / 60.0)
    n_rest = round(rest_s / RTK_STEP_S)
    v, w = (
        np.concatenate([np.zeros(n_rest), np.convolve(each, kernel / kernel.sum())[: len(each)]])
        for each in (v, w)
    )
    t = RTK_STEP_S * np.arange(len(v))
    yaw = rng.uniform(-np.pi, np.pi) + cumulative_trapezoid(w, dx=RTK_STEP_S, initial=0.0)
    place = cumulative_trapezoid(v * np.exp(1j * yaw), dx=RTK_STEP_S, initial=0.0) + 1000.0 * rng.normal()
    place = place + np.exp(1j * yaw) * complex(RTK_TRUTH["lever_x_m"], RTK_TRUTH["lever_y_m"])
    bias = rng.normal(0.0, 0.003) if bias_radps is None else bias_radps

    def at(signal, at_s, late_s):
        return np.interp(at_s - late_s, t, signal)

    wheels_s, imu_s, gnss_s = (
        np.arange(first, t[-1], step) for first, step in ((0.003, 0.05), (0.0, 0.01), (0.02, 0.1))
    )
    rolled = v / (1.0 - slip) * 0.165 / RTK_TRUTH["rolling_radius_m"]
    across = w * track_m / 2
    for _ in range(
        20
    ):  # a tighter turn has another track: by the difference of the sides over the sum of their sizes
        sharp = np.abs(across) / np.maximum(np.maximum(np.abs(across), np.abs(rolled)), 1e-9)
        across = w * track_m / 2 * (1.0 + narrowing * (sharp - 0.5))
    sides = [at(rolled + sign * across, wheels_s, RTK_TRUTH["wheels_delay_s"]) for sign in (-1, 1)]
    wheels = np.column_stack(sides)
    wheels += noise * rng.normal(0.0, 0.005, wheels.shape) * (np.abs(wheels) > 1e-9)
    accel = np.gradient(v, RTK_STEP_S)
    force = np.column_stack([accel, v * w, np.full(len(v), 9.80665)])
    roll, pitch, turned = mount_rad
    cos, sin = np.cos, np.sin
    by_yaw = np.array([[cos(turned), sin(turned), 0], [-sin(turned), cos(turned), 0], [0, 0, 1]])
    by_pitch = np.array([[cos(pitch), 0, -sin(pitch)], [0, 1, 0], [sin(pitch), 0, cos(pitch)]])
    by_roll = np.array([[1, 0, 0], [0, cos(roll), sin(roll)], [0, -sin(roll), cos(roll)]])
    force = force @ (by_roll @ by_pitch @ by_yaw).T
    imu = [at(w, imu_s, 0.0) + bias, *(at(each, imu_s, 0.0) for each in force.T)]
    imu = [
        values + noise * rng.normal(0.0, std, len(imu_s))
        for values, std in zip(imu, (0.004, 0.05, 0.05, 0.05), strict=True)
    ]
    seen = (
        at(place.real, gnss_s, RTK_TRUTH["gnss_delay_s"]),
        at(place.imag, gnss_s, RTK_TRUTH["gnss_delay_s"]),
    )
    gnss = [each + noise * rng.normal(0.0, 0.015, len(gnss_s)) for each in seen]
    east, north = (np.gradient(each, 0.1) for each in gnss)
    fixes = np.column_stack([*gnss, east, north, np.full(len(gnss_s), 0.015), np.ones(len(gnss_s))])
    sides_n = 60.0 * accel / 2.0 + 15.0 * np.tanh(v / 0.02)
    currents = (
        []
        if ampere_per_n is None
        else [at(ampere_per_n * sides_n, wheels_s, RTK_TRUTH["wheels_delay_s"])] * 2
    )
    names = ("speed_left_mps", "speed_right_mps", *("current_left_a", "current_right_a")[: len(currents)])
    values = np.column_stack([wheels, *(each + rng.normal(0.0, 0.1, len(wheels_s)) for each in currents)])
    streams = {
        "wheels": Stream(wheels_s, values, names),
        "imu": Stream(imu_s, np.column_stack(imu), ("gyro_z_radps", *IMU_CHANNELS[3:6])),
        "gnss": Stream(gnss_s, fixes, GNSS_CHANNELS),
    }
    labels = (Label(0.0, float(t[-1]), terrain),) if terrain else ()
    return RunLog(f"run_{seed:03d}", "husky", streams, labels), bias


def drawn_runs(
    law, theta, rng, n=6, noise=0.01, run_std=0.1, offset_std=0.003, reach=0.6, offset=0.0, tilt=0.0
):
    """Return bins of runs whose factor and offset differ as runs do, and that share an offset and a tilt a slip."""
    runs = []
    for number in range(n):
        slip = np.linspace(0.005, reach * rng.uniform(0.8, 1.0), 18)
        factor = np.exp(run_std * rng.standard_normal()) * (1.0 + tilt * slip)
        mu = factor * traction_ratio(law, theta, slip + offset + offset_std * rng.standard_normal())
        mu = mu + noise * rng.standard_normal(len(mu))
        runs.append(RunBins(f"run {number}", slip, np.full(18, 0.003), mu, np.full(18, noise)))
    return runs


def wheel_trials(law: Law, depth: Array, hidden: Mapping[str, float], seed: int, noise_ratio=0.03) -> Trials:
    """Trials of a wheel that a law with hidden numbers describes, with noise of forces and depth."""
    wheel_mps, angle = (
        grid.ravel() * 1.0 for grid in np.meshgrid(np.array(SPEEDS_MMPS) / 1e3, np.arange(0.0, 91.0, 15.0))
    )
    n = len(wheel_mps)
    travel, blank = np.full(n, 0.01), np.zeros(n)
    slip = (wheel_mps - travel) / np.maximum(wheel_mps, travel)
    trials = Trials(
        wheel_mps / WHEEL.radius_m,
        *(travel, np.radians(angle), slip, np.full(n, 22.0), blank, blank, blank),
        *(wheel_mps * 1e3, angle, np.ones(n)),
    )
    rng = np.random.default_rng(seed)
    force = np.array([hidden.get(name, FORCE[name][0]) for name in law.free])
    found = forces_of(law, force, trials, WHEEL, sinkage_of(law, depth, trials, WHEEL))
    spread = noise_ratio * trials.load_n
    return trials._replace(
        pull_n=found.pull_n + spread * rng.standard_normal(n),
        side_n=found.side_n + spread * rng.standard_normal(n),
        sinkage_m=found.sinkage_m + 5e-4 * rng.standard_normal(n),
    )


def tracked_arcs(robot, given, n=12, seed=0, **sensors):
    """Return runs of arcs of several radii with poses of cameras around."""
    rng, runs = np.random.default_rng(seed), []
    for k in range(n):
        belts = np.tile(rng.uniform(-0.15, 0.15, 2), (401, 1))
        runs.append(simulate(robot, belts, given, 100 * seed + k, run_id=f"run_{k}", **sensors))
    return runs


# -- uses --------------------------------------------------------------------------------------------------


def _regression(seed: int) -> Iterator[Interval]:
    """A line over runs that differ by an offset of their own."""
    rng, run = np.random.default_rng(seed), np.repeat(np.arange(15), 20)
    x = np.repeat(rng.normal(size=15), 20)
    y = 0.5 - 2.0 * x + 0.3 * np.repeat(rng.normal(size=15), 20) + 0.1 * rng.normal(size=300)
    line = [Parameter("intercept", 0.0), Parameter("slope", 0.0)]
    fit = identify(lambda p: p[0] + p[1] * x - y, line, run)
    for p, low, high, truth in zip(line, *fit.interval, (0.5, -2.0), strict=True):
        yield Interval(p.name, low, high, truth)


def _six_positions(seed: int) -> Iterator[Interval]:
    rng, bias, scale, std = np.random.default_rng(seed), [0.1, -0.08, 0.15], [1.02, 0.98, 1.01], 1e-3
    up = rng.normal(0.0, 0.1, (12, 3)) + np.tile(np.vstack([np.eye(3), -np.eye(3)]), (2, 1))
    up /= np.linalg.norm(up, axis=1)[:, None]
    means = np.array(scale) * GRAVITY_MPS2 * up + bias + std * rng.standard_normal(up.shape)
    *found, cov = fit_gravity(means, np.full(up.shape, std**2))
    half = half_width(np.sqrt(np.diag(cov)), np.inf)
    for k, (value, truth) in enumerate(zip(np.concatenate(found), bias + scale, strict=True)):
        name = ("bias" if k < 3 else "scale") + f"_{'xyz'[k % 3]}"
        yield Interval(name, value - half[k], value + half[k], truth)


def _swerve(seed: int) -> Iterator[Interval]:
    """A robot whose zeros are off by up to half a step of their encoders, and slip and stamps as is assumed."""
    rng, soil, steps = np.random.default_rng(seed), SOILS["tiles"], HIDDEN.sensors.steering_steps_ratio
    off_rad = 2 * np.pi / steps * rng.uniform(-0.5, 0.5, 3)
    zeros = {f"zero_{i}_rad": zero for i, zero in enumerate(HIDDEN.steering_zeros_rad + off_rad, start=1)}
    shear = soil.stiffness_ratio * soil.shape_ratio * soil.peak_friction_ratio
    own_slip, slip = soil.rolling_resistance_ratio / shear, rng.uniform(*SLIP_RATIO)
    ratio = HIDDEN.motors.reduction_ratio * (1 - own_slip) / (1 - slip)
    robot = HIDDEN.with_parts(
        steering=replace(HIDDEN.steering, **zeros), motors=replace(HIDDEN.motors, reduction_ratio=ratio)
    )
    runs = [drive_hidden("stand", 10 * seed + k, duration_s=8.0, robot=robot) for k in range(3)]
    runs += [drive_hidden(name, seed, robot=robot) for name in ("complex", "starts")]
    runs += [six_positions_log(robot, 10 * seed + k, hold_s=3.0, run_id=f"bench_{k}") for k in range(3)]
    late_s, description = rng.uniform(-STAMP_S, STAMP_S), read_yaml(description_file("agrimaro"))
    for k, run in enumerate(runs):
        imu = run.streams["imu"]
        imu = Stream(imu.time_s + late_s, imu.values, imu.channels)
        runs[k] = replace(run, streams={**run.streams, "imu": imu})
    for finding in findings_of(runs, description, NOMINAL, ("tiles",)):
        section, _, name = finding.parameter.partition(".")
        if finding.determined and name and section != "identified":
            yield Interval(name, finding.low, finding.high, getattr(getattr(HIDDEN, section), name))


def _skid_steer(seed: int) -> Iterator[Interval]:
    """A robot whose wheels slip as is assumed, and whose delays lie anywhere between samples."""
    rng = np.random.default_rng(seed)
    lidar_s, wheels_s = np.array([0.3, 0.05]) + rng.uniform(0.0, 0.05, 2)
    slip, hidden = rng.uniform(*RADIUS_SLIP_RATIO), (0.29, 1.8, lidar_s, wheels_s)
    runs = [skid_run(*hidden, 1000 * seed + k, slip=slip) for k in range(8)]
    names = ("rolling_radius_m", "effective_track_m", "lidar_delay_s", "wheels_delay_s")
    yield from _within(
        motion_findings(runs, load_robot("warthog"), ("asphalt",)), dict(zip(names, hidden, strict=True))
    )


def _within(findings: Sequence[Finding], truth: Mapping[str, float]) -> Iterator[Interval]:
    for finding in findings:
        if finding.determined and (name := finding.parameter.partition(".")[2]) in truth:
            yield Interval(name, finding.low, finding.high, truth[name])


def _rtk(seed: int) -> Iterator[Interval]:
    """A skid-steer robot of four numbers whose motion a receiver alone measures."""
    slip = np.random.default_rng(seed).uniform(*RADIUS_SLIP_RATIO)
    runs = [rtk_run(1000 * seed + k, slip=slip)[0] for k in range(8)]
    robot = load_robot("husky").without("body", "motors", "camera", "sensors")
    yield from _within(motion_findings(runs, robot, ("asphalt",)), RTK_TRUTH)


def _soil(seed: int) -> Iterator[Interval]:
    """Numbers as likely as the priors take them for, and errors as large as such laws have."""
    law, rng, hidden = LAWS["wong_reece"], np.random.default_rng(900 + seed), {}
    for name in law.free:
        mean, std, low, high = FORCE[name]
        hidden[name] = truncnorm.rvs((low - mean) / std, (high - mean) / std, mean, std, random_state=rng)
    depth = [max(rng.normal(mean, std), 1e-4) for mean, std in SINKAGES[law.sinkage].values()]
    trials = wheel_trials(law, np.array(depth), hidden, seed, noise_ratio=0.1)
    found = parameters_of(fit_law(law, trials, WHEEL), trials, 30, seed)
    for name, truth in hidden.items():
        yield Interval(name, *found[name].interval, truth)


def _rollers(seed: int) -> Iterator[Interval]:
    robot, rng, ratio = load_robot("robotino"), np.random.default_rng(seed), {"cork": 0.1, "moss": 0.6}
    place, load, runs = (
        (robot.wheel_positions_m, robot.wheel_directions_rad),
        np.array([0.25, 0.45, 0.30]),
        [],
    )
    for surface, rho in ratio.items():
        for k in range(24):
            angle = 2 * np.pi * k / 24
            ahead = np.array([np.cos(angle), np.sin(angle)])
            wheels = 0.1 * np.array([[*ahead, 0.0]]) @ rolling_matrix(*place).T
            twist = steady_twist(wheels, *place, load, rho, 0.06)[0, :2] + rng.normal(0.0, 0.002, 2)
            side = (ahead[0] * twist[1] - ahead[1] * twist[0]) / 0.1
            slip = SimpleNamespace(
                steady=np.ones(1, bool),
                body_slip=np.array([1.0 - twist @ ahead / 0.1]),
                body_side=np.array([side]),
                wheel_speed_mps=wheels,
                known=np.ones(1, bool),
            )
            runs.append((slip, surface))
    found = roller_findings([slip for slip, _ in runs], [name for _, name in runs], robot, list(ratio))
    for k, (interval, truth) in enumerate(zip(found.load_interval, load.tolist(), strict=True), start=1):
        yield Interval(f"load_{k}_ratio", *interval, truth)
    yield Interval("scale_ratio", *found.scale_interval, 0.06)
    for name, truth in ratio.items():
        yield Interval(f"roller_{name}_ratio", *found.roller_interval[name], truth)


def _odometry(seed: int) -> Iterator[Interval]:
    robot = load_robot("patako")
    given = PrescribedSlip(slip_ratio=0.08, turning_loss_ratio=0.4, turning_exponent=0.7)
    runs = enumerate(tracked_arcs(robot, given, seed=seed))
    legs = [leg for k, run in runs for leg in legs_of_poses(run, k, robot, 2.0)]
    fit = fit_odometry(level(SLIP), legs, robot).fit
    truth = {"turning_exponent": 0.7, "compaction_slip_ratio": 0.08, "lever_x_m": 0.0, "lever_y_m": 0.0}
    for p, low, high in zip(fit.parameters, *fit.interval, strict=True):
        if p.name in truth:
            yield Interval(p.name, low, high, truth[p.name])


def _slip_curve(seed: int) -> Iterator[Interval]:
    """Runs that share the errors that the interval of a peak states: of the radius, and of the curve's tilt."""
    for name, law, theta, rho in (
        ("sand", "janosi", (0.6, 0.16), 0.1),
        ("snow", "magic", (5.0, 2.0, 0.3, 1.0), 0.04),
    ):
        rng = np.random.default_rng(seed)
        whole = net_peak(lambda s: traction_ratio(law, theta, s) - rho, 0.0, 0.6).slip_ratio  # noqa: B023
        offset, tilt = rng.standard_normal(2) * (SYSTEMATIC_SLIP_STD, SHAPE_STD_RATIO / whole)
        runs = drawn_runs(law, theta, rng, offset=offset, tilt=tilt)
        curve = learn_curve(runs, np.full(len(runs), rho), np.full(len(runs), 0.01), rng, 60)
        true = net_peak(lambda s: traction_ratio(law, theta, s) - rho, *curve.slip_range)  # noqa: B023
        yield Interval(f"peak_{name}", *curve.peak_interval, true.slip_ratio)


def _slip_peak(seed: int) -> Iterator[Interval]:
    """A simulated terrain, the soils in turn; nothing where its targets are not learned.

    The truth is the peak of the described soil's own net traction under a third of the robot's weight, by the same
    definition over the slips that its runs observe.
    """
    terrain, body = soil_names()[seed % len(soil_names())], NOMINAL.body
    runs = [each for run in learning_runs(NOMINAL, terrain, seed) for each in terrain_runs(run, NOMINAL)]
    learned = learn_terrain(terrain, runs, seed)
    curve = learned.curve
    if curve is None or learned.status is not TargetStatus.ESTIMATED:
        return
    soil, load_n = load_soil(terrain), NOMINAL.mass_kg * GRAVITY_MPS2 / len(NOMINAL.wheels)
    wheel = NOMINAL.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    true = net_peak(lambda slips: net_pull(soil, load_n, slips, *wheel), *curve.slip_range)
    yield Interval("peak", *curve.peak_interval, true.slip_ratio, curve.peak.slip_ratio)


USES: dict[str, tuple[Callable[[int], Iterator[Interval]], float]] = {
    "regression": (_regression, 0.95),
    "six-positions": (_six_positions, 0.95),
    "swerve": (_swerve, 0.95),
    "skid-steer": (_skid_steer, 0.95),
    "rtk": (_rtk, 0.95),
    "rollers": (_rollers, 0.95),
    "odometry": (_odometry, 0.95),
    "soil": (_soil, 0.95),
    "slip-curve": (_slip_curve, 0.9),
    "slip-peak": (_slip_peak, 0.9),
}
"""By name: what draws and identifies, and the probability that its intervals state."""


class Settings(BaseSettings):
    """Which uses are repeated, and how often."""

    repeats: int = setting(200, "Data sets of each use.", ge=2)
    seed: int = setting(0, "Of the first data set.", ge=0)
    uses: str = setting(",".join(USES), "Names, separated by commas.")


class IntervalsResult(Result):
    """Coverage of every number in every use."""

    repeats: int = described("data sets of each use")
    seed: int = described("of the first")
    rows: tuple[Covered, ...] = described("one a number and use")


def run(settings: Settings, progress: Progress = silent) -> IntervalsResult:
    """Draw, identify and count."""
    rows = []
    for use in settings.uses.split(","):
        if use not in USES:
            raise ConfigError(f"--uses: there is no use {use!r}; there are {', '.join(USES)}")
        draw, stated = USES[use]
        intervals: dict[str, list[Interval]] = {}
        for k in range(settings.repeats):
            for each in draw(settings.seed + k):
                intervals.setdefault(each.name, []).append(each)
            progress(use, k + 1, settings.repeats)
        rows += [_covered(use, name, each, stated) for name, each in intervals.items()]
    return IntervalsResult(settings.repeats, settings.seed, tuple(rows))


def _covered(use: str, name: str, intervals: list[Interval], stated: float) -> Covered:
    n, hits = len(intervals), sum(bool(each.low <= each.truth <= each.high) for each in intervals)
    middles = [each.value if np.isfinite(each.value) else (each.low + each.high) / 2 for each in intervals]
    errors = np.abs(np.array(middles) - [each.truth for each in intervals])
    median, largest = float(np.median(errors)), float(errors.max())
    return Covered(use, name, n, hits / n, proportion_interval(hits, n), stated, median, largest)


def report(result: IntervalsResult) -> Report:
    """Return the coverage of each number."""
    low, high = (f(row.coverage - row.stated for row in result.rows) for f in (min, max))
    columns = (
        *("use", "number", "repeats", Column("coverage", ".3f"), Column("95 %", ".3f")),
        *(Column("stated", ".2f"), Column("median error", ".3g"), Column("largest", ".3g")),
    )
    return Report(
        "Intervals of what is identified",
        f"Of {result.repeats} data sets each, intervals contain what is hidden {100 * low:+.0f} to {100 * high:+.0f} "
        "points from as often as they state.",
        parts=(Table(columns, tuple(tuple(row) for row in result.rows)),),
    )
