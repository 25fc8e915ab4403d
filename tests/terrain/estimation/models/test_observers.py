"""All observers: their rows, their interface, whatever comes in, logs with estimates, and a new one."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.estimation.estimate import enriched, estimate_run, summarize
from terrain.estimation.filter import FilterModel, FilterSettings, differentiate
from terrain.estimation.live import make_live_filter
from terrain.estimation.models.choice import OBSERVERS, make_observer, observers_of
from terrain.estimation.models.observer import (
    FIX_ROWS,
    INERTIAL_ROWS,
    PLACE_ROWS,
    FilterObserver,
    ObserverFeed,
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
from terrain.kernels import njit
from terrain.logs.run_folders import read_run, write_run
from terrain.records import Reading, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import QUIET, PrescribedSlip
from terrain.simulation.run import simulate

UGV, CAR, HUSKY = (load_robot(name) for name in ("orchard_ugv", "adap2e", "husky"))
ROBOTS = {name: UGV if name in observers_of(UGV) else CAR for name in OBSERVERS}
ANY = pytest.mark.parametrize("name", OBSERVERS)
FIX = PLACE_ROWS
NAMES = ("speed_left_mps", "speed_right_mps", *PLACE_ROWS, *INERTIAL_ROWS[:4])


def made(name):
    return make_observer(name, ROBOTS[name], SlipModel())


def without(run, *names):
    return replace(run, streams={name: s for name, s in run.streams.items() if name not in names})


def changed(run, **streams):
    """Return the run with streams of other stamps or values, each a pair."""
    new = {name: Stream(*pair, run.streams[name].channels) for name, pair in streams.items()}
    return replace(run, streams={**run.streams, **new})


@pytest.fixture(scope="module")
def straight():
    return simulate(UGV, np.tile([0.6, 0.6], (1001, 1)), PrescribedSlip(0.85, 0.85), 0)


@pytest.fixture(scope="module")
def turning():
    """On an arc, by sensors without noise."""
    return simulate(UGV, np.tile([0.4, 0.6], (301, 1)), PrescribedSlip(0.9, 0.8), 0, sensors=QUIET)


# -- rows -----------------------------------------------------------------------------------------------------------


def column(rows, name):
    return rows[:, NAMES.index(name)]


def test_rows_hold_what_was_measured_and_a_fix_between_two_ticks_is_brought_to_the_later_one(turning):
    gnss, compass, truth = (turning.streams[name] for name in ("gnss", "compass", "truth"))
    time_s, rows, dropped = rows_of(without(turning, "pose"), UGV, NAMES)
    at = np.searchsorted(truth.time_s, time_s - 1e-9)
    assert rows[:, :2] == pytest.approx(np.tile([0.4, 0.6], (len(rows), 1)))
    assert column(rows, "yaw_rate_radps")[5:] == pytest.approx(truth.values[at[5:], 7], abs=1e-9)
    fixed = np.isfinite(rows[:, 2])
    assert fixed.sum() == len(gnss)
    assert np.isfinite(rows[:, 4]).tolist() == fixed.tolist()
    assert rows[fixed, 2:5] == pytest.approx(truth.values[at[fixed], :3], abs=1e-9)
    assert not dropped
    late = {name: (s.time_s + 0.013, s.values) for name, s in (("gnss", gnss), ("compass", compass))}
    _, rows, _ = rows_of(without(changed(turning, **late), "pose"), UGV, NAMES)
    tenth = np.flatnonzero(np.isfinite(rows[:, 2]))[10]
    ahead = np.array([np.cos(compass.values[10, 0]), np.sin(compass.values[10, 0])])
    assert rows[tenth, 2:4] - gnss.values[10, :2] == pytest.approx(0.007 * 0.5 * ahead)


def test_what_is_missing_is_held_for_a_while_and_bad_fixes_are_none(turning):
    imu, pose, gnss = (turning.streams[name] for name in ("imu", "pose", "gnss"))
    kept = (imu.time_s < 1.0) | (imu.time_s > 2.0)
    time_s, rows, _ = rows_of(changed(turning, imu=(imu.time_s[kept], imu.values[kept])), UGV, NAMES)
    unknown_s = time_s[np.isnan(column(rows, "yaw_rate_radps"))]
    assert [unknown_s.min(), unknown_s.max()] == pytest.approx([1.1, 2.0], abs=0.021)
    lost = changed(turning, pose=(pose.time_s, np.full_like(pose.values, np.nan)))
    assert np.isfinite(rows_of(lost, UGV, NAMES)[1][:, 2]).sum() == len(gnss)  # satellites stand in
    values = gnss.values.copy()
    values[:, gnss.channels.index("std_position_m")] = 1.5
    _, rows, dropped = rows_of(without(changed(turning, gnss=(gnss.time_s, values)), "pose"), UGV, NAMES)
    assert np.isnan(rows[:, 2]).all()
    assert dropped["gnss: inaccurate"] == len(gnss)
    with pytest.raises(ConfigError, match="'speed_left_mps' must be among them"):
        ObserverFeed(UGV, NAMES, {"wheels": ("motor_1_radps",)})
    with pytest.raises(DataError, match="has no stream wheels"):
        rows_of(without(turning, "wheels"), UGV, NAMES)


def feed_of(run):
    """Return a feed, a function that gives it samples, and one that gives the row of a tick."""
    feed = ObserverFeed(UGV, NAMES, {name: stream.channels for name, stream in run.streams.items()})

    def tick(time_s):
        due = {name: queue.take(time_s) for name, queue in feed.queues.items()}
        return feed.tick(time_s, np.array([0.4, 0.6]), due)

    return feed, lambda name, time_s, values: feed.queues[name].push(np.array(time_s), values), tick


def test_what_is_no_time_unknown_or_waited_long_for_the_wheels_does_not_take_the_others_along(turning):
    _, push, tick = feed_of(turning)
    imu = turning.streams["imu"].values[:4].copy()
    imu[1, 2] = np.nan
    push("imu", [0.0, np.inf, 0.005, 0.01], imu)
    assert tick(0.02)[NAMES.index("yaw_rate_radps")] == pytest.approx(imu[[0, 2, 3], 2].mean())
    push("imu", [0.03], np.where(np.arange(9) == 2, np.nan, imu[:1]))
    row = tick(0.04)
    assert np.isfinite(row[NAMES.index("roll_rad")])
    assert row[NAMES.index("yaw_rate_radps")] == pytest.approx(imu[3, 2])  # held
    for tick_s, late in ((0.35, {}), (0.45, {"gnss: late": 1, "compass: late": 1})):
        feed, push, tick = feed_of(without(turning, "pose"))
        for name in ("gnss", "compass"):
            push(name, [0.1], turning.streams[name].values[:1])
        assert np.isnan(tick(tick_s)[2:5]).tolist() == [bool(late)] * 3
        assert feed.dropped == late


def test_samples_that_cannot_be_are_left_out_and_counted(turning):
    channels = {name: stream.channels for name, stream in turning.streams.items()}
    live, imu = make_live_filter("tracked", UGV, channels), np.full((1, 9), 0.1)
    live.step({"wheels": Reading(np.array([0.0, 0.02]), np.full((2, 2), 0.1))})
    assert live.latest.time_s == 0.02
    live.step({"imu": Reading(np.array([0.03, 0.03]), np.vstack([imu, imu]))})
    live.step({"imu": Reading(np.array([0.02]), np.full((1, 4), 0.1)), "pose": "nothing"})
    live.step({"wheels": Reading(np.array([0.02, 0.01, np.nan]), np.full((3, 2), 0.1))})
    assert live.dropped == {
        "imu: stamp does not increase": 1,
        "wheels: stamp does not increase": 3,
        "imu: unreadable": 1,
        "pose: unreadable": 1,
    }
    live.step({"wheels": Reading(np.array([0.04]), np.array([[np.inf, np.nan]]))})
    assert live.latest.status is ObserverStatus.BAD_INPUT


# -- any observer ---------------------------------------------------------------------------------------------------


def straight_rows(name, n):
    """Return rows (n, m) of motion ahead at 0.6 m/s without slip, at 50 Hz, with a fix every fifth tick."""
    names = made(name).rows
    still = (*INERTIAL_ROWS, "steer_front_rad", "gnss_age_s", "gnss_speed_y_mps")
    rows = np.tile(np.where(np.isin(names, still), 0.0, 0.6), (n, 1))
    rows[:, np.isin(names, [row for row in names if row.startswith(("pose", "compass", "camera"))])] = np.nan
    rows[:, np.isin(names, "gnss_std_m")] = 0.02
    for place, speed_mps in zip((*FIX, *FIX_ROWS["gnss"]), (0.6, 0.0, 0.0, 0.6, 0.0), strict=False):
        if place in names:
            rows[:, names.index(place)] = np.nan
            rows[::5, names.index(place)] = 0.02 * speed_mps * np.arange(0, n, 5)
    return rows


@ANY
def test_any_input_leaves_an_observer_that_finds_back(name):
    observer, rng = made(name), np.random.default_rng(5)
    output = observer.step(np.full(len(observer.rows), np.nan), 0.0)
    assert output.status in (ObserverStatus.STARTING, ObserverStatus.BAD_INPUT)
    assert np.isnan(output.slip).all()  # what was never observed
    wrong = np.array([np.nan, np.inf, -np.inf, 0.0, -0.5, 1e300, -1e9, 4.0, 1e-320])
    for _ in range(400):
        row = rng.normal(size=len(observer.rows)) * 0.5
        chosen = rng.random(len(row)) < 0.3
        row[chosen] = rng.choice(wrong, chosen.sum())
        given = row.copy()
        output = observer.step(row, float(rng.choice([0.02, 0.0, -1.0, np.nan, 1e6, 0.1, np.inf])))
        assert row.tobytes() == given.tobytes()
        assert ObserverStatus(output.status) in ObserverStatus
        assert not np.isinf(np.concatenate(output[:4])).any()
        assert len(output.mean) == len(output.std) == len(observer.states)
        assert len(output.slip) == len(output.slip_std) == len(observer.slips)
    for row in straight_rows(name, 1200):
        output = observer.step(row, 0.02)
    assert output.status in (ObserverStatus.OK, ObserverStatus.UNEXCITED, ObserverStatus.PREDICTED)
    if FIX[0] in observer.rows:
        assert np.abs(output.slip).max() < 0.02
        assert output.mean[0] == pytest.approx(0.012 * 1199, abs=0.1)


@pytest.mark.parametrize("name", [name for name in OBSERVERS if set(FIX) <= set(made(name).rows)])
def test_a_fix_that_cannot_be_is_rejected_a_lasting_one_resets_the_pose_alone_and_lost_ones_cost_no_slip(
    name,
):
    at, rows = [made(name).rows.index(place) for place in FIX], straight_rows(name, 1000)

    def faulty(*faults):
        log = rows.copy()
        for ticks, change in faults:
            log[ticks, at] = log[ticks, at] + change
        return observe(made(name), 0.02 * np.arange(len(log)), log)

    clean = faulty()
    cannot_be = faulty((400, (5.0, 0.0, 0.0)), (500, (0.0, 0.0, np.pi)), (600, (np.inf, 0.0, 0.0)))
    rejected = np.flatnonzero(cannot_be.status == ObserverStatus.REJECTED).tolist()
    assert rejected in ([400, 500], [400, 500, 600])  # what is infinite may count as no fix
    lasting = faulty((slice(500, None), (5.0, 0.0, 0.0)))
    assert (lasting.status[500:545] == ObserverStatus.REJECTED).sum() == 9
    assert (lasting.status == ObserverStatus.RESET).sum() == 1
    assert lasting.mean[-1, 0] - clean.mean[-1, 0] == pytest.approx(5.0, abs=1e-3)
    lost = faulty((slice(500, 900), np.nan))
    needs_fixes = name in ("tracked", "sideslip-kinematic", "sideslip-multi")
    assert (lost.status[880] == ObserverStatus.PREDICTED) == needs_fixes
    for track in (cannot_be, lasting, lost):
        assert np.abs(track.slip[400:] - clean.slip[400:]).max() < 1e-3


def test_a_robot_has_the_observers_of_its_description():
    assert observers_of(HUSKY) == ("slip",)
    only = replace(UGV, filters=("tracked",))
    assert observers_of(only) == ("tracked",)
    with pytest.raises(ConfigError, match="filter 'endo' is not for robot orchard_ugv"):
        make_observer("endo", only)
    with pytest.raises(ConfigError, match="whose drive is skid_steer: use slip"):
        make_observer("tracked", HUSKY)


# -- a run ----------------------------------------------------------------------------------------------------------


def test_a_run_has_its_estimates_as_streams_and_figures_by_its_truth(straight, tmp_path):
    found = estimate_run(straight, UGV, "tracked")
    write_run(enriched(found), tmp_path)
    run = read_run(tmp_path / "run")
    assert run.filter == "tracked"
    assert run.streams["slip"].channels == ("slip_left_ratio", "slip_right_ratio")
    assert run.streams["slip"].values[-1] == pytest.approx([0.15, 0.15], abs=0.02)
    assert run.streams["estimator"].channels == ("speed_x_mps", "yaw_rate_radps")
    assert {"std_slip_left_ratio", "observer_code", "eta_left_ratio"} <= set(run.streams["state"].channels)
    learned = enriched(estimate_run(straight, UGV, "slip-learning"))
    assert "angle_roll_rad" not in learned.streams["state"].channels  # never excited
    figures = summarize(found)
    assert figures.slip["slip_left_ratio"].true_mean == pytest.approx(0.15)
    assert set(figures.status_s) <= {"starting", "standing", "ok"}
    assert sum(figures.status_s.values()) == pytest.approx(20.0)
    assert figures.finite
    assert figures.position_rmse_m < 0.05
    assert figures.missing == ()
    blind = summarize(estimate_run(without(straight, "truth"), UGV, "gyrodometry"))
    assert np.isnan(blind.position_rmse_m)
    assert blind.slip == {}
    larger = replace(UGV, effects={"wheel_radius_ratio": -0.15}, effects_cov=np.full((1, 1), np.nan))
    corrected = estimate_run(straight, larger, "tracked")  # for the effect of its robot: no slip is left
    assert corrected.slip.mean[-1] == pytest.approx([0.0, 0.0], abs=0.02)


def test_a_log_that_lacks_something_is_run_and_says_so_or_is_refused(straight):
    found = estimate_run(without(straight, "pose", "gnss", "compass"), UGV, "tracked")
    assert found.missing == summarize(found).missing == FIX
    assert set(found.status) == {ObserverStatus.STARTING}
    assert np.isnan(found.slip.mean).all()
    assert np.isfinite(estimate_run(without(straight, "imu"), UGV, "gyrodometry").track.mean[:, :3]).all()
    wheels = straight.streams["wheels"]
    left = Stream(wheels.time_s, wheels.values[:, :1], wheels.channels[:1])
    with pytest.raises(ConfigError, match="'speed_right_mps' must be among them"):
        estimate_run(replace(straight, streams=dict(straight.streams) | {"wheels": left}), UGV, "tracked")


def test_a_slip_model_is_read_as_it_was_written_and_what_cannot_be_is_refused(tmp_path):
    rng, file = np.random.default_rng(1), tmp_path / "slip.yaml"
    root = rng.normal(size=(len(PARAMETERS), len(PARAMETERS)))
    residuals = {"slip_std_ratio": 0.01, "run_angle_std_rad": 0.04, "correlation_s": 0.7}
    model = model_of(rng.uniform(0.1, 1.0, len(PARAMETERS)), covariance=1e-4 * root @ root.T, **residuals)
    write_slip_model(file, model, "patako")
    read = read_slip_model(file, "patako")
    assert read.vector == pytest.approx(model.vector, rel=1e-5)
    assert read.covariance == pytest.approx(model.covariance, rel=1e-4, abs=1e-9)
    assert {name: getattr(read, name) for name in residuals} == residuals
    with pytest.raises(ConfigError, match="is the slip model of robot 'patako', not 'marmotte'"):
        read_slip_model(file, "marmotte")
    with pytest.raises(ConfigError, match="is there already"):
        write_slip_model(file, model, "patako")
    file.unlink()
    write_slip_model(file, SlipModel(turning_exponent=0.87, slip_std_ratio=0.01), "patako")
    text = file.read_text()
    for old, new, message in (
        ("turning_exponent: {value: 0.87", "turning_exponent: {value: .nan", "a finite number is required"),
        ("turning_exponent:", "turning_exponents:", "key 'turning_exponents' is unknown"),
        ("slip_std_ratio: 0.01", "slip_std_ratio: -1", "from zero up is required"),
        ("correlation:\n", "correlation: [[1.0]]\nfound2:\n", "key 'found2' is unknown"),
    ):
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

    slips, rows = ("slip_body_ratio",), ("speed_left_mps", "speed_right_mps", "yaw_rate_radps", *FIX)

    def __init__(self):
        self.states = (*FIX, "slip_ratio")
        model = FilterModel(
            "common-slip",
            self.states,
            rows=FIX,
            sensors=(("position", FIX[:2]), ("heading", FIX[2:])),
            propagate=propagate,
            observe=observe_pose,
            params=np.zeros(0),
            process_variance=np.square([1e-3, 1e-3, 1e-3, 0.01]),
            measurement_variance=np.square([0.02, 0.02, 0.01]),
            initial_variance=np.square([1e4, 1e4, np.pi, 0.3]),
            inputs=("left", "right", "yaw_rate"),
            positions=FIX[:2],
            angle_rows=FIX[2:],
        )
        super().__init__(model, FilterSettings())

    def step(self, row, dt_s):
        status = self.advance(dt_s, row[3:], row[:3])
        std = np.sqrt(self.filter.cov.diagonal())
        status = ObserverStatus.STARTING if self.age_s.max() == np.inf else status
        return ObserverOutput(self.filter.mean.copy(), std, self.filter.mean[3:].copy(), std[3:], status)


def test_a_new_observer_is_fifty_lines(straight):
    time_s, rows, _ = rows_of(straight, UGV, CommonSlip.rows)
    track = observe(CommonSlip(), time_s, rows)
    assert abs(track.slip[-1, 0] - 0.15) < 3 * track.slip_std[-1, 0] < 0.05
