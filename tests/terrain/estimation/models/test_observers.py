"""All observers: their interface, whatever comes in, live as of a whole log, logs with estimates, and a new one."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.filter import FilterModel, FilterSettings, differentiate
from terrain.estimation.models.choice import OBSERVERS, make_observer, observers_of
from terrain.estimation.models.observer import (
    ROWS,
    FilterObserver,
    ObserverOutput,
    ObserverStatus,
    observe,
    rows_of,
)
from terrain.estimation.models.slip_model import (
    PARAMETERS,
    SlipModel,
    model_of,
    read_slip_model,
    write_slip_model,
)
from terrain.estimation.observe import observe_run, summarize_observer, with_estimates
from terrain.kernels import njit
from terrain.logs.run_folders import read_run, write_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import PrescribedSlip
from terrain.simulation.run import simulate

UGV, CAR, HUSKY = (load_robot(name) for name in ("orchard_ugv", "adap2e", "husky"))
ROBOTS = {name: UGV if name in observers_of(UGV) else CAR for name in OBSERVERS}
ANY = pytest.mark.parametrize("name", OBSERVERS)
FIX = ("position_x_m", "position_y_m", "yaw_rad")


def made(name):
    return make_observer(name, ROBOTS[name], SlipModel())


@pytest.fixture(scope="module")
def straight():
    return simulate(UGV, np.tile([0.6, 0.6], (1001, 1)), PrescribedSlip(0.85, 0.85), 0)


@ANY
def test_an_observer_keeps_to_the_interface_before_anything_is_measured(name):
    observer = made(name)
    assert observer.name == name
    assert set(observer.rows) <= set(ROWS)
    assert all(slip.startswith("slip_") and slip.endswith(("_ratio", "_rad")) for slip in observer.slips)
    output = observer.step(np.full(len(observer.rows), np.nan), 0.0)
    assert len(output.mean) == len(output.std) == len(observer.states)
    assert len(output.slip) == len(output.slip_std) == len(observer.slips)
    assert output.status in (ObserverStatus.STARTING, ObserverStatus.BAD_INPUT)
    assert np.isnan(output.slip).all()  # what was never observed


def straight_rows(name):
    """Return rows (3000, m) of motion ahead at 0.6 m/s without slip, at 50 Hz, with a fix every fifth tick."""
    names, still = (
        made(name).rows,
        ("yaw_rate_radps", "roll_rad", "pitch_rad", "steer_front_rad", "accel_y_mps2"),
    )
    rows = np.tile(np.where(np.isin(names, still), 0.0, 0.6), (3000, 1))
    for column, speed_mps in zip(FIX, (0.6, 0.0, 0.0), strict=True):
        if column in names:
            rows[:, names.index(column)] = np.nan
            rows[::5, names.index(column)] = 0.02 * speed_mps * np.arange(0, 3000, 5)
    return rows


@ANY
def test_any_input_leaves_an_observer_that_finds_back(name):
    observer, rng = made(name), np.random.default_rng(5)
    wrong = np.array([np.nan, np.inf, -np.inf, 0.0, -0.5, 1e300, -1e9, 4.0, 1e-320])
    for _ in range(800):
        row = rng.normal(size=len(observer.rows)) * 0.5
        chosen = rng.random(len(row)) < 0.3
        row[chosen] = rng.choice(wrong, chosen.sum())
        given = row.copy()
        output = observer.step(row, float(rng.choice([0.02, 0.0, -1.0, np.nan, 1e6, 0.1, np.inf])))
        assert row.tobytes() == given.tobytes()
        assert ObserverStatus(output.status) in ObserverStatus
        assert not np.isinf(np.concatenate(output[:4])).any()
    for row in straight_rows(name):
        output = observer.step(row, 0.02)
    assert output.status in (ObserverStatus.OK, ObserverStatus.UNEXCITED, ObserverStatus.PREDICTED)
    if "position_x_m" in observer.rows:
        assert np.abs(output.slip).max() < 0.02
        assert output.mean[0] == pytest.approx(0.012 * 2999, abs=0.1)


@pytest.mark.parametrize("name", [name for name in OBSERVERS if set(FIX) <= set(made(name).rows)])
def test_a_fix_that_cannot_be_is_rejected_a_lasting_one_resets_the_pose_alone_and_lost_ones_cost_no_slip(
    name,
):
    at, rows, tracks = [made(name).rows.index(column) for column in FIX], straight_rows(name), []

    def faulty(ticks, change):
        log = rows.copy()
        log[ticks, at] = log[ticks, at] + change
        tracks.append(observe(made(name), 0.02 * np.arange(len(log)), log))
        return tracks[-1]

    clean = faulty(0, 0.0)
    for shift in ((5.0, 0.0, 0.0), (0.0, 0.0, np.pi), (np.inf, 0.0, 0.0)):
        rejected = np.flatnonzero(faulty(1000, shift).status == ObserverStatus.REJECTED).tolist()
        assert rejected == [1000] or (rejected == [] and np.isinf(shift[0]))
    lasting = faulty(slice(1500, None), (5.0, 0.0, 0.0))
    assert (lasting.status[1500:1545] == ObserverStatus.REJECTED).sum() == 9
    assert (lasting.status == ObserverStatus.RESET).sum() == 1
    assert lasting.mean[-1, 0] - clean.mean[-1, 0] == pytest.approx(5.0, abs=1e-3)
    lost = faulty(slice(1500, 2500), np.nan)
    needs_fixes = name in ("tracked", "sideslip-kinematic", "sideslip-multi")
    assert (lost.status[2400] == ObserverStatus.PREDICTED) == needs_fixes
    for track in tracks:
        assert np.abs(track.slip[1000:] - clean.slip[1000:]).max() < 1e-3


def test_a_robot_has_the_observers_of_its_description():
    assert observers_of(HUSKY) == ()
    only = replace(UGV, filters=("tracked",))
    assert observers_of(only) == ("tracked",)
    with pytest.raises(ConfigError, match="filter 'endo' is not for robot orchard_ugv"):
        make_observer("endo", only)
    with pytest.raises(ConfigError, match="whose drive is skid_steer: none is"):
        make_observer("tracked", HUSKY)


def test_estimates_are_written_and_read_as_streams_of_the_log(straight, tmp_path):
    write_run(with_estimates(observe_run(straight, UGV, "tracked")), tmp_path)
    run = read_run(tmp_path / "run")
    assert run.filter == "tracked"
    assert run.streams["slip"].channels == ("slip_left_ratio", "slip_right_ratio")
    assert run.streams["slip"].values[-1] == pytest.approx([0.15, 0.15], abs=0.02)
    assert run.streams["estimator"].channels == ("speed_x_mps", "yaw_rate_radps")
    assert {"std_slip_left_ratio", "observer_code", "eta_left_ratio"} <= set(run.streams["state"].channels)
    learned = with_estimates(observe_run(straight, UGV, "slip-learning"))
    assert "angle_roll_rad" not in learned.streams["state"].channels


def test_figures_of_a_run_are_those_of_its_truth(straight):
    estimate = observe_run(straight, UGV, "tracked")
    figures = summarize_observer(estimate)
    assert figures.slip["slip_left_ratio"].true_mean == pytest.approx(0.15)
    assert set(figures.status_s) <= {"starting", "standing", "ok"}
    assert sum(figures.status_s.values()) == pytest.approx(20.0)
    assert figures.finite
    assert figures.position_rmse_m < 0.05
    assert figures.missing == ()
    blind = RunLog("a", "orchard_ugv", {k: v for k, v in straight.streams.items() if k != "truth"})
    figures = summarize_observer(observe_run(blind, UGV, "gyrodometry"))
    assert np.isnan(figures.position_rmse_m)
    assert figures.slip == {}


def test_a_robot_with_an_effect_is_corrected_first(straight):
    larger = replace(UGV, effects={"wheel_radius_ratio": -0.15}, effects_cov=np.full((1, 1), np.nan))
    for robot, slip in ((UGV, 0.15), (larger, 0.0)):
        assert observe_run(straight, robot, "tracked").track.slip[-1] == pytest.approx([slip, slip], abs=0.02)


def test_a_log_that_lacks_something_is_run_and_says_so_or_is_refused(straight):
    def without(*names):
        return RunLog("a", "orchard_ugv", {k: v for k, v in straight.streams.items() if k not in names})

    estimate = observe_run(without("pose", "gnss", "compass"), UGV, "tracked")
    assert (
        estimate.missing
        == summarize_observer(estimate).missing
        == ("position_x_m", "position_y_m", "yaw_rad")
    )
    assert set(estimate.track.status) == {ObserverStatus.STARTING}
    assert np.isnan(estimate.track.slip).all()
    assert np.isfinite(observe_run(without("imu"), UGV, "gyrodometry").track.mean[:, :3]).all()
    wheels = straight.streams["wheels"]
    left = Stream(wheels.time_s, wheels.values[:, :1], wheels.channels[:1])
    with pytest.raises(ConfigError, match="'speed_right_mps' must be among them"):
        observe_run(RunLog("a", "orchard_ugv", dict(straight.streams) | {"wheels": left}), UGV, "tracked")


def test_a_slip_model_is_read_as_it_was_written(tmp_path):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(len(PARAMETERS), len(PARAMETERS)))
    residuals = {"slip_std_ratio": 0.01, "run_angle_std_rad": 0.04, "correlation_s": 0.7}
    model = model_of(rng.uniform(0.1, 1.0, len(PARAMETERS)), covariance=1e-4 * root @ root.T, **residuals)
    file = tmp_path / "slip.yaml"
    write_slip_model(file, model, "patako")
    read = read_slip_model(file, "patako")
    assert read.vector == pytest.approx(model.vector, rel=1e-5)
    assert read.covariance == pytest.approx(model.covariance, rel=1e-4, abs=1e-9)
    assert {name: getattr(read, name) for name in residuals} == residuals
    with pytest.raises(ConfigError, match="is the slip model of robot 'patako', not 'marmotte'"):
        read_slip_model(file, "marmotte")
    with pytest.raises(ConfigError, match="is there already"):
        write_slip_model(file, model, "patako")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("turning_exponent: {value: 0.87", "turning_exponent: {value: .nan", "a finite number is required"),
        ("turning_exponent:", "turning_exponents:", "key 'turning_exponents' is unknown"),
        ("slip_std_ratio: 0.01", "slip_std_ratio: -1", "from zero up is required"),
        ("correlation:\n", "correlation: [[1.0]]\nfound2:\n", "key 'found2' is unknown"),
    ],
)
def test_a_slip_model_that_cannot_be_is_refused(tmp_path, old, new, message):
    file = tmp_path / "slip.yaml"
    write_slip_model(file, SlipModel(turning_exponent=0.87, slip_std_ratio=0.01), "patako")
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        read_slip_model(file, "patako")


# -- a new observer: the longitudinal slip that both tracks share, by fixes of the position -------------------------


@njit
def move(x, dt, params, x_next):
    speed = (1.0 - x[3]) * 0.5 * (params[0] + params[1])
    middle = x[2] + 0.5 * dt * params[2]
    x_next[:] = x
    x_next[0] += dt * speed * np.cos(middle)
    x_next[1] += dt * speed * np.sin(middle)
    x_next[2] += dt * params[2]


@njit
def propagate(x, dt, params, x_next, f):
    differentiate(move, x, dt, params, x_next, f)


@njit
def observe_pose(x, params, z_hat, h):
    for i in range(3):
        z_hat[i], h[i, i] = x[i], 1.0


class CommonSlip(FilterObserver):
    """State: pose and slip; speeds of the tracks and the gyro are inputs."""

    slips, rows = ("slip_body_ratio",), ("speed_left_mps", "speed_right_mps", "yaw_rate_radps", *ROWS[4:7])

    def __init__(self):
        self.states = ("position_x_m", "position_y_m", "yaw_rad", "slip_ratio")
        model = FilterModel(
            "common-slip",
            self.states,
            rows=ROWS[4:7],
            sensors=(("position", ROWS[4:6]), ("heading", ROWS[6:7])),
            propagate=propagate,
            observe=observe_pose,
            params=np.zeros(0),
            process_variance=np.square([1e-3, 1e-3, 1e-3, 0.01]),
            measurement_variance=np.square([0.02, 0.02, 0.01]),
            initial_variance=np.square([1e4, 1e4, np.pi, 0.3]),
            inputs=("left", "right", "yaw_rate"),
            positions=ROWS[4:6],
            angle_rows=("yaw_rad",),
        )
        super().__init__(model, FilterSettings())

    def step(self, row, dt_s):
        status = self.advance(dt_s, row[3:], row[:3])
        std = np.sqrt(self.filter.cov.diagonal())
        status = ObserverStatus.STARTING if self.age_s.max() == np.inf else status
        return ObserverOutput(self.filter.mean.copy(), std, self.filter.mean[3:].copy(), std[3:], status)


def test_a_new_observer_is_fifty_lines(straight):
    assert ROWS[4:7] == ("position_x_m", "position_y_m", "yaw_rad")
    time_s, rows, _ = rows_of(straight, UGV, CommonSlip.rows)
    track = observe(CommonSlip(), time_s, rows)
    assert abs(track.slip[-1, 0] - 0.15) < 3 * track.slip_std[-1, 0] < 0.05
