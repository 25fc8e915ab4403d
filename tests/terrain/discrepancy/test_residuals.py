"""Measured, predicted and sensitivities behind one low-pass."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from terrain.discrepancy.compared import binned_means, noise_spectrum, run_means, spectrum
from terrain.discrepancy.evidence import evidence_at
from terrain.discrepancy.noise import noise_of
from terrain.discrepancy.runs import (
    SETTLE_S,
    Signals,
    Simulation,
    decimate,
    low_pass_of,
    measured_channels,
    prepare_inputs,
    rows_of,
    signals_of,
)
from terrain.effects import CHANNELS, INDEX, ONE_SIDED, SPEED_X, STEPS, vector_of
from terrain.errors import DataError
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, replay, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions

ROBOTS = {"husky": load_robot("husky"), "agrimaro": load_robot("agrimaro")}
HIDDEN = {
    "husky": {
        "payload_ratio": 0.2,
        "effective_track_ratio": 0.3,
        "camera_latency_s": 0.06,
        "clock_offset_s": 0.1,
    },
    "agrimaro": {
        "payload_ratio": 0.2,
        "steering_offset_2_rad": 0.05,
        "encoder_lag_s": 0.05,
        "lever_x_m": 0.1,
    },
}
NOISE = np.array([0.01, 0.005, 0.005, 0.1, 1.0, 1.0, 0.02])
"""About what sensors of these robots show of nothing."""


def drive(robot, effects):
    t = np.arange(1501) / 50
    start = np.minimum(t, 1.0)
    speed = 0.5 * np.sin(0.8 * t) + 0.2 * np.sin(1.9 * t)
    twist = np.column_stack([speed, np.zeros_like(t), 0.3 * np.sin(1.1 * t)]) * start[:, None]
    if robot is ROBOTS["agrimaro"]:
        twist[:, 0] += 0.7 * start  # where it stops, its steering turns in no time
    return simulate(
        robot,
        twist,
        Ground(),
        1,
        effects=effects,
        heading=robot is ROBOTS["husky"],
        conditions=Conditions(grade_ratio=(0.05, 0.02), undulation_ratio=0.02),
    )


@pytest.fixture(scope="module", params=ROBOTS)
def looked_at(request):
    """Robot, its simulation, and the signals of a noise-free drive with effects hidden."""
    robot = ROBOTS[request.param]
    effects = HIDDEN[request.param]
    return Simulation(robot), effects, signals_of(drive(robot, effects), robot)


def test_the_right_effects_leave_a_small_residual_and_none_a_large_one(looked_at):
    simulation, effects, signals = looked_at
    low_pass = low_pass_of([signals])
    right, wrong = (
        rows_of(signals, simulation.planar, vector_of(values), (), low_pass) for values in (effects, {})
    )
    there = np.isfinite(right.residual).any(axis=0)
    left, much = (np.sqrt(np.nanmean((r.residual / NOISE)[:, there] ** 2, axis=0)) for r in (right, wrong))
    assert left.max() < 0.15
    assert much.max() > 3.0
    assert measured_channels([right]) == tuple(np.array(CHANNELS)[there])


def test_sensitivities_are_differences_of_full_replays(looked_at):
    """Two routes: effects of sensors alone reuse the motion, and here all is replayed."""
    simulation, effects, signals = looked_at
    low_pass, point = low_pass_of([signals])._replace(instrument_cutoff_hz=np.inf), vector_of(effects)
    names = [p.name for effect in simulation.library for p in effect.parameters][::2]
    names += ["pitch_offset_rad", "roll_offset_rad"]
    rows = rows_of(signals, simulation.planar, point, names, low_pass)
    for name, change in zip(names, rows.sensitivity, strict=True):
        step = STEPS[name]
        ahead, back = point.copy(), point.copy()
        ahead[INDEX[name]] += step
        if name not in ONE_SIDED:
            back[INDEX[name]] -= step
        far, near = (rows_of(signals, simulation.planar, p, (), low_pass).predicted for p in (ahead, back))
        expected = (far - near) / (ahead - back)[INDEX[name]]
        assert_allclose(change, expected, atol=1e-9 * np.nanmax(np.abs(expected)) + 1e-12, err_msg=name)


def test_measured_and_predicted_pass_the_same_window(looked_at):
    """A prediction that is fed back as what was measured leaves nothing, holes or none."""
    simulation, effects, signals = looked_at
    low_pass = low_pass_of([signals])
    dt, wheel_speed, steer, grade, roll, _ = prepare_inputs(signals, low_pass)
    shown = replay(simulation.planar, vector_of(effects), dt, wheel_speed, steer, grade, roll)
    own = low_pass._replace(inputs_every=0)
    fed = {"wheel_speed_mps": wheel_speed, "steer_rad": steer, "grade_rad": grade, "roll_rad": roll}
    same = replace(signals, dt_s=dt, measured=shown, **fed)
    rows = rows_of(same, simulation.planar, vector_of(effects), (), own)
    assert_array_equal(rows.measured, rows.predicted)
    holes = shown.copy()
    holes[300:320] = holes[500:503] = np.nan
    rows = rows_of(replace(same, measured=holes), simulation.planar, vector_of(effects), (), own)
    known = np.isfinite(rows.residual)
    assert 0.8 < known.mean() < 1.0
    assert_allclose(rows.residual[known], 0.0, atol=1e-12)


def test_the_window_passes_what_is_slow_and_stops_what_rows_cannot_hold():
    low_pass = low_pass_of([fake(0.02)])
    clock_hz, half = low_pass.rate_hz * low_pass.every, low_pass.taps.size // 2

    def gain(frequency_hz):
        turn = 2j * np.pi * frequency_hz / clock_hz * np.arange(-half, half + 1)
        return abs(np.sum(low_pass.taps * np.exp(turn)))

    for ratio, expected in ((0.0, 1.0), (0.4, 1.0), (1.0, 0.5)):
        assert gain(ratio * low_pass.cutoff_hz) == pytest.approx(expected, abs=0.02)
    assert max(gain(f) for f in np.linspace(1.9 * low_pass.cutoff_hz, clock_hz / 2, 50)) < 0.01


def test_decimation_is_a_convolution_and_holes_are_left_out():
    rng = np.random.default_rng(0)
    values, taps = rng.standard_normal((200, 2)), np.hamming(21) / np.hamming(21).sum()
    expected = np.column_stack([np.convolve(column, taps, mode="valid")[::4] for column in values.T])
    assert_allclose(decimate(values, np.ones((200, 0), dtype=bool), taps, 4), expected)
    assert_allclose(decimate(values, np.ones((200, 2), dtype=bool), taps, 4), expected)
    known = np.ones((200, 2), dtype=bool)
    known[50:52, 0] = False
    known[100:140, 1] = False
    decimated = decimate(np.where(known, values, np.nan), known, taps, 4)
    for row in range(len(decimated)):
        window = slice(4 * row, 4 * row + 21)
        for c in range(2):
            weight = taps * known[window, c]
            if weight.sum() >= 0.75:
                mean = np.sum(weight * np.nan_to_num(values[window, c])) / weight.sum()
                assert decimated[row, c] == pytest.approx(mean)
            else:
                assert np.isnan(decimated[row, c])
    assert np.isnan(decimated).sum(axis=0).tolist() == [0, 12]


def test_a_hole_stays_unknown_and_nothing_else_is_lost(looked_at):
    simulation, effects, signals = looked_at
    measured, wheel_speed, time_s = signals.measured.copy(), signals.wheel_speed_mps.copy(), signals.time_s
    c, point, low_pass = CHANNELS.index(SPEED_X), vector_of(effects), low_pass_of([signals])
    measured[(time_s > 8.0) & (time_s < 11.0), c] = np.nan
    wheel_speed[(time_s > 15.0) & (time_s < 16.0)] = np.nan
    holes = replace(signals, measured=measured, wheel_speed_mps=wheel_speed)
    rows, before = (
        rows_of(run, simulation.planar, point, ["payload_ratio"], low_pass) for run in (holes, signals)
    )
    assert np.isnan(rows.measured[(rows.time_s > 8.3) & (rows.time_s < 10.7), c]).all()
    assert np.isnan(rows.measured[(rows.time_s > 15.3) & (rows.time_s < 15.7)]).all()
    assert np.isfinite(rows.predicted[:, c]).all()
    assert np.isfinite(rows.sensitivity).all()
    away = (np.abs(rows.time_s - 9.5) > 2.5) & (np.abs(rows.time_s - 15.5) > 1.5)
    assert_allclose(rows.residual[away, c], before.residual[away, c], atol=2e-3)


def fake(dt_s, run_id="a", n=400):
    """Return signals of a robot that rolls."""
    still = np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros((n, len(CHANNELS)))
    return Signals(run_id, "", dt_s, 0.0, np.full((n, 2), 0.5), *still)


def test_the_slowest_clock_sets_the_low_pass_whichever_run_has_it():
    fast, slow = fake(0.02), fake(0.0208, "b")
    assert (
        low_pass_of([fast, slow]).rate_hz == low_pass_of([slow, fast]).rate_hz < low_pass_of([fast]).rate_hz
    )
    crawling = low_pass_of([fake(0.1)])  # 10 Hz
    assert (crawling.cutoff_hz, crawling.inputs_every) == (pytest.approx(2.0), 0)
    with pytest.raises(DataError, match="b is on a clock of 10 Hz, a on one of 50 Hz; clocks within 5% of"):
        low_pass_of([fast, fake(0.1, "b")])


def test_noise_of_the_wheels_is_not_attributed_to_a_mass_or_a_motor():
    """At one speed the wheels' acceleration is all noise, in the residual and in what a mass would change."""
    robot = ROBOTS["agrimaro"]
    time_s = np.arange(2001) / 50
    twist = np.zeros((time_s.size, 3))
    twist[:, 0] = np.clip(0.5 * time_s, 0.0, 0.7)
    runs = [
        simulate(robot, twist, Ground(), seed, noise=spread_numbers("noise"), run_id=str(seed))
        for seed in range(6)
    ]
    signals, simulation = [signals_of(run, robot) for run in runs], Simulation(robot)
    low_pass = low_pass_of(signals)
    off = {}
    for instrument_cutoff_hz in (low_pass.instrument_cutoff_hz, np.inf):
        same = low_pass._replace(instrument_cutoff_hz=instrument_cutoff_hz)
        names = ["motor_constant_ratio", "rolling_resistance_ratio", "accel_bias_mps2"]
        info = evidence_at(signals, simulation, simulation.vector, names, same)
        change, cov = info.fit(names)
        off[instrument_cutoff_hz] = change[0], change[0] / np.sqrt(cov[0, 0])
    assert off[np.inf][1] < -4.0
    assert abs(off[low_pass.instrument_cutoff_hz][0]) < 0.5 * abs(off[np.inf][0])
    assert abs(off[low_pass.instrument_cutoff_hz][1]) < 3.0


@pytest.mark.parametrize(
    ("seconds", "moving", "lost_s"), [(6.0, False, 0.0), (6.0, True, SETTLE_S), (20.0, False, SETTLE_S)]
)
def test_the_start_of_a_short_run_is_kept_where_it_begins_in_steady_motion(seconds, moving, lost_s):
    """Its one change of command is there."""
    run = fake(0.02, n=round(seconds / 0.02))
    wheel_speed = run.wheel_speed_mps.copy()
    wheel_speed[:, 0] += 0.3 * np.clip(run.time_s / 0.3, 0.0, 1.0) * moving
    low_pass = low_pass_of([run])
    cut = replace(run, wheel_speed_mps=wheel_speed)
    rows = rows_of(cut, Simulation(ROBOTS["husky"]).planar, vector_of({}), (), low_pass)
    centre_s = low_pass.taps.size // 2 * cut.dt_s * max(low_pass.inputs_every, 1)
    assert rows.time_s[0] == pytest.approx(centre_s + lost_s, abs=1.0 / low_pass.rate_hz)


# -- Spectra of residuals, and their means with intervals --------------------------------------------------

RATE_HZ = 6.25


def coloured(n, seed, keep=0.7):
    white = np.random.default_rng(seed).standard_normal(n)
    for i in range(1, n):
        white[i] += keep * white[i - 1]
    return white


def test_the_spectrum_of_coloured_noise_is_that_of_the_filter_that_whitens_it():
    """Two routes: averaged periodograms, and the fitted autoregression; both hold the variance."""
    residuals = [coloured(4000, seed) for seed in range(8)]
    noise = noise_of([r[:, None] for r in residuals], [np.ones(4000)] * 8, 0.2, 0)
    frequency, power = spectrum(residuals, RATE_HZ)
    fitted = noise.size(np.ones(1))[0, 0] ** 2 * noise_spectrum(noise.filters[0], frequency, RATE_HZ)
    inner = slice(1, -1)
    # 8 x 124 segments, half of them overlapping: 5 % of scatter in a bin, four times that allowed
    np.testing.assert_allclose(power[inner], fitted[inner], rtol=0.2)
    fine = np.linspace(0, RATE_HZ / 2, 4000)
    held = noise_spectrum(noise.filters[0], fine, RATE_HZ).mean() * RATE_HZ / 2
    assert held == pytest.approx(1.0, rel=0.05)


def test_a_hole_splits_a_spectrum_and_short_runs_use_short_segments():
    whole = coloured(2000, 1)
    holed = np.concatenate([whole[:1000], [np.nan], whole[1000:]])
    parts = spectrum([whole[:1000], whole[1000:]], RATE_HZ)
    assert_allclose(spectrum([holed], RATE_HZ)[1], parts[1])
    assert np.isnan(spectrum([whole[:7]], RATE_HZ)[1]).all()
    white = np.random.default_rng(3).standard_normal(40 * 300)
    frequency, power = spectrum([*np.split(white, 300), np.full(5, np.nan)], RATE_HZ)
    assert_allclose(frequency, np.fft.rfftfreq(32, 1 / RATE_HZ)[1:])
    assert_allclose(power[:-1], 2.0 / RATE_HZ, rtol=0.3)
    assert spectrum([*np.split(white, 300), white], RATE_HZ)[0][0] == pytest.approx(RATE_HZ / 64)


def test_intervals_of_zero_mean_noise_have_their_nominal_coverage():
    n_seeds, missed_runs, missed_bins = 60, [], []
    for seed in range(n_seeds):
        residuals = [coloured(400, 1000 * seed + i) for i in range(6)]
        mean, half = run_means(residuals, [np.ones(400)] * 6, np.array([1.0, -0.7]))
        missed_runs.extend(np.abs(mean) > half)
        ramps = [np.linspace(0, 1, 400)] * 6
        _, means, halves = binned_means(ramps, residuals)
        missed_bins.extend(np.abs(means) > halves)
    # 360 of either; bins of one seed have little in common
    assert 0.02 < np.mean(missed_runs) < 0.09
    assert 0.02 < np.mean(missed_bins) < 0.09


def test_bins_require_rows_and_intervals_require_runs():
    x = np.linspace(0, 1, 200)
    centres, means, halves = binned_means([x, x], [np.ones(200), np.full(200, np.nan)])
    assert len(centres) == 6
    assert np.isnan(halves).all()
    assert_allclose(means, 1.0)
    assert binned_means([np.full(9, np.nan)], [np.ones(9)])[0].size == 0
