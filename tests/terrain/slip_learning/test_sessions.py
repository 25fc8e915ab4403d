"""Slip by session: how often its interval contains a new session's slip, and what few sessions do not show."""

import math

import numpy as np
import pytest

from terrain.slip_learning.sessions import IntervalOf, session_slips


def drawn(rng, n_sessions, middle=0.1, between=0.02, within=0.05, n_runs=20):
    """Return slip and session of runs whose sessions differ."""
    session = np.repeat(np.arange(n_sessions), n_runs)
    slip = middle + rng.normal(0, between, n_sessions)[session] + rng.normal(0, within, session.size)
    return slip, session.astype(str)


@pytest.mark.parametrize("n_sessions", [3, 5])
def test_a_new_session_is_inside_as_often_as_stated(n_sessions):
    inside, by_runs, rng = 0, 0, np.random.default_rng(n_sessions)
    for _ in range(400):
        slip, session = drawn(rng, n_sessions + 1)
        new = np.median(slip[session == str(n_sessions)])
        slip, session = slip[session != str(n_sessions)], session[session != str(n_sessions)]
        found = session_slips({"mud": (slip, session)}, rng)["mud"]
        assert (found.interval_of, found.n_sessions) == (IntervalOf.NEW_SESSION, n_sessions)
        inside += found.interval[0] <= new <= found.interval[1]
        low, high = session_slips({"mud": (slip, np.full(slip.size, ""))}, rng)["mud"].interval
        by_runs += low <= new <= high
    assert 0.90 <= inside / 400 <= 0.98
    assert by_runs / 400 < 0.7  # the interval over runs, as of one session, does not hold


def test_surfaces_with_few_sessions_take_how_sessions_differ_from_all():
    inside, rng = np.zeros(2), np.random.default_rng(0)
    for _ in range(2000):
        surfaces = {"ice": drawn(rng, 3), "mud": drawn(rng, 3, 0.3), "sand": drawn(rng, 2, 0.5)}
        new = {}
        for name in ("mud", "sand"):
            slip, session = surfaces[name]
            new[name] = np.median(slip[session == "0"])
            surfaces[name] = slip[session != "0"], session[session != "0"]
        found = session_slips(surfaces, rng)
        assert [found[name].interval_of for name in new] == [IntervalOf.POOLED] * 2
        inside += [found[name].interval[0] <= new[name] <= found[name].interval[1] for name in new]
    assert inside / 2000 == pytest.approx(0.95, abs=0.02)


def test_two_sessions_alone_show_a_range_and_one_nothing_of_another():
    rng = np.random.default_rng(0)
    runs, session = np.array([0.1, 0.2, 0.3, 0.5]), np.array(["a", "a", "b", "b"])
    two = session_slips({"mud": (runs, session)}, rng)["mud"]
    assert (two.interval_of, two.n_sessions) == (IntervalOf.RANGE, 2)
    assert (two.slip_ratio, *two.interval) == pytest.approx((0.275, 0.15, 0.4))
    assert two.std == pytest.approx(np.std([0.15, 0.4], ddof=1) * math.sqrt(1.5))
    one = session_slips({"mud": (runs, np.full(4, ""))}, rng)["mud"]
    assert (one.interval_of, one.n_sessions) == (IntervalOf.ONE_SESSION, 1)
    assert one.interval[0] <= one.slip_ratio <= one.interval[1]
    three = session_slips({"mud": (runs[:3], np.array(["a", "b", "c"]))}, rng)["mud"]
    for normal in (one, three):
        assert 2 * 1.959964 * normal.std == pytest.approx(np.ptp(normal.interval))
    apart = session_slips({"mud": (np.array([-0.9, 0.0, 0.9]), np.array(["a", "b", "c"]))}, rng)["mud"]
    assert apart.interval == (-1.0, 1.0)  # no slip is beyond
    unlabelled = session_slips({"": (runs, np.arange(4).astype(str)), "mud": (runs, session)}, rng)
    assert unlabelled["mud"].interval_of is IntervalOf.RANGE  # runs on no one surface show none of it
    single, none = (session_slips({"mud": (runs[:n], session[:n])}, rng)["mud"] for n in (1, 0))
    assert np.isnan([*single.interval, single.std, none.slip_ratio, *none.interval]).all()
