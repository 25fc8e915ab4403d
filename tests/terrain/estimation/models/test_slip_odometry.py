"""Odometry by a slip model: the laws, the integral, uncertainty, and the model identified while driving."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.calibration.odometry import odometry_rows
from terrain.errors import ConfigError
from terrain.estimation.models.observer import ObserverStatus, observe
from terrain.estimation.models.slip_model import (
    N_MODEL,
    N_PARAMETERS,
    PARAMETERS,
    SlipModel,
    body_velocity,
    model_of,
    next_displacement,
    slip_imbalance,
    turn_weight,
    unknown_ground,
)
from terrain.estimation.models.slip_odometry import (
    BLIND_MPS,
    ROWS,
    OdometrySettings,
    SlipOdometry,
    plain_odometry,
)
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import QUIET, PrescribedSlip, Slope
from terrain.simulation.run import simulate

ROBOT = load_robot("patako")
D = ROBOT.half_track_m
MODEL = SlipModel(
    *(0.8, 0.05, 0.4, 0.3, 0.5),
    angle=np.array([0.05, 0.3, 0.2, -0.1, -1.2, -0.4, 0.05, 0.1]),
    track_ratio=1.5,
    turn_side_m=0.2,
    turn_shift_m=0.15,
)
THETA = np.concatenate([MODEL.vector, np.zeros(N_PARAMETERS - N_MODEL)])
NOISELESS = OdometrySettings(gyro_noise_radps=0.0, gyro_bias_std_radps=0.0, encoder_noise_mps=0.0)
EXPONENTS = [0.0, 0.3, 0.847, 1.0, 1.3, 2.0]


def velocity(left, right, w, roll=0.1, pitch=-0.05, displacement=0.3, theta=THETA):
    return np.array(body_velocity(theta, D, (left, right), w, (roll, pitch), displacement))


def drive(time_s):
    """Rows of a drive from straight into a spin and back, on a slope that tilts."""
    turn = 0.09 * np.sin(0.5 * time_s) ** 3
    left, right = 0.05 - turn, 0.05 + turn
    w = 0.6 * (right - left) / (2 * D)
    return np.stack([left, right, w, 0.1 * np.cos(0.3 * time_s), -0.1 * np.sin(0.3 * time_s)], axis=-1)


def final(odometry, time_s, rows):
    return observe(odometry, time_s, rows).mean[-1]


# -- the laws -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", EXPONENTS)
def test_endos_law_is_27_and_7_and_regular_where_a_track_stops(n):
    rng = np.random.default_rng(0)
    for _ in range(50):
        (left, right), lost = rng.uniform(0.01, 0.3, 2) * rng.choice([-1, 1], 2), rng.normal()
        kappa = slip_imbalance(left, right, n)
        alpha_l, alpha_r = -0.5 * lost * (1 - kappa) / left, 0.5 * lost * (1 + kappa) / right
        assert alpha_l == pytest.approx(-np.sign(right * left) * abs(right / left) ** n * alpha_r)
    for left, right in [(0.0, 0.1), (0.1, 0.0), (0.1, 0.1), (-0.1, 0.1), (-0.02, 0.12)]:
        a, b = (abs(right), abs(left)) if n <= 1 else (abs(left), abs(right))
        a, b = np.power([a, b], abs(1 - n))  # 0^0 is 1: the form of the erratum
        assert slip_imbalance(left, right, n) == pytest.approx((a - b) / (a + b), abs=1e-12)
    assert slip_imbalance(0.0, 0.0, n) == slip_imbalance(-0.1, 0.1, n) == 0.0


def test_straight_motion_is_the_straight_law_and_a_turn_the_regression_and_the_drift():
    for sign in (1.0, -1.0):  # gravity sets the sign in reverse
        v_x, v_y = velocity(0.1 * sign, 0.1 * sign, 0.0, roll=0.2, pitch=-0.1)
        assert v_x == pytest.approx(0.1 * (sign * (1 - 0.05) - 0.4 * 0.1))
        assert v_y == pytest.approx(-abs(v_x) * 0.5 * 0.2)
    x = np.array([1, 0.05, 0.14 / (2 * D), 0.25, 0.1, -0.05, 0.3, np.arccos(np.cos(0.1) * np.cos(0.05))])
    v_x, v_y = velocity(-0.02, 0.12, 0.25)
    drift = -0.2 * 0.25 * 0.1 + 0.15 * 0.25 * 0.05
    assert v_y == pytest.approx(v_x * math.tan(float(x @ MODEL.angle)) + drift)
    right = velocity(0.12, -0.02, -0.25, roll=-0.1, displacement=-0.3)  # mirror images
    assert right == pytest.approx([v_x, -v_y])
    assert velocity(0.02, -0.12, -0.25, pitch=0.05, displacement=-0.3) == pytest.approx([-v_x, v_y])


S = np.linspace(-1, 1, 2001)
SWEEPS = {
    "straight to spin": (0.05 - 0.1 * np.abs(S), 0.05 + 0.1 * np.abs(S)),
    "left track stops": (0.05 * S, np.full_like(S, 0.1)),
    "spin to reverse": (-0.1 + 0.05 * S, 0.1 + 0.05 * S),
    "forward to reverse": (0.1 * S, 0.08 * S),
    "left turn to right turn": (0.1 + 0.03 * S, 0.1 - 0.03 * S),
}


@pytest.mark.parametrize("n", [0.3, 1.0, 1.5])
@pytest.mark.parametrize("sweep", SWEEPS)
def test_the_velocity_has_no_jump(n, sweep):
    left, right = SWEEPS[sweep]
    theta, w = np.array([n, *THETA[1:]]), 0.6 * (right - left) / (2 * D)
    rows = [velocity(*row, displacement=0.0, theta=theta) for row in zip(left, right, w, strict=True)]
    coarse, fine = (np.abs(np.diff(rows[::every], axis=0)).max() for every in (4, 1))
    assert fine < min(0.72 * coarse, 0.01)  # it falls with the step: |v|^(1/2) halves over a quarter of it


def test_weight_and_displacement_of_a_turn_and_what_a_model_cannot_be():
    assert turn_weight(0.0, 0.0) == turn_weight(0.05, 0.05) == 0.0
    assert turn_weight(0.0, 0.1) == turn_weight(-0.1, 0.1) == 1.0
    turned = 0.0
    for speeds, rate, expected in (((-0.02, 0.12), 0.5, 0.5), ((0.6, 0.6), 0.0, 0.5 * math.exp(-1))):
        for _ in range(100):
            turned = next_displacement(turned, speeds, rate, 0.6, 0.01)
        assert turned == pytest.approx(expected)
    for wrong, message in (
        ({"turning_exponent": math.nan}, "finite"),
        ({"angle": np.zeros(3)}, "shape"),
        ({"track_ratio": 0.0}, "above zero"),
    ):
        with pytest.raises(ConfigError, match=message):
            SlipModel(**wrong)
    with pytest.raises(ConfigError, match="turning_exponent has no standard deviation"):
        SlipOdometry(ROBOT, SlipModel(), name="slip-learning")


# -- odometry -------------------------------------------------------------------------------------------------------


def test_the_pose_is_the_integral_of_5_to_7():
    model = replace(MODEL, angle=np.where(np.arange(8) == 6, 0.0, MODEL.angle))  # without memory of the turn
    theta = np.concatenate([model.vector, np.zeros(N_PARAMETERS - N_MODEL)])

    def rate(t, pose):
        left, right, w, roll, pitch = drive(t)
        v_x, v_y = velocity(left, right, w, roll, pitch, 0.0, theta)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return [v_x * cos - v_y * sin, v_x * sin + v_y * cos, w]

    expected, errors = solve_ivp(rate, (0, 10), [0, 0, 0], rtol=1e-9, atol=1e-12).y[:, -1], []
    for n in (500, 1000):
        time_s = np.linspace(0, 10, n + 1)
        middle = np.concatenate([time_s[:1], 0.5 * (time_s[1:] + time_s[:-1])])
        errors.append(np.abs(final(SlipOdometry(ROBOT, model), time_s, drive(middle))[:3] - expected).max())
    assert errors[1] < min(2e-5, 0.3 * errors[0])  # of second order
    row, still = np.array([-0.02, 0.12, 0.4, 0.0, 0.0]), replace(MODEL, angle=np.zeros(8))
    once, many = (
        final(SlipOdometry(ROBOT, still), np.linspace(0, 1, n), np.tile(row, (n, 1))) for n in (2, 1001)
    )
    assert once[:3] == pytest.approx(many[:3], abs=1e-12)  # a steady turn is exact in one step


@pytest.mark.parametrize("slope", [Slope(), Slope(0.15, 0.3)])
def test_given_slip_is_followed_to_the_millimetre(slope):
    given, belts = PrescribedSlip(1.0, 1.0, 0.1, 0.3, 0.4, 0.35, 0.8), np.tile([0.08, 0.1], (700, 1))
    belts[300:] = (0.1, 0.1)
    run = simulate(ROBOT, belts, given, 0, slope=slope, sensors=QUIET)
    truth = run.streams["truth"]
    own = [truth.channel(name)[::2][:-1] for name in ROWS[2:]]
    model = SlipModel(0.8, 0.1, 0.3, 0.0, 0.4, angle=np.array([0, 0, 0, 0, -0.4, 0, 0, 0]))
    track = observe(SlipOdometry(ROBOT, model), np.arange(699) / 50, np.stack([*belts[:-1].T, *own], axis=1))
    pose = run.streams["pose"].values[::2][:699]
    assert np.hypot(*(track.mean[:, :2] - pose[:, :2]).T).max() < 0.002
    for k, name in enumerate(track.slips[:2]):
        assert track.slip[50:, k] == pytest.approx(truth.channel(name)[::2][50:699], abs=0.01)


def test_the_covariance_is_that_of_many_models_and_holds_the_noise_of_gyro_and_encoders():
    rng, n_drawn = np.random.default_rng(1), 60
    std = np.array([0.02, 0.01, 0.03, 0.02, 0.04, 0.02, 0.02, *np.full(8, 0.02), 0.05])
    model, time_s = replace(MODEL, covariance=np.diag(std**2)), np.arange(0, 8, 0.1)
    rows = drive(time_s)
    stated = observe(SlipOdometry(ROBOT, model, NOISELESS), time_s, rows).std[-1, :3]
    models = (SlipOdometry(ROBOT, model_of(rng.normal(MODEL.vector, std))) for _ in range(n_drawn))
    spread = np.std([final(odometry, time_s, rows)[:2] for odometry in models], axis=0)
    assert stated[:2] == pytest.approx(spread, rel=4 / np.sqrt(2 * n_drawn))
    assert stated[2] == pytest.approx(0.0, abs=1e-4)

    settings = OdometrySettings(gyro_noise_radps=0.01, gyro_bias_std_radps=0.002, encoder_noise_mps=0.01)
    make, rows = (
        partial(SlipOdometry, ROBOT, SlipModel(), settings),
        np.tile([0.2, 0.2, 0.0, 0.0, 0.0], (80, 1)),
    )
    stated, ends = observe(make(), time_s, rows).std[-1, :3], []
    for _ in range(n_drawn):
        noisy = rows.copy()
        noisy[:, :2] += 0.01 * rng.standard_normal((len(rows), 2))
        noisy[:, 2] += 0.01 * rng.standard_normal(len(rows)) + 0.002 * rng.standard_normal()
        ends.append(final(make(), time_s, noisy)[:3])
    assert stated == pytest.approx(np.std(ends, axis=0), rel=4 / np.sqrt(2 * n_drawn))


def test_which_yaw_rate_each_odometry_takes():
    time_s, by_track = np.arange(0, 2, 0.02), 0.06 / (2 * D)
    for gyro, by_gyrodometry in ((by_track + 0.005, by_track), (0.6 * by_track, 0.6 * by_track)):
        rows = np.tile([0.02, 0.08, gyro, 0.0, 0.0], (len(time_s), 1))
        track = final(plain_odometry("gyrodometry", ROBOT), time_s, rows)
        assert track[2:5] == pytest.approx([by_gyrodometry * time_s[-1], 0.05, 0.0])
        assert final(plain_odometry("encoder-odometry", ROBOT), time_s, rows)[2] == pytest.approx(
            by_track * time_s[-1]
        )
    silent = np.tile([0.02, 0.08, np.nan, 0.0, 0.0], (len(time_s), 1))
    wide = SlipModel(track_ratio=1.5)
    for odometry in (SlipOdometry(ROBOT, MODEL), plain_odometry("encoder-odometry", ROBOT, wide)):
        assert final(odometry, time_s, silent)[2] == pytest.approx(by_track / 1.5 * time_s[-1])


@pytest.mark.parametrize(
    ("changes", "dt_s", "status"),
    [
        ({}, 0.02, "OK"),
        ({0: 0.0, 1: 0.0, 2: 0.001}, 0.02, "STANDING"),
        ({0: 0.0, 1: 0.0, 2: 0.5}, 0.02, "PUSHED"),
        ({2: 1e6}, 0.02, "REJECTED"),
        ({3: np.nan}, 0.02, "PREDICTED"),
        ({4: 7.0}, 0.02, "PREDICTED"),
        ({0: np.nan}, 0.02, "BAD_INPUT"),
        ({1: np.inf}, 0.02, "BAD_INPUT"),
        ({}, -0.1, "BAD_INPUT"),
        ({}, np.nan, "BAD_INPUT"),
        ({}, 60.0, "BAD_INPUT"),
    ],
)
def test_statuses(changes, dt_s, status):
    odometry, row = SlipOdometry(ROBOT, MODEL), np.array([0.05, 0.1, 0.1, 0.02, 0.01])
    odometry.step(row, 0.0)
    before = odometry.step(row, 0.02)
    row[list(changes)] = list(changes.values())
    output = odometry.step(row, dt_s)
    assert ObserverStatus(output.status).name == status
    if status in ("STANDING", "PUSHED"):
        assert output.mean[:2] == pytest.approx(before.mean[:2], abs=1e-12)
        assert np.isnan(output.slip).all()
        assert (output.mean[2] > before.mean[2]) == (status == "PUSHED")
    if status == "BAD_INPUT":
        assert (output.mean == before.mean).all()


@pytest.mark.parametrize("name", ["slip-odometry", "slip-learning"])
@pytest.mark.parametrize("n_steps", [1, 100])
def test_where_tracks_are_not_measured_the_pose_is_less_certain_by_what_was_driven(name, n_steps):
    odometry = SlipOdometry(ROBOT, unknown_ground(), name=name)
    moving = np.array([0.5, 0.7, 0.3, *np.zeros(len(odometry.rows) - 3)])
    before = odometry.step(moving, 0.0)
    blind = np.where(np.arange(len(moving)) < 2, np.nan, moving)
    for _ in range(n_steps):
        output = odometry.step(blind, 3.0 / n_steps)
    assert output.std[:2] - before.std[:2] == pytest.approx(3.0 * max(0.7, BLIND_MPS))
    assert output.std[2] == pytest.approx(np.pi)


# -- the model identified while driving -----------------------------------------------------------------------------

HIDDEN = PrescribedSlip(1.0, 1.0, 0.08, 0.5, 0.6, 0.35, 0.7)
TRUE = {
    "turning_exponent": 0.7,
    "compaction_slip_ratio": 0.08,
    "grade_slip_ratio": 0.5,
    "side_slip_ratio": 0.6,
    "angle_roll_rad": -0.6,
}
EXACT = replace(unknown_ground(), slip_std_ratio=0.01, angle_std_rad=0.01)
"""Slip that is given follows its laws; a soil does not, and the default is wider."""


def learning(run, every=1, with_fixes=True):
    """Return the odometry, its track and parameters, of ticks at 10 Hz with a fix, and a heading, every so many."""
    wheels = run.streams["wheels"]
    wheels = Stream(wheels.time_s[::5], wheels.values[::5], wheels.channels)
    time_s, own = odometry_rows(replace(run, streams={**run.streams, "wheels": wheels}), ROBOT)
    rows = np.column_stack([own, np.full((len(own), 3), np.nan)])
    if with_fixes:
        at = np.searchsorted(time_s, run.streams["gnss"].time_s[::every] - 1e-6)
        rows[at, 5:7] = run.streams["gnss"].values[::every, :2]
        rows[at, 7] = run.streams["compass"].values[::every, 0]
    odometry = SlipOdometry(ROBOT, EXACT, name="slip-learning")
    track = observe(odometry, time_s, rows)
    known = zip(track.mean[-1, 6:], track.std[-1, 6:], strict=True)
    return odometry, track, dict(zip(PARAMETERS, known, strict=True))


def course(laps):
    """Straights and tight turns to both sides."""
    parts = []
    for k in range(laps):
        pair = (0.05, 0.25) if k % 2 == 0 else (0.25, 0.05)
        parts += [np.tile([0.2, 0.2], (250, 1)), np.tile(pair, (300 + 20 * (k % 3), 1))]
    return np.concatenate(parts)


@pytest.mark.parametrize(("seed", "every"), [(0, 1), (2, 20)])
def test_hidden_slip_comes_back_within_its_stated_error(seed, every):
    run = simulate(ROBOT, course(40), HIDDEN, seed, slope=Slope(0.2, 0.7))
    odometry, _, known = learning(run, every)
    for name in (name for name in TRUE if every == 1 or name != "turning_exponent"):  # n needs more
        mean, std = known[name]
        assert abs(mean - TRUE[name]) < 3 * std, (name, mean, std)
    assert known["compaction_slip_ratio"][1] < 0.02
    if every == 1:
        assert known["turning_exponent"][1] < 0.14
        assert known["grade_slip_ratio"][1] < 0.1
        model = odometry.learned_model
        assert model.turning_exponent == known["turning_exponent"][0]
        SlipOdometry(ROBOT, model, name="slip-learning")


def test_what_is_not_excited_stays_unknown():
    _, track, known = learning(simulate(ROBOT, course(6), HIDDEN, 3), with_fixes=False)
    assert (track.status == ObserverStatus.STARTING).all()
    assert [name for name, (mean, _) in known.items() if np.isfinite(mean)] == ["track_ratio"]
    assert known["track_ratio"][0] == pytest.approx(1 / (0.65 * 0.92), abs=0.1)
    _, _, known = learning(simulate(ROBOT, np.tile([0.2, 0.2], (1500, 1)), HIDDEN, 4))
    assert abs(known["compaction_slip_ratio"][0] - 0.08) < 3 * known["compaction_slip_ratio"][1]
    for name in ("turning_exponent", "grade_slip_ratio", "side_slip_ratio", "angle_roll_rad", "track_ratio"):
        assert np.isnan(known[name][0])
