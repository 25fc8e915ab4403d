"""The slip model identified while driving: hidden numbers come back, what is not excited stays unknown."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.calibration.odometry import odometry_rows
from terrain.errors import ConfigError
from terrain.estimation.observers.family import ObserverStatus, observe
from terrain.estimation.observers.slip_learning import (
    LearningSettings,
    learned_model,
    slip_learning_observer,
    unknown_ground,
)
from terrain.estimation.observers.slip_model import PARAMETERS, SlipModel
from terrain.robots import load_robot
from terrain.simulation.tracked import PrescribedSlip, Slope, simulate_tracked

ROBOT = load_robot("patako")
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
OBSERVER = slip_learning_observer(ROBOT, EXACT)


def course(laps):
    """Straights and tight turns to both sides."""
    parts = []
    for k in range(laps):
        pair = (0.05, 0.25) if k % 2 == 0 else (0.25, 0.05)
        parts += [np.tile([0.2, 0.2], (250, 1)), np.tile(pair, (300 + 20 * (k % 3), 1))]
    return np.concatenate(parts)


def rows_of(run, every=1):
    """Rows of the observer: fixes with headings at their ticks, every so many."""
    time_s, own = odometry_rows(run, ROBOT)
    rows = np.column_stack([own, np.full((len(own), 3), np.nan)])
    at = np.searchsorted(time_s, run.streams["gnss"].time_s[::every] - 1e-6)
    rows[at, 5:7] = run.streams["gnss"].values[::every, :2]
    rows[at, 7] = run.streams["compass"].values[::every, 0]
    return time_s, rows


def parameters(observer, memory):
    found = observer.read(observer.params, memory)
    return dict(zip(PARAMETERS, zip(found.mean[6:], found.std[6:], strict=True), strict=True))


def learned(observer, time_s, rows):
    memory = observer.start
    for dt_s, row in zip(np.diff(time_s, prepend=time_s[0]).tolist(), rows, strict=True):
        memory = observer.step(observer.params, memory, row, dt_s)
    return memory


@pytest.mark.parametrize(("seed", "every"), [(0, 1), (1, 1), (2, 20)])
def test_hidden_slip_comes_back_within_its_stated_error(seed, every):
    run = simulate_tracked(ROBOT, HIDDEN, course(40), seed, slope=Slope(0.2, 0.7))
    found = parameters(OBSERVER, learned(OBSERVER, *rows_of(run, every)))
    names = [name for name in TRUE if every == 1 or name != "turning_exponent"]  # n needs more
    for name in names:
        mean, std = found[name]
        assert abs(mean - TRUE[name]) < 3 * std, (name, mean, std)
    assert found["compaction_slip_ratio"][1] < 0.02
    if every == 1:
        assert found["turning_exponent"][1] < 0.14
        assert found["grade_slip_ratio"][1] < 0.1


def test_gyro_and_encoders_alone_show_the_distance_of_the_tracks_and_no_more():
    run = simulate_tracked(ROBOT, HIDDEN, course(6), 3)
    time_s, rows = rows_of(run)
    rows[:, 5:] = np.nan
    track = observe(OBSERVER, time_s, rows)
    assert (track.status == ObserverStatus.STARTING).all()
    known = {name: bool(np.isfinite(track.state(name)[-1])) for name in PARAMETERS}
    assert [name for name, is_known in known.items() if is_known] == ["track_ratio"]
    assert track.state("track_ratio")[-1] == pytest.approx(1 / (0.65 * 0.92), abs=0.1)


def test_straight_level_motion_shows_nothing_of_turns_and_slopes():
    run = simulate_tracked(ROBOT, HIDDEN, np.tile([0.2, 0.2], (1500, 1)), 4)
    found = parameters(OBSERVER, learned(OBSERVER, *rows_of(run)))
    assert abs(found["compaction_slip_ratio"][0] - 0.08) < 3 * found["compaction_slip_ratio"][1]
    for name in ("turning_exponent", "grade_slip_ratio", "side_slip_ratio", "angle_roll_rad", "track_ratio"):
        assert np.isnan(found[name][0])


def test_jumps_are_rejected_and_a_lasting_one_resets_the_pose_only():
    run = simulate_tracked(ROBOT, HIDDEN, course(4), 5)
    time_s, rows = rows_of(run)
    rows[400, 5:7] += 5.0  # one fix of 10 Hz
    rows[800:, 5] += 3.0
    track = observe(OBSERVER, time_s, rows)
    assert track.status[400] == ObserverStatus.REJECTED
    assert (track.status[800:890:5] == ObserverStatus.REJECTED).sum() == 9
    assert (track.status == ObserverStatus.RESET).sum() == 1
    assert np.nanmax(np.abs(np.diff(track.state("compaction_slip_ratio"))[780:])) < 0.01
    truth = run.streams["pose"].values[::2][: len(time_s)]
    assert np.abs(track.mean[-1, :2] - truth[-1, :2] - [3.0, 0.0]).max() < 0.06


def test_what_was_learned_makes_odometry_and_settings_are_checked():
    run = simulate_tracked(ROBOT, HIDDEN, course(40), 6, slope=Slope(0.2, 0.7))
    memory = learned(OBSERVER, *rows_of(run))
    model = learned_model(OBSERVER.params, memory)
    assert model.turning_exponent == parameters(OBSERVER, memory)["turning_exponent"][0]
    again = slip_learning_observer(ROBOT, model)
    assert np.isfinite(again.start).all()
    with pytest.raises(ConfigError, match="fix_std_m is 0"):
        slip_learning_observer(ROBOT, settings=LearningSettings(fix_std_m=0.0))
    with pytest.raises(ConfigError, match="turning_exponent has no standard deviation"):
        slip_learning_observer(ROBOT, SlipModel())
