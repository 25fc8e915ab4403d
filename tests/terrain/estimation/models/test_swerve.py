import numpy as np
import pytest
from model_draws import sample_from_model
from scipy.stats import chi2

from terrain.errors import ConfigError
from terrain.estimation.consistency import nees
from terrain.estimation.filter import FilterSettings, run_filter
from terrain.estimation.models.swerve import FILTERS, THESIS_SAMPLE_TIME_S, make_filter
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
DT_S = 0.02
SLIP = 0.125
ALL_BELIEVED = FilterSettings(gate_probability=1.0)


def drive(model, yaw_rate_radps=0.0, duration_s=20.0, seed=0, noise=1.0):
    """Start to 1 m/s within 2 s, straight or in a circle; every wheel rolls and slips by SLIP.

    Returns time_s, z in the model's rows, and the true speeds of the wheels over ground (n, 3).
    """
    time_s = np.arange(0, duration_s, DT_S)
    up = np.minimum(time_s / 2, 1)
    speed, turn = up, yaw_rate_radps * up
    yaw = np.cumsum(turn) * DT_S - turn * DT_S
    x_m, y_m = ROBOT.wheel_positions_m.T
    along = np.hypot(speed[:, None] - turn[:, None] * y_m, turn[:, None] * x_m)
    camera = ROBOT.camera
    columns = {
        **{f"wheel_{i + 1}_radps": along[:, i] / (1 - SLIP) / ROBOT.wheel_radius_m for i in range(3)},
        **{
            f"steer_{i + 1}_rad": np.full_like(
                time_s, np.arctan2(yaw_rate_radps * x_m[i], 1 - yaw_rate_radps * y_m[i])
            )
            for i in range(3)
        },
        "accel_x_mps2": np.where(time_s < 2, 0.5, 0.0),
        "accel_y_mps2": turn * speed,
        "gyro_z_radps": turn,
        "imu_yaw_rad": yaw,
        "camera_speed_x_mps": speed - turn * camera.lever_y_m,
        "camera_speed_y_mps": turn * camera.lever_x_m,
        "camera_yaw_rate_radps": turn,
        "camera_yaw_rad": yaw,
    }
    std = {"wheel": 0.02, "steer": 0.001, "accel": 0.05, "gyro": 0.005, "imu": 0.005, "camera": 0.003}
    rng = np.random.default_rng(seed)
    z = np.column_stack(
        [
            columns[row] + noise * std[row.split("_")[0]] * rng.standard_normal(time_s.size)
            if row in columns
            else np.full_like(time_s, np.nan)  # never at rest
            for row in model.rows
        ]
    )
    return time_s, z, along


def jacobians(model, x, dt=DT_S):
    d, m = len(model.states), len(model.rows)
    x_next, f, z_hat, h = np.zeros(d), np.zeros((d, d)), np.zeros(m), np.zeros((m, d))
    params = np.append(model.params, np.linspace(-2.0, 3.0, len(model.inputs)))
    model.propagate(x, dt, params, x_next, f)
    model.observe(x, model.params.copy(), z_hat, h)
    return x_next, f, z_hat, h


@pytest.mark.parametrize("with_gnss", [False, True])
@pytest.mark.parametrize("name", FILTERS)
def test_jacobians_are_those_of_finite_differences(name, with_gnss):
    model = make_filter(name, ROBOT, with_gnss)
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.normal(0, 1, len(model.states))
        _, f, _, h = jacobians(model, x)
        step = 1e-6
        for j in range(x.size):
            up, down = x.copy(), x.copy()
            up[j] += step
            down[j] -= step
            (next_up, _, z_up, _), (next_down, _, z_down, _) = jacobians(model, up), jacobians(model, down)
            np.testing.assert_allclose(f[:, j], (next_up - next_down) / (2 * step), atol=1e-8)
            np.testing.assert_allclose(h[:, j], (z_up - z_down) / (2 * step), rtol=1e-6, atol=1e-6)


def test_the_noise_of_the_thesis_is_that_of_its_tables_per_second():
    noise = make_filter("vio12", ROBOT, thesis=True)
    np.testing.assert_allclose(
        noise.process_variance.diagonal() * THESIS_SAMPLE_TIME_S,
        [0.5, 0.5, 0.08, 0.08, 0.08, 0.15, 0.12, 0.12, *[0.002] * 4],
    )
    np.testing.assert_allclose(
        noise.measurement_variance[[0, 3, 5, 6, 7, 10, 12, 13]],
        [0.05, 0.001, 0.001, 0.01, 1e-5, 5e-5, 0.001, 5e-4],
    )
    blind = make_filter("encoder12", ROBOT, thesis=True)
    np.testing.assert_allclose(blind.initial_variance.diagonal()[:11], [*[1e-6] * 6, *[1e-3] * 2, *[0.1] * 3])
    np.testing.assert_allclose(blind.measurement_variance, [*[1e-5] * 7, *[7.2e-5] * 3])
    rest = make_filter("vio15", ROBOT, thesis=True).measurement_variance[14:]
    np.testing.assert_array_equal(rest, make_filter("vio15", ROBOT).measurement_variance[14:])


def test_a_straight_run_does_not_diverge():
    """As (4.28), (4.48) print them, rows 4, 5 measure no acceleration, and the speed walks off by over 100 m/s."""
    model = make_filter("encoder12", ROBOT, thesis=True)
    time_s, z, along = drive(model, duration_s=60.0)
    track = run_filter(model, time_s, z, ALL_BELIEVED)
    error = np.hypot(track.state("speed_x_mps") - along[:, 0], track.state("speed_y_mps"))
    assert np.sqrt(np.mean(error**2)) < 5


def test_the_speed_is_kept_while_the_camera_is_lost_in_a_curve():
    """With the Coriolis signs as (6.2) prints them it is off by over 0.15 m/s."""
    model = make_filter("vio15", ROBOT)
    time_s, z, _ = drive(model, 0.3)
    lost = (time_s > 12) & (time_s < 15)
    z[np.ix_(lost, [row.startswith("camera") for row in model.rows])] = np.nan
    track = run_filter(model, time_s, z)
    assert np.hypot(track.state("speed_x_mps") - 1, track.state("speed_y_mps"))[lost].max() < 0.05


def test_vio15_is_consistent_on_what_its_own_equations_draw():
    model, n_runs, n = make_filter("vio15", ROBOT), 50, 2001
    instants = np.arange(100, n, 100)  # 20, two seconds apart: errors last; innovations do not
    squares = {"nees": np.zeros(20), "nis": np.zeros(n)}
    for seed in range(n_runs):
        time_s, truth, z = sample_from_model(model, n, DT_S, np.random.default_rng(seed))
        track = run_filter(model, time_s, z, ALL_BELIEVED)
        squares["nees"] += nees(track, truth)[instants] / n_runs
        squares["nis"] += track.nis.sum(axis=1) / n_runs
    for kind, dof in (("nees", 18), ("nis", 17)):
        low, high = chi2.ppf([0.025, 0.975], dof * n_runs) / n_runs
        assert ((squares[kind] >= low) & (squares[kind] <= high)).mean() >= 0.9
    assert chi2.ppf([0.025, 0.975], 18 * n_runs) / n_runs == pytest.approx([16.37, 19.70], abs=0.01)


def test_wheels_at_right_angles_at_the_start_are_found():
    """Linearised where all is zero, a wheel that stands across says the wrong thing once, and is left out."""
    model = make_filter("vio15", ROBOT)
    time_s, z, _ = drive(model)
    z[:, 7:10] += np.pi / 2
    z[:, 3:5] = z[:, [4, 3]]
    z[:, 10:12] = z[:, [11, 10]]  # sideways: to the left
    track = run_filter(model, time_s[150:], z[150:])
    assert np.abs(track.state("speed_y_mps")[100:] - 1).max() < 0.05
    assert np.abs(track.state("slip_speed_2_mps")[300:] - SLIP / (1 - SLIP)).max() < 0.05


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: make_filter("vio16", ROBOT),
            "filter 'vio16' is unknown: use one of encoder12, vio12, vio15",
        ),
        (lambda: make_filter("vio15", load_robot("husky")), "robot husky has the drive 'skid_steer'"),
        (lambda: make_filter("vio15", ROBOT.without("camera")), "has no section 'camera'"),
    ],
)
def test_invalid_filters_are_refused(call, message):
    with pytest.raises(ConfigError, match=message):
        call()
