from types import SimpleNamespace

import numpy as np
import pytest

from terrain.classify.response import ResponseColumns
from terrain.errors import DataError
from terrain.slip_learning import currents
from terrain.slip_learning.currents import PredictedSlip, SlipRegressor

WHEELS = np.radians([150.0, 270.0, 390.0])
COLUMNS = ResponseColumns(3, 3)
DRAG = {"cork": 0.2, "moss": 0.5}
SLIP = {"cork": 0.1, "moss": 0.4}


def data_of(rng, n_runs, windows=4):
    """Return windows whose slip depends on ground and direction, and with currents that scatter alike."""
    rows, slips, names, groups = [], [], [], []
    for number in range(n_runs):
        terrain = ("cork", "moss")[number % 2]
        direction, off = rng.uniform(-np.pi, np.pi), rng.normal(0.0, 0.03)
        for _ in range(windows):
            speed = 0.1 * np.cos(WHEELS - direction)
            current = 0.3 + DRAG[terrain] * np.abs(speed) / 0.1 + off + rng.normal(0.0, 0.02, 3)
            rows.append(np.concatenate([speed, current]))
            slips.append(SLIP[terrain] * (1 + 0.2 * np.cos(3 * direction)) + off + rng.normal(0.0, 0.01))
            names.append(terrain)
            groups.append(f"{terrain}_{number}")
    return np.array(rows), np.array(slips), np.array(names), np.array(groups)


@pytest.fixture(scope="module")
def fitted():
    X, slip, terrain, groups = data_of(np.random.default_rng(0), 80)
    return SlipRegressor(COLUMNS).fit(X, slip, terrain, groups)


def test_slip_is_predicted_within_its_interval(fitted):
    X, slip, terrain, _ = data_of(np.random.default_rng(1), 200, windows=1)
    found = fitted.predict_slip(X)
    assert np.sqrt(np.mean((found.slip_ratio - slip) ** 2)) < 0.03
    assert 0.9 <= np.mean((slip >= found.low) & (slip <= found.high)) <= 0.99
    assert np.abs(np.mean(found.slip_ratio - slip)) < 0.01
    assert (found.slip_ratio[terrain == "moss"] > 0.2).all()


def test_a_current_that_is_off_moves_the_slip_that_goes_with_it(fitted):
    """The same scatter is in slip and currents: knowing it is worth more than the mean of the ground."""
    X, slip, _, _ = data_of(np.random.default_rng(2), 200, windows=1)
    alone = np.array(X)
    alone[:, 3:] = np.nan
    with_currents = fitted.predict_slip(X)
    without = fitted.predict_slip(alone)
    assert np.std(with_currents.slip_ratio - slip) < 0.5 * np.std(without.slip_ratio - slip)
    assert (without.high - without.low > with_currents.high - with_currents.low).mean() > 0.95
    # the deviation holds how far the grounds' means are apart, where nothing tells the ground
    for found in (with_currents, without):
        error = np.sqrt(np.mean((found.slip_ratio - slip) ** 2))
        assert np.sqrt(np.mean(found.slip_std**2)) == pytest.approx(error, rel=0.25)


def test_a_standing_robot_has_no_slip_and_nothing_to_learn_from_is_refused(fitted):
    X = np.zeros((2, 6))
    X[1, 0] = np.nan
    assert np.isnan(np.array(fitted.predict_slip(X))).all()
    with pytest.raises(DataError, match="no window has a measured slip"):
        SlipRegressor(COLUMNS).fit(np.ones((3, 6)), np.full(3, np.nan))


def test_the_interval_of_an_error_is_over_sessions_where_there_are_several():
    run, error = np.repeat(np.arange(30), 4), np.repeat([0.01, 0.05, 0.03], 40)
    zero, terrain = np.zeros(120), np.full(120, "mud")
    predicted = PredictedSlip(*np.stack([error, zero, error - 1.0, error + 1.0]))

    def interval(session):
        cases = SimpleNamespace(slip=zero, run_id=run, session=session, terrain=terrain)
        return currents._figures("runs", cases, predicted, np.random.default_rng(0)).rms_interval

    low, high = interval(run // 10)
    assert high - low > 3.0 * np.ptp(interval(np.zeros(120)))
    assert (low, high > 0.05) == (0.0, True)  # by Student's t of three, which none of them bounds


def test_a_terrain_of_fewer_runs_than_show_how_runs_differ_is_not_learned():
    X, slip, terrain, groups = data_of(np.random.default_rng(3), 40)
    rare = np.array(terrain)
    rare[groups == groups[-1]] = "sand"  # one run
    assert SlipRegressor(COLUMNS).fit(X, slip, rare, groups).terrains_.tolist() == ["cork", "moss"]
    few = np.isin(groups, np.unique(groups)[:2])
    with pytest.raises(DataError, match="no terrain has 3 runs"):
        SlipRegressor(COLUMNS).fit(X[few], slip[few], terrain[few], groups[few])
