"""Danzi, AgriMaRo thesis: its experiments on simulated runs, one function each; its claims are in danzi.yaml."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from claims import Finding, Numbers, Trial
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.model_selection import StratifiedKFold
from stiffness import StiffnessLevel, cost_matrix, least_cost_class, response_of

from features.extractor import FeatureExtractor
from features.windows import cut_windows, join_windows
from pipelines.report.figure import Band, Figure, Line, Panel
from terrain.classify.folds import split_runs
from terrain.classify.metrics import accuracy_interval
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.constants import GRAVITY_MPS2
from terrain.control.pid import (
    LOW_SPEED_MPS,
    POWER_THRESHOLD_WPKG,
    Gains,
    WheelPid,
    conditioned_slip,
    desired_slip,
    pid_step,
    power_state,
    wheel_step,
)
from terrain.estimation.consistency import lagged_slip, lagged_slip_at
from terrain.estimation.estimate import THESIS_EMA_ALPHA, Estimate, enriched, estimate_run, summarize
from terrain.estimation.feed import measurement_table
from terrain.estimation.filter import FilterModel, FilterSettings, differentiate, run_filter
from terrain.estimation.models.swerve import THESIS_SAMPLE_TIME_S, make_filter
from terrain.estimation.wheel_slip import STEADY_SPEED_MPS, slip_figures, wheel_slip
from terrain.kernels import njit
from terrain.kinematics.camera import body_motion, odometry_stream, to_camera
from terrain.kinematics.commands import scaled
from terrain.kinematics.wheels import no_slip_twist, velocity_matrix
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog, Windows
from terrain.robots import Robot, load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import STAND_S, Faults
from terrain.slip import MIN_SPEED_MPS
from terrain.terramechanics.soil import load_soil, soil_names

ROBOT = "agrimaro"
RUNS, FEW_RUNS = 5, 2
"""Number of runs that a figure is averaged over, and the number with ``quick``."""
START_S = (STAND_S, STAND_S + 2.0)
"""The start of the scenario ``straight`` at 1 m/s^2, and one second to settle."""


class Curve(NamedTuple):
    """Times (n,) in s, slip ratio (n, wheels) and forward speed (n,) in m/s."""

    time_s: Array
    slip_ratio: Array
    speed_mps: Array


def seeded_runs(
    trial: Trial, terrain: str, scenario: str, duration_s: float | None = None, faults: Faults | None = None
) -> list[RunLog]:
    """Return runs that differ in their random draws; arguments as for ``simulate_run``."""
    numbers, robot = range(1, 1 + (FEW_RUNS if trial.quick else RUNS)), load_robot(ROBOT)
    return [
        simulate_run(robot, terrain, scenario, trial.seed, number, duration_s=duration_s, faults=faults)
        for number in numbers
    ]


def estimate_with_both_filters(runs: Sequence[RunLog]) -> tuple[list[Estimate], list[Estimate]]:
    """Return the estimates of the thesis' filter with its own noise, and of vio15 with physical noise."""
    return by_filter(runs, "vio12"), by_filter(runs, "vio15", "physical")


def by_filter(runs: Sequence[RunLog], name: str, tuning: str = "thesis") -> list[Estimate]:
    """Return the estimates of a filter; ``slip14`` is that of :func:`slip_ratio_filter`."""
    robot = load_robot(ROBOT)
    if name == "slip14":
        model = slip_ratio_filter(robot)
        return [estimate_run(run, robot, "encoder12", tuning=tuning, model=model) for run in runs]
    return [estimate_run(run, robot, name, tuning=tuning) for run in runs]


def lagged_truth(run: RunLog, robot: Robot) -> Curve:
    """Return the true slip after the low-pass filter of the encoders: the best that can be estimated."""
    slip, ground_speed = lagged_slip(run, robot)
    return Curve(run.streams["truth"].time_s, slip, ground_speed.mean(axis=1))


def true_slip(estimate: Estimate) -> Array:
    """Return :func:`lagged_truth` (n, wheels) at the sample times of a filter."""
    return lagged_slip_at(estimate.run, estimate.robot, estimate.track.time_s)


def steady_mean(slip: Array, estimate: Estimate) -> float:
    """Return the mean over the wheels of a slip (n, wheels) while the true speed is steady."""
    truth = estimate.run.streams["truth"]
    steady = slip_figures(estimate.blind, truth.channel("speed_x_mps"), truth.time_s).steady
    return float(np.nanmean(slip[steady]))


def steady_slips(estimates: Sequence[Estimate]) -> list[float]:
    """Return the steady slip that a filter estimates, run by run."""
    return [steady_mean(one.slip.mean, one) for one in estimates]


def steady_truths(estimates: Sequence[Estimate]) -> list[float]:
    """Return the true steady slip, run by run."""
    return [steady_mean(true_slip(one), one) for one in estimates]


def mean_between(slip: Array, estimate: Estimate, start_s: float, end_s: float) -> float:
    """Return the mean over the wheels of a slip (n, wheels) between two times."""
    time_s = estimate.track.time_s
    return float(np.nanmean(slip[(time_s >= start_s) & (time_s < end_s)]))


def extreme_in_start(
    curve: Curve, extreme: Callable[[Array], float], above_mps: float = STEADY_SPEED_MPS
) -> float:
    """Return the smallest or largest slip during the start, at speeds above ``above_mps``."""
    chosen = (curve.time_s > START_S[0]) & (curve.time_s < START_S[1]) & (curve.speed_mps > above_mps)
    values = curve.slip_ratio[chosen]
    return float(extreme(values[np.isfinite(values)]))


# -- 2.3.2: body velocities at which no wheel motor saturates ------------------------------------------------------

TRACKS_M = (0.7, 0.756, 1.1)
"""Lower limit of the adjustment, track of 7.2, upper limit."""
FORWARD = 0.7
"""Forward speed over its limit at which the printed equations are checked."""


def admissible_twists(trial: Trial) -> Finding:
    """Compare admissible speeds and yaw rates with the text, and the printed signs with the right ones.

    Lengths are in half wheelbases and speeds in the speed limit of the motors, as in (2.6) to (2.11).
    """
    robot = load_robot(ROBOT)
    half_m = robot.wheelbase_m / 2
    places = {track_m: wheel_places(track_m / half_m) for track_m in TRACKS_M}
    own, xi = wheel_places(robot.track_m / half_m), robot.track_m / half_m
    angle = np.linspace(0.0, 2 * np.pi, 361)
    directions = 2.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)])
    slowest = float(np.linalg.norm(scaled(own, 1.0, directions, 1.0), axis=1).min())
    rates = {track_m: float(_yaw_rates(place, 0.0)[1]) for track_m, place in places.items()}
    narrow_m, wide_m = min(TRACKS_M), max(TRACKS_M)
    # y' - (w/2) g' for both puts wheels 1 and 2 at one end, x' - t g' the third to the left.
    printed = np.array([[-1.0, 0.0], [-1.0, 0.0], [0.0, xi]])
    admitted, corrected = (float(_yaw_rates(place, FORWARD)[1]) for place in (printed, own))
    wheels = (velocity_matrix(own) @ [FORWARD, 0.0, admitted]).reshape(-1, 2)
    by_sign = {"yaw rate admitted as printed": admitted, "yaw rate admitted, corrected": corrected}
    numbers = {
        "translation": Numbers(slowest),
        "turn_on_the_spot": Numbers(
            rates[wide_m] / rates[narrow_m],
            beside={f"track {m:g} m, ξ = {m / half_m:.3f}": rate for m, rate in rates.items()},
            values={"wide": wide_m, "narrow": narrow_m},
        ),
        "printed_signs": Numbers(
            float(np.hypot(wheels[:, 0], wheels[:, 1]).max()), beside=by_sign, values={"forward": FORWARD}
        ),
    }
    speed = np.linspace(-1.0, 1.0, 401)
    regions = tuple(
        Band(f"track {m:g} m, ξ = {m / half_m:.2f}", speed, *_yaw_rates(place, speed))
        for m, place in places.items()
    )
    panel = Panel(regions, "yaw rate, dimensionless (2.11)")
    figure = Figure("Admissible twists, no sideways motion", (panel,), x_label="forward speed over its limit")
    return Finding(numbers, {"twists": figure})


def wheel_places(xi: float) -> Array:
    """Return the places (3, 2) of the wheels in half wheelbases for a track of ``xi`` half wheelbases."""
    return np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -xi]])


def admissible_yaw_rate(
    positions_m: Array, radius_m: float, speed_x_mps: Array, speed_y_mps: Array, speed_max_radps: float
) -> tuple[Array, Array]:
    """Return the lowest and the highest yaw rate (...) that saturate no wheel at a given translation.

    The boundary of the admissible region: with v_max = r w_max, (2.6) corrected asks of every wheel
    ``(x_i^2 + y_i^2) g'^2 + 2 (x_i v_y - y_i v_x) g' + v_x^2 + v_y^2 - v_max^2 <= 0``, an interval of g'.
    Figure 2.8 and its dimensionless twist (2.11) come of positions in half wheelbases, radius and limit 1.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    speed_x_mps, speed_y_mps : (...) broadcast against each other
    speed_max_radps : limit of the wheels

    Returns
    -------
    low_radps, high_radps : (...); NaN where no yaw rate is admissible

    Examples
    --------
    >>> xi = 1.5  # track over half the wheelbase
    >>> admissible_yaw_rate([[-1, 0], [1, 0], [0, -xi]], 1.0, [0.0, 0.7], 0.0, 1.0)
    (array([-0.66666667, -0.71414284]), array([0.66666667, 0.2       ]))
    """
    limit_mps = radius_m * speed_max_radps
    x_mps, y_mps = np.broadcast_arrays(np.asarray(speed_x_mps, float), np.asarray(speed_y_mps, float))
    x, y = np.asarray(positions_m, float).T
    square = x * x + y * y
    across = x * y_mps[..., None] - y * x_mps[..., None]
    away = x * x_mps[..., None] + y * y_mps[..., None]
    # across^2 + away^2 = square * speed^2 turns the discriminant into one that cancels nothing
    inside = square * limit_mps**2 - away**2
    # a wheel at the origin does not feel the yaw rate: it bounds the translation alone
    free = np.where(np.hypot(x_mps, y_mps) <= limit_mps, np.inf, np.nan)[..., None]
    root = np.sqrt(np.where(inside >= 0, inside, np.nan))
    pivot = np.where(square > 0, square, 1.0)
    low = np.where(square > 0, (-across - root) / pivot, -free).max(axis=-1)
    high = np.where(square > 0, (-across + root) / pivot, free).min(axis=-1)
    return np.where(low <= high, low, np.nan), np.where(low <= high, high, np.nan)


def _yaw_rates(places: Array, ahead: float | Array) -> tuple[Array, Array]:
    return admissible_yaw_rate(places, 1.0, np.asarray(ahead), np.zeros(()), 1.0)


# -- 4.3 to 4.6: filters without a measurement of the speed over ground ---------------------------------------------


def blind_filters(trial: Trial) -> Finding:
    """Estimate slip on grass at 1 m/s by the filters with 12 and with 14 states; rank of their states."""
    robot, runs = load_robot(ROBOT), seeded_runs(trial, "grass", "straight")
    encoder, slip = by_filter(runs, "encoder12"), by_filter(runs, "slip14")
    true = Numbers.over(steady_truths(encoder))
    assert true.spread is not None
    beside = {"true slip": true.simulated}
    rank = {name: straight_line_rank(name, robot) for name in ("slip14", "encoder12", "vio12", "vio15")}
    observable, total = straight_line_rank("slip14", robot, as_printed=True)
    others = {f"{name}, of {n}": k for name, (k, n) in rank.items() if name != "slip14"}
    numbers = {
        "twelve_states": Numbers.over([steady_mean(one.blind.mean, one) for one in encoder], beside),
        "fourteen_states": Numbers.over(
            [steady_mean(_slip_states(one), one) for one in slip],
            beside,
            true_low=true.spread[0],
            true_high=true.spread[1],
        ),
        "rank": Numbers(
            observable,
            beside={"with rows 4 and 5 corrected to the accelerations": rank["slip14"][0], **others},
            values={"total": total},
        ),
    }
    time_s = encoder[0].track.time_s
    moving = time_s > START_S[0] + 0.5
    lines = tuple(
        Line(label, time_s[moving], values.mean(axis=1)[moving])
        for label, values in (
            ("true", true_slip(encoder[0])),
            ("12 states, without a camera", encoder[0].blind.mean),
            ("14 states", _slip_states(slip[0])),
        )
    )
    return Finding(numbers, {"blind": time_figure("Slip without a measurement of the speed, grass", lines)})


def time_figure(title: str, marks: Sequence[Any], y_label: str = "slip, mean of the wheels") -> Figure:
    """Return a figure over time of one panel."""
    return Figure(title, (Panel(tuple(marks), y_label),), x_label="time [s]")


def _slip_states(estimate: Estimate) -> Array:
    return np.column_stack([estimate.track.state(f"slip_{wheel}_ratio") for wheel in estimate.robot.wheels])


LARGEST_SLIP_RATIO = 0.95
"""The wheel rows have a pole at 1: they are evaluated no nearer."""


@njit
def _measure_slip14(x: Array, _dt: float, params: Array, z: Array) -> None:
    for i in range(3):
        place_x, place_y = params[1 + 2 * i], params[2 + 2 * i]
        rolls = 1.0 - min(x[8 + i], LARGEST_SLIP_RATIO)
        ahead, left = x[3] - x[5] * place_y, x[4] + x[5] * place_x
        z[i] = (ahead * np.cos(x[11 + i]) + left * np.sin(x[11 + i])) / (params[0] * rolls)
        z[7 + i] = x[11 + i]
    z[3], z[4], z[5], z[6] = x[6], x[7], x[5], x[2]


@njit
def _observe_slip14(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    differentiate(_measure_slip14, x, 0.0, params, z_hat, h)


def slip_ratio_filter(robot: Robot) -> FilterModel:
    """Return the thesis' filter with 14 states: a slip ratio of each wheel, and no bias of the gyro.

    As encoder12 beside that, with ``wheel_i = v_i / ((1 - s_i) r)`` and the noise of (4.38) to (4.41).  Nothing
    determines the slip ratios as long as it drives straight.
    """
    plain, n = make_filter("encoder12", robot, thesis=True), 8
    states = (*plain.states[:n], *(f"slip_{wheel}_ratio" for wheel in robot.wheels), *plain.states[n : n + 3])
    steer_walk = plain.process_variance.diagonal()[n]
    return replace(
        plain,
        name="slip14",
        states=states,
        observe=_observe_slip14,
        process_variance=[
            *plain.process_variance.diagonal()[:n],
            *[1e-5 / THESIS_SAMPLE_TIME_S] * 3,
            *[steer_walk] * 3,
        ],
        initial_variance=[*plain.initial_variance.diagonal()[:n], *[1e-6] * 3, *[1e-1] * 3],
        initial_mean=np.zeros(len(states)),
        angle_states=tuple(state for state in states if state in plain.angle_states),
    )


def straight_line_rank(name: str, robot: Robot, as_printed: bool = False) -> tuple[int, int]:
    """Return how many independent states of a filter are observable driving straight, of all but the position.

    It is the rank of the local observability matrix: the Jacobian H of the measurements times the product of
    the Jacobians F of the steps up to each of n samples, n being the number of states, at 0.875 m/s and a slip
    of 0.125: wheels at 1 m/s.

    Parameters
    ----------
    name : of a filter of a swerve robot
    robot : the robot
    as_printed : with rows 4 and 5 of (4.28), -w v_y and w v_x, in place of the accelerations

    Examples
    --------
    >>> straight_line_rank("slip14", load_robot("agrimaro"), as_printed=True)
    (9, 12)
    """
    model = slip_ratio_filter(robot) if name == "slip14" else make_filter(name, robot)
    n = len(model.states)
    x, params = np.zeros(n), np.append(model.params, np.zeros(len(model.inputs)))
    along, across, yaw_rate = map(model.states.index, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    x[along] = 0.875
    x[[state.startswith("slip_") for state in model.states]] = 0.125
    since_start, blocks = np.eye(n), []
    for _ in range(n):
        expected, h = np.zeros(len(model.rows)), np.zeros((len(model.rows), n))
        model.observe(x, params, expected, h)
        if as_printed:  # the Jacobian of -w v_y and w v_x
            h[3:5] = 0.0
            h[3, across], h[3, yaw_rate] = -x[yaw_rate], -x[across]
            h[4, along], h[4, yaw_rate] = x[yaw_rate], x[along]
        blocks.append(h @ since_start)
        after, f = np.zeros(n), np.zeros((n, n))
        model.propagate(x, THESIS_SAMPLE_TIME_S, params, after, f)
        since_start, x = f @ since_start, after
    return int(np.linalg.matrix_rank(np.vstack(blocks))), n - len(model.positions)


# -- 4.6.1: the noise of the wheels raised and that of the IMU lowered ----------------------------------------------

FACTORS = (1.0, 1e2, 1e4, 1e6)
"""Factors by which the noise of the wheels is raised and that of the IMU lowered."""
WHEEL_SPEED_MPS = 1.0
"""Commanded wheel speed of the scenario ``straight``."""


def adaptive_noise(robot: Robot, factor: float) -> FilterModel:
    """Return encoder12 with noise that trusts the wheels less and the IMU more, as thesis 4.6.1 tried in vain.

    The variance of the wheels is multiplied by the factor, that of accelerometer and gyro divided by it, and
    the walk of the yaw rate multiplied.  No factor will do: as long as the wheels hold the speed, it is
    theirs and slip reads zero; where they do not, it includes the integral of the accelerometer's
    bias.  The speed over ground has to be measured.
    """
    plain = make_filter("encoder12", robot)
    scale = {"wheel": factor, "accel": 1 / factor, "gyro": 1 / factor}
    walk = plain.process_variance.diagonal().copy()
    walk[plain.states.index("yaw_rate_radps")] *= factor
    scales = np.array([scale.get(row.split("_")[0], 1.0) for row in plain.rows])
    return replace(plain, process_variance=walk, measurement_variance=plain.measurement_variance * scales)


def adaptive_tuning(trial: Trial) -> Finding:
    """Estimate slip over one minute on grass with each factor."""
    robot, length_s = load_robot(ROBOT), 30.0 if trial.quick else 60.0
    runs = seeded_runs(trial, "grass", "straight", duration_s=length_s)
    estimates = {
        factor: [
            estimate_run(run, robot, "encoder12", tuning="thesis", model=adaptive_noise(robot, factor))
            for run in runs
        ]
        for factor in FACTORS
    }
    most = max(FACTORS)
    true = float(np.mean(steady_truths(estimates[most])))
    errors = {
        factor: Numbers.over([_late_error(one, length_s) for one in row]) for factor, row in estimates.items()
    }
    best = min(errors.values(), key=lambda error: error.simulated)
    drifts = {factor: [abs(_drift_mps(one)) for one in row] for factor, row in estimates.items()}
    slip_speed_mps = true * WHEEL_SPEED_MPS
    numbers = {
        "slip_error": best._replace(
            beside={"true slip": true} | {f"factor {f:g}": error.simulated for f, error in errors.items()}
        ),
        "drift": Numbers.over(
            drifts[most],
            {f"factor {f:g}": float(np.mean(drifts[f])) for f in FACTORS[:-1]},
            length_s=length_s,
            most=most,
            n_runs=len(runs),
            n_diverged=sum(value > slip_speed_mps for value in drifts[most]),
            slip_speed=slip_speed_mps,
        ),
    }
    lines = [
        Line(f"factor {factor:g}", row[0].track.time_s, _speed_error_mps(row[0]))
        for factor, row in estimates.items()
    ]
    figure = time_figure("Adaptive tuning: error of the speed, grass", lines, "error of the speed [m/s]")
    return Finding(numbers, {"drift": figure})


def _late_error(estimate: Estimate, length_s: float) -> float:
    last = mean_between(estimate.blind.mean, estimate, length_s - 10.0, length_s)
    return abs(last - steady_mean(true_slip(estimate), estimate))


def _drift_mps(estimate: Estimate) -> float:
    error = _speed_error_mps(estimate)
    return float(error[-50:].mean() - error[np.abs(estimate.track.time_s - 10.0) < 0.5].mean())


def _speed_error_mps(estimate: Estimate) -> Array:
    assert estimate.truth is not None  # simulated
    column = estimate.track.states.index("speed_x_mps")
    return np.asarray(estimate.track.state("speed_x_mps") - estimate.truth[:, column])


# -- 5.2.3 and 6.1.1: frames of the camera, dead band of the steering ----------------------------------------------

YAW_DEG, SPEED_MPS = 30.0, 1.0
"""True motion: a turn between two samples, at a constant forward speed."""
PRINTED_ALIGNMENT = Rotation.from_euler("XZ", [-90.0, -90.0], degrees=True)
"""q_align of (5.5)."""


def camera_frames(trial: Trial) -> Finding:
    """Compare yaw and speed from the stream of the camera with those of the printed equations."""
    camera = load_robot(ROBOT).camera
    nothing, yaw_rad = np.zeros(2), np.radians([0.0, YAW_DEG])
    angles, speed = np.column_stack([nothing, nothing, yaw_rad]), np.array([[SPEED_MPS, 0.0, 0.0]] * 2)
    stream = odometry_stream(np.array([0.0, 1.0]), np.zeros((2, 2)), angles, speed, camera, yaw_0=0.0)
    motion = body_motion(stream, camera)
    sensor = Rotation.from_quat([stream.channel(f"quaternion_{axis}_ratio")[1] for axis in "xyzw"])
    printed = (PRINTED_ALIGNMENT * sensor).as_euler("ZYX", degrees=True)
    yaw, pitch, roll = (float(round(angle)) for angle in printed)
    ahead = float(PRINTED_ALIGNMENT.inv().apply(to_camera(np.array([SPEED_MPS, 0.0, 0.0])))[0])
    return Finding(
        {
            "yaw": Numbers(
                float(np.degrees(motion.yaw_rad[1])),
                beside={"pitch by (5.6)": pitch, "roll by (5.6)": roll},
                values={"yaw": yaw, "pitch": pitch, "roll": roll, "right": YAW_DEG},
            ),
            "forward_speed": Numbers(
                float(motion.speed_mps[1, 0]), values={"by_printed": ahead, "right": SPEED_MPS}
            ),
        }
    )


def dead_band(trial: Trial) -> Finding:
    """Return the variance (2 d)^2 / 12 of a uniform distribution over the dead band +-d."""
    return Finding({"variance": Numbers((2 * load_robot(ROBOT).steering.dead_band_rad) ** 2 / 12)})


# -- 6.2: innovations of the thesis' filter -------------------------------------------------------------------------


def innovations(trial: Trial) -> Finding:
    """Compare the variances of the innovations with the thesis' figures, with R, and with those expected."""
    runs = seeded_runs(trial, "tiles", "complex", duration_s=40.0 if trial.quick else None)
    estimates = by_filter(runs, "vio12")
    model = estimates[0].model
    variance_r = dict(zip(model.rows, model.measurement_variance.tolist(), strict=True))
    found, over_r = [], {}
    for claim in trial.each["variance"]:
        row = claim["row"]
        beside = {
            "in straight stretches": float(np.mean(_variances(estimates, row, straight_only=True))),
            "R of the thesis": variance_r[row],
        }
        if row == "gyro_z_radps":
            camera = float(np.mean(_variances(estimates, "camera_yaw_rate_radps")))
            beside = {"of the camera's yaw rate": camera} | beside
        found.append(Numbers.over(_variances(estimates, row), beside))
        over_r[claim["name"]] = found[-1].simulated / variance_r[row]
    nis, nis_15 = (
        [summarize(one).nis["camera_speed"] for one in each]
        for each in (estimates, by_filter(runs, "vio15", "physical"))
    )
    q_mps = float(np.sqrt(model.process_variance[3, 3] * THESIS_SAMPLE_TIME_S))
    numbers = {
        "variance": found,
        "largest_over_r": Numbers(max(over_r.values()), beside=over_r),
        "consistency": Numbers.over(
            nis, {"vio15": float(np.mean(nis_15))}, q=q_mps, step=THESIS_SAMPLE_TIME_S
        ),
    }
    rows = [(claim["row"], f"{claim['name']} {claim['unit'][:-1]}") for claim in trial.each["variance"]]
    shown = {
        "motion": _motion_figure(estimates[0]),
        "innovations": _innovation_figure(estimates[0], rows, variance_r),
    }
    return Finding(numbers, shown)


def _variances(estimates: Sequence[Estimate], row: str, straight_only: bool = False) -> list[float]:
    values = [one.innovations[row][0][_is_straight(one) | (not straight_only)] for one in estimates]
    return [float(np.nanvar(value)) for value in values]


def _is_straight(estimate: Estimate) -> Array:
    """Return where (n,) the robot was commanded to drive straight ahead or back."""
    commands = estimate.run.streams["commands"]
    ahead, sideways, turning = (
        np.abs(np.interp(estimate.track.time_s, commands.time_s, commands.channel(name)))
        for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    )
    return np.asarray((ahead > STEADY_SPEED_MPS) & (sideways < MIN_SPEED_MPS) & (turning < MIN_SPEED_MPS))


def _motion_figure(estimate: Estimate) -> Figure:
    track, table, robot = estimate.track, estimate.table, estimate.robot
    rates, steer = (
        table.columns([name.format(wheel) for wheel in robot.wheels])
        for name in ("wheel_{}_radps", "steer_{}_rad")
    )
    twist = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)[0]
    panels = []
    for k, state in enumerate(("speed_x_mps", "speed_y_mps", "yaw_rate_radps")):
        mean, std = track.state(state), track.std(state)
        panels.append(
            Panel(
                (
                    Line("encoders, forward kinematics", table.time_s, twist[:, k], 1),
                    Line("camera, at its place", table.time_s, table.columns([f"camera_{state}"])[:, 0], 6),
                    Band("± 2 std", track.time_s, mean - 2 * std, mean + 2 * std, 0),
                    Line("vio12", track.time_s, mean, 0),
                ),
                ("forward speed [m/s]", "sideways speed [m/s]", "yaw rate [rad/s]")[k],
            )
        )
    return Figure("Motion by the thesis' filter, tiles", tuple(panels), x_label="time [s]")


def _innovation_figure(
    estimate: Estimate, rows: Sequence[tuple[str, str]], variance_r: Mapping[str, float]
) -> Figure:
    panels = []
    for row, label in rows:
        value, _ = estimate.innovations[row]
        time_s, reach = estimate.track.time_s, np.full(len(value), 2 * np.sqrt(variance_r[row]))
        marks = (Band("± 2 std by R", time_s, -reach, reach, 6), Line("innovation", time_s, value, 0))
        panels.append(Panel(marks, title=f"{label}, variance {np.nanvar(value):.1e}"))
    return Figure("Innovations of the thesis' filter, tiles", tuple(panels), x_label="time [s]")


# -- 7.2.2: negative slip in a start, when the encoders lag the camera ----------------------------------------------


def start_transients(trial: Trial) -> Finding:
    """Estimate slip in a start with three kinds of smoothing of the camera.

    Slip in a start is evaluated above 0.2 m/s, and for comparison above the thesis' own dead band of 0.05 m/s:
    between the two, an error of 0.01 m/s is up to 0.2 of slip.
    """
    robot, runs = load_robot(ROBOT), seeded_runs(trial, "tiles", "straight", duration_s=6.0)
    lag_s = robot.sensors.encoder_time_constant_s
    unsmoothed = robot.with_parts(camera=replace(robot.camera, time_constant_s=0.0))  # gets all of the lag
    curves = {
        "raw": [_slip_with(run, robot, 0.0) for run in runs],
        "printed": [_slip_with(run, robot, THESIS_EMA_ALPHA) for run in runs],
        "matched": [_slip_with(run, unsmoothed) for run in runs],
        "truth": [lagged_truth(run, robot) for run in runs],
    }
    dips = {form: [extreme_in_start(curve, np.min) for curve in row] for form, row in curves.items()}
    numbers = {}
    for form in ("raw", "printed", "matched"):
        early = [extreme_in_start(curve, np.min, MIN_SPEED_MPS) for curve in curves[form]]
        beside = {"true": float(np.mean(dips["truth"])), "from 0.05 m/s on": float(np.mean(early))}
        numbers[form] = Numbers.over(dips[form], beside, lag_ms=1000 * lag_s, alpha=THESIS_EMA_ALPHA)
    labels = ("not smoothed", f"camera with alpha = {THESIS_EMA_ALPHA:g}", "one time constant", "true")
    lines = []
    for label, (curve, *_) in zip(labels, curves.values(), strict=True):
        shown = (curve.time_s > START_S[0]) & (curve.time_s < START_S[1])
        lines.append(Line(label, curve.time_s[shown], curve.slip_ratio[shown].mean(axis=1)))
    return Finding(numbers, {"dip": time_figure("Slip in a start at 1 m/s² on tiles", lines)})


def _slip_with(run: RunLog, robot: Robot, ema_alpha: float | None = None) -> Curve:
    """Return the slip by the thesis' filter, without gating, from signals with this smoothing, or the encoders' lag."""
    table = measurement_table(run, robot, ema_alpha=ema_alpha)
    model = make_filter("vio12", robot, thesis=True)
    ungated = FilterSettings(gate_probability=1.0)
    track = run_filter(model, table.time_s, table.columns(model.rows), ungated)
    slip = wheel_slip(track, table.at(track.time_s), robot)
    return Curve(track.time_s, slip.mean, track.state("speed_x_mps"))


# -- 7.2.3 and 6.1: slip in a start and in steady driving, its bias, and the camera lost ----------------------------


def slip_on_terrains(trial: Trial) -> Finding:
    """Estimate slip from rest at 1 m/s^2 to 1 m/s, straight ahead, on three terrains."""
    robot = load_robot(ROBOT)
    steady, peak, peaks, shown = [], [], [], {}
    for claim in trial.each["steady"]:
        runs = seeded_runs(trial, claim["terrain"], "straight")
        thesis, vio15 = estimate_with_both_filters(runs)
        curves = {
            name: [_curve_of(one) for one in row] for name, row in (("thesis", thesis), ("vio15", vio15))
        }
        curves["true"] = [lagged_truth(run, robot) for run in runs]
        means = {"true": float(np.mean(steady_truths(thesis))), "vio15": float(np.mean(steady_slips(vio15)))}
        steady.append(Numbers.over(steady_slips(thesis), means))
        largest = {name: [extreme_in_start(curve, np.max) for curve in row] for name, row in curves.items()}
        early = [extreme_in_start(curve, np.max, MIN_SPEED_MPS) for curve in curves["thesis"]]
        beside = {name: float(np.mean(largest[name])) for name in ("true", "vio15")}
        peak.append(Numbers.over(largest["thesis"], beside | {"from 0.05 m/s on": float(np.mean(early))}))
        peaks.append(largest["thesis"])
        shown[f"slip_{claim['terrain']}"] = _slip_figure(thesis[0], claim["name"])
    in_order = float(np.mean([list(run) == sorted(run) for run in zip(*peaks, strict=True)]))
    return Finding({"steady": steady, "peak": peak, "order_of_peaks": Numbers(in_order)}, shown)


def _curve_of(estimate: Estimate) -> Curve:
    track = estimate.track
    return Curve(track.time_s, estimate.slip.mean, track.state("speed_x_mps"))


def _slip_figure(estimate: Estimate, terrain: str) -> Figure:
    """Draw the two speeds that slip is made of, and the slip of each wheel with its uncertainty."""
    track, table, true = estimate.track, estimate.table, true_slip(estimate)
    speeds, slips = [Line("speed over ground", track.time_s, track.state("speed_x_mps"), 6)], []
    for i, wheel in enumerate(estimate.robot.wheels):
        rate = table.columns([f"wheel_{wheel}_radps"])[:, 0]
        speeds.append(Line(f"wheel {wheel}", table.time_s, rate * estimate.robot.wheel_radius_m, i))
        mean, std = estimate.slip.mean[:, i], estimate.slip.std[:, i]
        slips += [
            Band(f"± 2 std, {wheel}", track.time_s, mean - 2 * std, mean + 2 * std, i),
            Line(f"wheel {wheel}", track.time_s, mean, i),
            Line(f"true, {wheel}", track.time_s, true[:, i], 6, dashed=True),
        ]
    panels = (Panel(tuple(speeds), "speed [m/s]"), Panel(tuple(slips), "slip ratio", y_range=(-0.05, 0.6)))
    return Figure(f"Slip on {terrain} by the thesis' filter", panels, x_label="time [s]")


def slip_bias(trial: Trial) -> Finding:
    """Estimate slip on grass, straight ahead and in an arc, from zero-slip wheel rows and the camera."""
    found = []
    for claim in trial.each["bias"]:
        thesis, vio15 = estimate_with_both_filters(seeded_runs(trial, "grass", claim["scenario"]))
        true, slip = Numbers.over(steady_truths(thesis)), Numbers.over(steady_slips(thesis))
        found.append(
            slip._replace(
                beside={"true": true.simulated, "vio15": float(np.mean(steady_slips(vio15)))},
                values={"true": true.spread, "low_by": 100 * (1.0 - slip.simulated / true.simulated)},
            )
        )
    return Finding({"bias": found})


LOST_S = (10.0, 13.0)
"""When the camera measures nothing."""


def camera_lost(trial: Trial) -> Finding:
    """Estimate slip on grass with the camera lost for 3 s."""
    faults = Faults(camera_lost_s=(LOST_S,), by_chance=False)
    runs = seeded_runs(trial, "grass", "straight", duration_s=16.0, faults=faults)
    thesis, vio15 = estimate_with_both_filters(runs)

    def at_the_end(estimates: Sequence[Estimate], slip: Callable[[Estimate], Array]) -> list[float]:
        return [mean_between(slip(one), one, LOST_S[1] - 0.5, LOST_S[1]) for one in estimates]

    true = float(np.mean(at_the_end(vio15, true_slip)))
    std = float(np.mean(at_the_end(vio15, lambda one: one.slip.std)))
    error = at_the_end(vio15, lambda one: one.slip.mean - true_slip(one))
    numbers = {
        "thesis": Numbers.over(at_the_end(thesis, lambda one: one.blind.mean), {"true": true}),
        "vio15": Numbers.over(
            at_the_end(vio15, lambda one: one.slip.mean),
            {"true": true, "standard deviation by the filter": std},
            worst=max(map(abs, error)),
        ),
    }
    one = vio15[0]
    time_s = one.track.time_s
    shown = (time_s > LOST_S[0] - 3.0) & (time_s < LOST_S[1] + 3.0)
    estimated, std_15 = one.slip.mean.mean(axis=1)[shown], one.slip.std.mean(axis=1)[shown]
    at = time_s[shown]
    marks = [
        Band("± 2 std", at, estimated - 2 * std_15, estimated + 2 * std_15, 0),
        Line("vio15", at, estimated, 0),
        Line("thesis' filter", at, thesis[0].blind.mean.mean(axis=1)[shown], 5),
        Line("true", at, true_slip(one).mean(axis=1)[shown], 6),
    ]
    return Finding(numbers, {"lost": time_figure("Slip on grass with the camera lost for 3 s", marks)})


# -- 8.1: recognition of eight terrains from 208 windows of 2 s -----------------------------------------------------
# The thesis states a support vector machine, 208 labelled windows of 2 s that do not overlap, steady motion,
# cross-validation and eight classes.  It names neither the classes nor the folds nor the features.

N_WINDOWS, N_CLASSES, N_FOLDS = 208, 8, 5
TOTAL_S = 150.0
"""Of all runs of a terrain: leaves 40 windows of steady motion and more, of which 26 are taken."""


def classify_terrain(trial: Trial) -> Finding:
    """Cross-validate on windows of all soils, dealt at random and with whole runs held out."""
    robot, n_runs, seed = load_robot(ROBOT), FEW_RUNS if trial.quick else RUNS, trial.seed
    windows = thesis_windows(robot, seed, n_runs)
    features = np.asarray(FeatureExtractor(tuple(SIGNAL_SETS), ()).fit_transform(windows))
    terrain, run_id = windows.terrain.astype(str), windows.run_id.astype(str)
    classes, true = np.unique(terrain, return_inverse=True)

    def held_out(group: Array, splits: Sequence[tuple[Array, Array]]) -> Array:
        """Return the probabilities (n, k) by classifiers that were not trained on the window."""
        probability = np.zeros((len(true), len(classes)))
        for train, test in splits:
            fitted = clone(GroupedSVC(CANDIDATES, gap=1, seed=0)).fit(
                features[train], terrain[train], groups=group[train]
            )
            probability[np.ix_(test, np.searchsorted(classes, fitted.classes_))] = fitted.predict_proba(
                features[test]
            )
        return probability

    deal = list(StratifiedKFold(N_FOLDS, shuffle=True, random_state=seed).split(features, terrain))
    at_random = held_out(np.arange(len(run_id)).astype(str), deal)
    by_run = held_out(run_id, list(split_runs(terrain, run_id, n_runs, np.random.default_rng(seed))))
    correct = by_run.argmax(axis=1) == true
    recall = {str(name): float(correct[true == i].mean()) for i, name in enumerate(classes)}
    weakest, accuracy = min(recall, key=lambda name: recall[name]), float(correct.mean())
    low, high = accuracy_interval(correct, run_id, true, np.random.default_rng(seed))
    geometry = robot.wheel_radius_m, robot.body.tyre_width_m, robot.body.contact_length_m
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    responses = {name: response_of(load_soil(name), load_n, *geometry) for name in soil_names()}
    difficulty = {name: each.difficulty_ratio for name, each in responses.items()}
    return Finding(
        {
            "at_random": Numbers(
                float((at_random.argmax(axis=1) == true).mean()), values={"n_windows": len(windows)}
            ),
            "by_run": Numbers(accuracy, (min(low, accuracy), max(high, accuracy))),
            "weakest": Numbers(recall[weakest], beside=recall, values={"weakest": weakest}),
            "level": _level(by_run, true, np.array([int(responses[name].level) for name in classes])),
            "difficulty": Numbers(
                difficulty["dry_sand"],
                beside=difficulty,
                values={"order": sorted(difficulty, key=lambda name: difficulty[name])},
            ),
        }
    )


def thesis_windows(robot: Robot, seed: int, n_runs: int) -> Windows:
    """Return 26 steady windows of 2 s of each soil, from runs whose soil, load and slope are drawn.

    What the thesis' filter estimates is part of the windows.
    """
    parts = []
    for name in soil_names():
        runs = [
            simulate_run(robot, name, "survey", seed, number, duration_s=TOTAL_S / n_runs, vary=True)
            for number in range(1, n_runs + 1)
        ]
        found = cut_windows([enriched(one) for one in by_filter(runs, "vio12")])
        in_run = np.concatenate([np.arange(np.sum(found.windows.run_id == run.run_id)) for run in runs])
        parts.append(found.windows[np.sort(np.argsort(in_run, kind="stable")[: N_WINDOWS // N_CLASSES])])
    return join_windows(parts)


def _level(probability: Array, true: Array, levels: Array) -> Numbers:
    """Return how well the stiffness levels of soils are recognised."""
    cost, predicted = cost_matrix(levels.tolist()), probability.argmax(axis=1)
    apart = np.abs(levels[predicted] - levels[true]) == StiffnessLevel.HARD - StiffnessLevel.SOFT
    beside = {
        "soft and hard confused": float(apart.mean()),
        "cost a window": float(cost[true, predicted].mean()),
        "cost a window, terrain of least expected cost": float(
            cost[true, least_cost_class(probability, cost)].mean()
        ),
    }
    return Numbers(float(np.mean(levels[predicted] == levels[true])), beside=beside)


# -- 8.3.2: the traction controller in the cases of table 8.1 -------------------------------------------------------
# The cases have a wheel radius of 1 m and a proportional gain of 1; the speed over ground is constant.

TARGETS = (0.1, -0.15, 0.0)
"""Slip targets of table 8.1: traction, braking, steady (no case of the table)."""
ACCEL_MPS2 = 1.0
"""In the direction of motion or against it; table 8.1 gives only the sign."""
N_STEPS = 1000
"""Number of steps after which an undamped oscillation is measured."""
N_EARLY = 20
"""Number of steps after which repeated halving leaves 1e-6 of the error; beyond it rounding is visible."""
GAIN = 0.5
"""Gain of the normalised form."""


def traction_control(trial: Trial) -> Finding:
    """Apply one step of the controller in the eight cases, and then the same step repeatedly."""
    cases = trial.each["single_step"]
    single, remaining, steps = [], [], {}
    for case in cases:
        (error,), (rate,) = _iterate(case, printed_step, 1.0, 1)
        desired = float(np.sign(case["v"])) * TARGETS[int(case["braking"])]
        found = {"slip": desired - error, "desired": desired, "error": error}
        digits = [round(value, 3) for value in (*found.values(), rate)]
        single.append(Numbers(rate, beside=found, values={"three_digits": digits}))
        if case["braking"]:
            left = _iterate(case, printed_step, 1.0, N_STEPS)[0]
            remaining.append(abs(left[-1] / left[0]))
        errors = np.array(_iterate(case, normalised_step, GAIN, N_EARLY)[0])
        steps[case["case"]] = errors[1:] / errors[:-1]
    braking, traction = (
        np.concatenate([steps[case["case"]] for case in cases if case["braking"] is kind])
        for kind in (True, False)
    )
    beside = {"braking": float(braking.max()), "traction, largest": float(traction.max())}
    return Finding(
        {
            "single_step": single,
            "oscillation": Numbers.over(remaining, n_steps=N_STEPS),
            "contraction": Numbers.over(np.concatenate([braking, traction]).tolist(), beside, gain=GAIN),
        }
    )


TableStep = Callable[[WheelPid, float, float, float, float], tuple[float, float, WheelPid]]
"""From state, gain, rate, speed and acceleration of a wheel to its correction, its desired slip and the next state."""


def printed_step(
    state: WheelPid, gain: float, rate: float, speed: float, accel: float
) -> tuple[float, float, WheelPid]:
    """Return the printed step: the direction is sgn(v), and the PID on the error, a ratio, is added as rad/s.

    Examples
    --------
    >>> [round(value, 3) for value in printed_step(WheelPid(), 1.0, 0.7, 0.6, 1.0)[:2]]  # case 1A
    [-0.043, 0.1]
    """
    slip, _ = conditioned_slip(rate, speed, LOW_SPEED_MPS)
    drive_state = power_state(accel, speed, POWER_THRESHOLD_WPKG)
    desired = desired_slip(drive_state, float(np.sign(speed)), TARGETS)
    added, integral, _ = pid_step(Gains(gain, 0.0, limit=10.0), state.integral, desired - slip, 0.02)
    return added, desired, WheelPid(integral)


def normalised_step(
    state: WheelPid, gain: float, rate: float, speed: float, accel: float
) -> tuple[float, float, WheelPid]:
    """Return what the controller of this package does, by which an error is worth the same at any speed."""
    gains = Gains(gain, 0.0, limit=10.0)
    step, after = wheel_step(gains, 1.0, state, rate, rate, speed, accel, abs(speed), TARGETS, 0.02)
    return step.correction_radps, step.desired_ratio, after


def _iterate(
    case: Mapping[str, Any], step: TableStep, gain: float, n_steps: int
) -> tuple[list[float], list[float]]:
    """Return slip error and commanded rate (n,) of steps, each from the rate of the previous one."""
    state, speed, rate = WheelPid(), float(case["v"]), float(case["w"])
    accel = math.copysign(ACCEL_MPS2, -speed if case["braking"] else speed)
    errors, rates = [], []
    for _ in range(n_steps):
        slip = (rate - speed) / max(abs(rate), abs(speed))
        added, desired, state = step(state, gain, rate, speed, accel)
        rate += added
        errors.append(desired - slip)
        rates.append(rate)
    return errors, rates
