"""The one Kalman step: the textbook, whatever comes in, gaps and gates, batch as sample by sample."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_draws import CARRIAGE, carriage, drift, sample_from_model

from terrain.errors import ConfigError, DataError
from terrain.estimation.filter import Filter, FilterModel, FilterSettings, process_noise, run_filter
from terrain.kernels import njit
from terrain.records import ABSENT, GATED, REOPENED, USED

DT_S = 0.02
ALL_BELIEVED = FilterSettings(gate_probability=1.0)


@njit
def fly(x, dt, params, x_next, f):
    """Position, heading and speed in the plane: p <- p + v (cos, sin) dt."""
    cos, sin = np.cos(x[2]), np.sin(x[2])
    x_next[:] = x
    x_next[0] += dt * x[3] * cos
    x_next[1] += dt * x[3] * sin
    x_next[2] += dt * x[4]
    for i in range(5):
        f[i, i] = 1.0
    f[0, 2], f[0, 3] = -dt * x[3] * sin, dt * cos
    f[1, 2], f[1, 3] = dt * x[3] * cos, dt * sin
    f[2, 4] = dt


@njit
def see(x, params, z_hat, h):
    """A beacon's range, squared, and bearing; speed and turn of the wheels; a fix along x."""
    east, north = params[0] - x[0], params[1] - x[1]
    square = east**2 + north**2
    z_hat[0], z_hat[1], z_hat[2] = square, np.arctan2(north, east) - x[2], x[3]
    z_hat[3], z_hat[4] = x[3] * x[4], x[0]
    h[0, 0], h[0, 1] = -2 * east, -2 * north
    h[1, 0], h[1, 1], h[1, 2] = north / square, -east / square, -1.0
    h[2, 3] = h[4, 0] = 1.0
    h[3, 3], h[3, 4] = x[4], x[3]


WALK = np.diag([1e-3, 1e-3, 1e-2, 0.05, 0.1]) ** 2
WALK[3, 4] = WALK[4, 3] = 0.5 * 0.05 * 0.1


FLIGHT = FilterModel(
    name="flight",
    states=("position_x_m", "position_y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"),
    rows=("square_m", "bearing_rad", "speed_mps", "accel_mps2", "position_x_m"),
    sensors=(
        ("beacon", ("square_m", "bearing_rad")),
        ("wheels", ("accel_mps2", "speed_mps")),
        ("fix", ("position_x_m",)),
    ),
    propagate=fly,
    observe=see,
    params=np.array([30.0, 10.0]),
    process_variance=WALK,
    measurement_variance=np.square([0.5, 0.01, 0.05, 0.05, 0.1]),
    initial_variance=np.square([0.5, 0.5, 0.1, 0.3, 0.2]),
    initial_mean=np.array([0.0, 0.0, 0.0, 1.0, 0.0]),
    references=("fix",),
    positions=("position_x_m", "position_y_m"),
    integrals=(("yaw_rad", "yaw_rate_radps"),),
    angle_states=("yaw_rad",),
    angle_rows=("bearing_rad",),
)


@pytest.fixture(scope="module")
def flown():
    return sample_from_model(FLIGHT, 600, DT_S, np.random.default_rng(0))


def dense_filter(model, time_s, z, wrapped=()):
    """The textbook: all rows at once, in Joseph form; NaN left out.  Yields x, P, NIS and log likelihood."""
    d, m = len(model.states), len(model.rows)
    x, p = model.initial_mean.copy(), model.initial_variance.copy()
    params = model.params.copy()
    for n, now in enumerate(time_s):
        if n:
            dt = now - time_s[n - 1]
            x_next, f = np.zeros(d), np.zeros((d, d))
            model.propagate(x, dt, params, x_next, f)
            x, p = x_next, f @ p @ f.T + process_noise(model, dt)
        z_hat, h = np.zeros(m), np.zeros((m, d))
        model.observe(x, params, z_hat, h)
        rows = np.flatnonzero(np.isfinite(z[n]))
        nu = z[n] - z_hat
        for i in wrapped:
            nu[i] = np.angle(np.exp(1j * nu[i]))
        nu, h, r = nu[rows], h[rows], np.diag(model.measurement_variance[rows])
        s = h @ p @ h.T + r
        k = np.linalg.solve(s, h @ p).T
        x = x + k @ nu
        turns = np.isin(model.states, model.angle_states)
        x[turns] = np.angle(np.exp(1j * x[turns]))
        left = np.eye(d) - k @ h
        p = left @ p @ left.T + k @ r @ k.T
        nis = nu @ np.linalg.solve(s, nu)
        yield x, p, nis, -0.5 * (nis + np.linalg.slogdet(2 * np.pi * s)[1])


@pytest.mark.parametrize("share_missing", [0.0, 0.3])
def test_rows_one_by_one_equal_the_textbook_all_at_once(flown, share_missing):
    time_s, _, z = flown
    rng = np.random.default_rng(1)
    z = np.where(rng.random(z.shape) < share_missing, np.nan, z)
    time_s = time_s + rng.uniform(0, 0.9 * DT_S, time_s.size)  # irregular
    track = run_filter(FLIGHT, time_s, z, ALL_BELIEVED)
    x, p, nis, likelihood = zip(*dense_filter(FLIGHT, time_s, z, wrapped=[1]), strict=True)
    np.testing.assert_allclose(track.mean, x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(track.cov, p, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.nansum(track.nis, axis=1), nis, rtol=1e-9)
    assert track.log_likelihood == pytest.approx(sum(likelihood), rel=1e-9)
    unkept = Filter(FLIGHT, ALL_BELIEVED).run(time_s, z, keep=False)
    assert unkept.likelihood.sum() == pytest.approx(track.log_likelihood, rel=1e-12)
    assert (track.cov == track.cov.transpose(0, 2, 1)).all()
    np.testing.assert_array_equal(track.nis_dof.sum(axis=1), np.isfinite(z).sum(axis=1))
    np.testing.assert_array_equal(track.use == ABSENT, track.nis_dof == 0)


@pytest.mark.parametrize("dt_s", [0.02, 0.5])
def test_noise_of_a_step_is_that_of_many_small_ones(dt_s):
    """Of states that integrate a rate which walks, also by more than the model's own; the filter adds the same."""
    walk, moved, exact, n = np.array([0.0, 0.0, 1e-5, 0.02, 0.3]), np.eye(5), np.zeros((5, 5)), 4000
    moved[2, 4] = dt_s / n
    for _ in range(n):
        exact = moved @ exact @ moved.T + (WALK + np.diag(walk)) * (dt_s / n)
    noise = process_noise(FLIGHT, dt_s, walk)
    np.testing.assert_allclose(noise, exact, rtol=1e-3)
    assert noise[2, 4] == pytest.approx((0.1**2 + 0.3) * dt_s**2 / 2)
    flight, f = Filter(FLIGHT), np.zeros((5, 5))
    flight.run(np.array([0.0, dt_s]), np.full((2, 5), np.nan), walk=walk)
    FLIGHT.propagate(FLIGHT.initial_mean.copy(), dt_s, FLIGHT.params.copy(), np.zeros(5), f)
    np.testing.assert_allclose(flight.cov, f @ FLIGHT.initial_variance @ f.T + noise, rtol=1e-12)


def ridden(n=400, seed=0):
    return sample_from_model(CARRIAGE, n, DT_S, np.random.default_rng(seed))


def spoilt(seed=0):
    """A ride on which everything goes wrong that can."""
    time_s, _, z = ridden(1500, seed)
    z[40:50] = np.nan
    z[60, 0], z[61, 1], z[62] = np.inf, -np.inf, 1e300
    z[100:240, 0] += 3.0  # rejected, then believed
    z[300, 1] = 50.0
    time_s[400:] += 3600.0
    time_s[500:] -= 3590.0
    time_s[600] += 50.0
    time_s[700] = time_s[699]
    time_s[800] = time_s[790]
    time_s[900] = np.nan
    return time_s, z


def test_sample_by_sample_equals_batch_bit_for_bit():
    time_s, z = spoilt()
    r = np.tile(CARRIAGE.measurement_variance, (time_s.size, 1))
    r[::3, 0] *= 4
    r[7, 1] = np.nan
    track = run_filter(CARRIAGE, time_s, z, variance=r)
    session, times_s, taken = Filter(CARRIAGE), [-np.inf], []
    for k in range(time_s.size):
        if session.step(time_s[k], z[k], r[k]) and time_s[k] > times_s[-1]:
            times_s.append(time_s[k])
            taken.append(session.state[0].copy())
    np.testing.assert_array_equal(track.time_s, times_s[1:])
    for name, part in (("mean", "x"), ("cov", "p"), ("nis", "nis"), ("nis_dof", "nis_dof"), ("use", "use")):
        values = np.array([state[part][:2] for state in taken])
        np.testing.assert_array_equal(getattr(track, name), values[..., :2])
    assert track.log_likelihood == session.state["log_likelihood"][0]
    assert {kind: n for kind, n in track.dropped.items() if kind != "clock set back"} == session.dropped
    assert {USED, GATED, REOPENED, ABSENT} == set(np.unique(track.use))


def test_every_fault_is_counted_by_its_name():
    time_s, z = spoilt()
    track = run_filter(CARRIAGE, time_s, z)
    assert np.isfinite(track.mean).all()
    assert np.isfinite(track.cov).all()
    assert (np.diff(track.time_s) > 0).all()
    dropped = dict(track.dropped)
    assert dropped.pop("place gated") == (track.use[:, 0] == GATED).sum() > 60
    assert dropped.pop("rate gated") >= 1
    assert dropped == {
        "place not finite": 2,
        "rate not finite": 2,
        "time did not advance": 3,  # repeated, a little back, NaN
        "clock jump": 3,  # an hour on, most of it back, and a lone stamp
        "clock set back": 1000 - 5,  # the rest of the log, but for rows that were bad themselves
    }


def test_a_lone_bad_stamp_costs_its_own_row_only():
    time_s, _, z = ridden()
    for bad in (1e9, -1e9, 30.0, np.nan, np.inf):
        stamps = time_s.copy()
        stamps[200] = bad
        track = run_filter(CARRIAGE, stamps, z)
        np.testing.assert_array_equal(track.time_s, np.delete(time_s, 200))
        whole = run_filter(CARRIAGE, np.delete(time_s, 200), np.delete(z, 200, axis=0))
        np.testing.assert_array_equal(track.mean, whole.mean)
        assert sum(track.dropped.values()) - sum(whole.dropped.values()) == 1


def test_a_gap_is_not_integrated_over_and_leaves_positions_where_they_were():
    time_s, _, z = ridden()
    z[300:, 0] = np.nan  # nothing tells the place afterwards
    time_s[300:] += 100.0
    track = run_filter(CARRIAGE, time_s, z)
    assert track.dropped["clock jump"] == 1
    np.testing.assert_array_equal(track.time_s, np.delete(time_s, 300))
    assert track.mean[300, 0] == track.mean[299, 0]
    assert track.std("position_m")[300] == pytest.approx(100.0 * 1.0, rel=0.01)  # 1 m/s, unknown, for 100 s
    assert track.std("speed_mps")[300] == pytest.approx(0.05, rel=0.01)  # the prior, and one measurement
    assert track.reference_age_s[300] == 0.0


def test_a_sensor_that_was_rejected_is_believed_once_a_second():
    time_s, _, z = ridden(600)
    z[100:300, 1] += 2.0  # 40 standard deviations, for 4 s
    track = run_filter(CARRIAGE, time_s, z)
    use = track.use[:, 1]
    reopened = np.flatnonzero(use == REOPENED)
    assert (use[100:150] == GATED).all()
    assert reopened[0] == 150
    assert np.diff(track.time_s[reopened]).min() > 1 - 1e-9
    assert track.mean[150, 1] - track.mean[149, 1] == pytest.approx(2.0, abs=0.3)
    assert (use[400:] == USED).mean() > 0.99
    np.testing.assert_allclose(track.reference_age_s[100:150], DT_S * np.arange(1, 51))
    assert track.reference_age_s[150] == 0.0


def test_angles_meet_across_the_seam():
    time_s, truth, z = sample_from_model(
        dataclasses.replace(FLIGHT, initial_mean=np.array([0.0, 0, 3.1, 1.0, 0.6])),
        600,
        DT_S,
        np.random.default_rng(3),
    )
    model = dataclasses.replace(FLIGHT, initial_mean=np.array([0.0, 0, -3.1, 1.0, 0.5]))
    track = run_filter(model, time_s, z)
    assert (np.abs(track.state("yaw_rad")) <= np.pi).all()
    error = np.angle(np.exp(1j * (track.state("yaw_rad") - truth[:, 2])))
    assert np.abs(error[50:]).max() < 0.1


def test_a_measurement_beside_which_the_noise_is_lost_leaves_a_variance():
    """P0 = 1e16 R: s = h P h' + R is h P h' in double precision, and P - K s K' would be zero.

    A log may be empty, too, or have no measurement at all.
    """
    noise = {"process_variance": np.zeros(2), "measurement_variance": np.square([1e-2, 1e-2])}
    model = carriage(initial_variance=np.array([1e12, 1e12]), **noise)
    track = run_filter(model, np.arange(3.0) / 50, np.ones((3, 2)))
    np.testing.assert_allclose(track.std("speed_mps"), 1e-2 / np.sqrt([1, 2, 3]), rtol=1e-3)
    assert track.dropped == {}
    none = run_filter(CARRIAGE, np.zeros(0), np.zeros((0, 2)))
    assert (none.mean.shape, none.log_likelihood) == ((0, 2), 0.0)
    np.testing.assert_array_equal(run_filter(CARRIAGE, [5.0], [[np.nan, np.nan]]).cov[0], np.eye(2))


garbage = st.one_of(
    st.floats(width=64),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e9, -1e9, 5e-324, 0.0]),
    st.floats(-5, 5),
)


@settings(max_examples=150)
@given(
    rows=st.lists(
        st.tuples(st.tuples(*[garbage] * 5), st.one_of(garbage, st.just(DT_S))), min_size=1, max_size=40
    ),
    repeats=st.integers(1, 80),
    gate=st.sampled_from([0.9999, 1.0]),
)
def test_estimates_stay_finite_for_arbitrary_measurements(rows, repeats, gate):
    z = np.repeat([row for row, _ in rows], repeats, axis=0)
    time_s = np.repeat([dt for _, dt in rows], repeats)
    with np.errstate(all="ignore"):
        time_s = np.cumsum(np.where(np.isfinite(time_s), time_s, DT_S)) + np.arange(len(z)) * DT_S
    track = run_filter(FLIGHT, time_s, z, FilterSettings(gate_probability=gate))
    assert np.isfinite(track.mean).all()
    assert np.isfinite(track.cov).all()
    assert (track.cov.diagonal(axis1=1, axis2=2) > 0).all()
    assert np.isfinite(track.log_likelihood)
    assert not (track.nis < 0).any()
    assert (np.diff(track.time_s) > 0).all()


def test_what_does_not_fit_is_refused():
    for changes, message in (
        ({"process_variance": np.ones((2, 3))}, r"process_variance has shape \(2, 3\), finite \(2, 2\)"),
        ({"process_variance": [1.0, np.inf]}, "process_variance has shape .*, finite"),
        ({"process_variance": [1.0, -1.0]}, "process_variance is no covariance: its least eigenvalue is -1"),
        ({"initial_variance": [1.0, 0.0]}, "initial_variance is no covariance"),
        ({"measurement_variance": [1.0, 0.0]}, "measurement_variance must be above zero"),
        ({"measurement_variance": np.ones(3)}, r"measurement_variance has shape \(3,\), finite \(2,\)"),
        ({"initial_mean": np.zeros(3)}, r"initial_mean has shape \(3,\), finite \(2,\) is needed"),
        ({"states": ("position_m", "speed")}, "state or row 'speed' does not end in a known unit"),
        ({"states": ("position_m", "position_m")}, "have one twice"),
        ({"sensors": (("place", ("place_m",)),)}, "its sensors must hold every row once"),
        ({"references": ("camera",)}, "references name {'camera'}, none of place, rate"),
        ({"jumps": (("camera", "position_m"),)}, "jumps name {'camera'}, none of place, rate"),
        ({"observe": drift}, "observe must be @njit, and take"),
        ({"propagate": print}, "propagate must be @njit, and take"),
    ):
        with pytest.raises(ConfigError, match=f"filter carriage: .*{message}"):
            carriage(**changes)
    for z, variance, message in (
        (np.zeros((3, 4)), None, r"z has shape \(3, 4\), \(3, 2\) is needed"),
        (np.zeros((3, 2)), np.ones((4, 2)), r"variance has shape \(4, 2\)"),
    ):
        with pytest.raises(DataError, match=f"filter carriage: {message}"):
            run_filter(CARRIAGE, np.arange(3.0), z, variance=variance)


stamp_steps = st.one_of(st.floats(-0.05, 0.1), st.sampled_from([0.0, 0.02, 3.0, -3.0, np.nan, np.inf, 1e300]))


@settings(deadline=None, max_examples=30)
@given(st.lists(stamp_steps, min_size=1, max_size=30), st.integers(0, 9))
def test_a_snapshot_goes_on_as_the_filter_it_was_taken_of(steps, seed):
    rng = np.random.default_rng(seed)
    session, other, last_s = Filter(FLIGHT), Filter(FLIGHT), 0.0
    for step_s in steps:
        time_s = last_s + step_s
        last_s = time_s if abs(step_s) < 10.0 else last_s
        z = np.where(rng.random(5) < 0.2, np.nan, rng.normal([1000.0, 0.3, 1.0, 0.0, 0.0], 0.1))
        variance = rng.uniform(0.01, 0.1, 5) if rng.random() < 0.5 else None
        other.state[:] = session.state
        follows, before_s = session.follows(time_s), session.state["time_s"][0]
        taken = session.step(time_s, z, variance)
        assert taken == other.step(time_s, z, variance) == (follows != 0)
        assert taken == (session.state["time_s"][0] == time_s and before_s != time_s)
        assert not taken or (follows < 0) == (time_s < before_s)
        assert session.state.tobytes() == other.state.tobytes()
