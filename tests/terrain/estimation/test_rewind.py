"""Samples that come late: the numbers of samples in order, to the last bit, up to the rewind's reach."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.estimation.live import REWIND_S, LiveFilter, LiveObserver
from terrain.estimation.models.choice import make_observer
from terrain.logs.replay import replay
from terrain.records import Reading, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import PrescribedSlip
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Faults

ROBOT, UGV = load_robot("agrimaro"), load_robot("orchard_ugv")
STREAMS = ("wheels", "steering", "imu", "odometry")
PERIOD_S = 0.02
FIRST, N_MIXED, N_AFTER = 100, 25, 15
"""Steps before samples come late, with late ones, and after them."""

MOST_STEPS = 11
"""By so many steps a sample may be late: of 0.25 s, less a step and a period of the wheels."""


@cache
def samples():
    """A drive; of the IMU a sample that may come late is not finite."""
    run = simulate_run(ROBOT, "grass", "straight", 5, duration_s=6.0, faults=Faults(by_chance=False))
    imu = run.streams["imu"]
    values = np.array(imu.values)
    values[np.searchsorted(imu.time_s, (FIRST + 5) * PERIOD_S), 3] = np.nan
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    return list(replay(replace(run, streams=streams)))


def bare(sample):
    return {name: sample.readings[name] for name in STREAMS if name in sample.readings}


OBSERVED = ("wheels", "imu", "gnss", "compass")


@cache
def tracked():
    """Readings of a tracked robot, step by step, and their channels."""
    speeds = 0.5 + 0.2 * np.sin(np.arange(201)[:, None] / [20.0, 30.0])
    run = simulate(UGV, speeds, PrescribedSlip(0.85, 0.8), 4)
    streams = {name: run.streams[name] for name in OBSERVED}
    steps = [(sample.time_s, sample.readings) for sample in replay(replace(run, streams=streams))]
    return steps[: FIRST + N_MIXED + N_AFTER], {name: stream.channels for name, stream in streams.items()}


def drive(steps, now=False, observer=None):
    """Return an estimator that was given readings step by step, and the time of each where `now` says so."""
    estimator = LiveFilter(ROBOT)
    if observer is not None:
        estimator = LiveObserver(make_observer(observer, UGV), UGV, tracked()[1])
    for time_s, readings in steps:
        estimator.step(readings, time_s if now else None)
    return estimator


def in_order():
    return [(sample.time_s, bare(sample)) for sample in samples()[: FIRST + N_MIXED + N_AFTER]]


def delayed(delays_of, steps=None):
    """Return steps whose readings come later, by stream a number of steps for each of the mixed ones.

    What is late of the wheels keeps its order: the next sample comes no earlier.
    """
    steps = steps or in_order()
    arrivals = [(time_s, {name: [] for name in (*STREAMS, *OBSERVED)}) for time_s, _ in steps]
    last = dict.fromkeys((*STREAMS, *OBSERVED), 0)
    for k, (_, readings) in enumerate(steps):
        for name, reading in readings.items():
            mixed = name in delays_of and 0 <= k - FIRST < N_MIXED
            at = k + delays_of[name][k - FIRST] if mixed else k
            last[name] = max(at, last[name])
            arrivals[last[name] if name == "wheels" else at][1][name].append(reading)
    return [
        (
            time_s,
            {
                name: Reading(
                    np.concatenate([reading.time_s for reading in came]),
                    np.concatenate([reading.values for reading in came]),
                )
                for name, came in by_stream.items()
                if came
            },
        )
        for time_s, by_stream in arrivals
    ]


def assert_same(estimator, expected):
    for one, other in zip(estimator.latest, expected.latest, strict=True):
        np.testing.assert_array_equal(one, other)
    assert estimator.health == expected.health
    of_lateness = {"came late", "ticks without wheels"}
    counts, expected_counts = (
        {kind: n for kind, n in one.dropped.items() if kind not in of_lateness}
        for one in (estimator, expected)
    )
    assert counts == expected_counts
    if isinstance(estimator, LiveFilter):
        for one, other in zip(estimator._snapshot(), expected._snapshot(), strict=True):
            assert one.tobytes() == other.tobytes()


@cache
def undelayed(now=False):
    return drive(in_order(), now)


delays = st.lists(st.integers(0, MOST_STEPS), min_size=N_MIXED, max_size=N_MIXED)


@settings(deadline=None, max_examples=60)
@given(st.dictionaries(st.sampled_from(STREAMS[1:]), delays, min_size=1))
def test_late_sensors_give_the_numbers_of_sensors_in_time(delays_of):
    estimator = drive(delayed(delays_of))
    assert_same(estimator, undelayed())


@settings(deadline=None, max_examples=60)
@given(delays, st.dictionaries(st.sampled_from(STREAMS[1:]), delays), st.booleans())
def test_late_wheels_give_the_numbers_of_wheels_in_time(wheels, delays_of, now):
    """Ticks without wheels, which were done for want of them, leave nothing behind."""
    estimator = drive(delayed({**delays_of, "wheels": wheels}), now)
    assert_same(estimator, undelayed(now))


@pytest.mark.parametrize("name", ["tracked", "slip-learning", "gyrodometry"])
def test_an_observer_takes_late_samples_as_those_in_time(name):
    steps, _ = tracked()
    expected = drive(steps, observer=name)
    for seed in range(4):
        most = (1, MOST_STEPS)[
            seed % 2
        ]  # of one step: fixes are stamped as the tick before, but for how they round
        drawn = np.random.default_rng(seed).integers(0, most + 1, (3, N_MIXED)).tolist()
        delays_of = dict(zip(OBSERVED[1 : 4 - seed // 2], drawn, strict=False))
        assert_same(drive(delayed(delays_of, steps), observer=name), expected)


@pytest.mark.parametrize("name", STREAMS)
def test_what_comes_later_than_the_reach_is_counted_and_changes_nothing(name):
    """Three readings that come 0.3 s late, or never."""
    n_late = int(REWIND_S / PERIOD_S) + 3
    steps = in_order()
    without = [
        (time_s, {other: r for other, r in readings.items() if other != name or not 0 <= k - FIRST < 3})
        for k, (time_s, readings) in enumerate(steps)
    ]
    never, late, n_samples = drive(without), LiveFilter(ROBOT), 0
    for k, (_, readings) in enumerate(without):
        if 0 <= k - n_late - FIRST < 3:
            before = late.latest
            too_late = steps[k - n_late][1][name]
            assert late.step({name: too_late}) == []
            assert late.latest is before
            n_samples += too_late.time_s.size
        late.step(readings)
    kind = "time did not advance" if name == "wheels" else f"{name}: stamp does not increase"
    assert n_samples >= 3
    assert late.dropped[kind] - never.dropped.get(kind, 0) == n_samples
    for one, other in zip(late.latest, never.latest, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_wheels_ticks_go_on_by_the_callers_time_and_uncertainty_grows():
    estimator, times_s, stds = LiveFilter(ROBOT), [], []
    for sample in samples():
        readings = bare(sample)
        if sample.time_s > 2.0:
            readings.pop("wheels", None)
        estimator.step(readings, sample.time_s)
        if estimator.latest is not None:
            times_s.append(estimator.latest.time_s)
            stds.append(estimator.latest.std[estimator.states.index("slip_speed_1_mps")])
    times_s, stds = np.array(times_s), np.array(stds)
    gone = times_s > 2.03
    assert np.diff(times_s[gone]).max() < 2.1 * PERIOD_S
    assert samples()[-1].time_s - times_s[-1] < 2.0 * PERIOD_S
    assert estimator.dropped["ticks without wheels"] == len(set(times_s[gone]))
    assert stds[-1] > 2.0 * stds[~gone][-1]
    assert np.isnan(estimator.latest.motor_radps).all()


def test_a_stamp_far_ahead_does_not_end_the_wait_for_its_stream():
    """The IMU's stamps are an hour ahead once; later, its samples come three steps after the wheels'."""
    estimator, settled = LiveFilter(ROBOT), []
    for k, (_, readings) in enumerate(delayed({"imu": [3] * N_MIXED})):
        if k == FIRST - 10:
            readings = dict(readings, imu=Reading(readings["imu"].time_s + 3600.0, readings["imu"].values))
        settled += estimator.step(readings)
    expected, in_time = LiveFilter(ROBOT), []
    for k, (_, readings) in enumerate(in_order()):
        if k == FIRST - 10:
            readings = {name: reading for name, reading in readings.items() if name != "imu"}
        in_time += expected.step(readings)
    means = {estimate.time_s: estimate.mean for estimate in in_time}
    assert len(settled) > FIRST + N_MIXED - 5
    assert (np.diff([estimate.time_s for estimate in settled]) > 0.0).all()
    for estimate in settled[: FIRST + N_MIXED - 5]:  # after that the last late ones come out of order
        np.testing.assert_array_equal(estimate.mean, means[estimate.time_s])
