"""Odometry fitted to legs: a hidden slip model comes back, folds hold whole runs, mounts are taken off."""

import numpy as np
import pytest
from studies.intervals import tracked_arcs

from terrain.calibration.odometry import (
    ENCODER,
    ENDO,
    GYRODOMETRY,
    SLIP,
    fit_odometry,
    held_out_ends,
    legs_of_poses,
    level,
    score_legs,
    without_tilt,
)
from terrain.errors import DataError
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import PrescribedSlip

PATAKO = load_robot("patako")
GIVEN = PrescribedSlip(slip_ratio=0.08, turning_loss_ratio=0.4, turning_exponent=0.7)


def of_point(pose, mount):
    """Return the pose (3,) of the observed point, for that of the body."""
    lever = complex(mount[0], mount[1])
    seen = (complex(pose[0], pose[1]) + lever * np.exp(1j * pose[2]) - lever) * np.exp(-1j * mount[2])
    return np.array([seen.real, seen.imag, pose[2]])


@pytest.fixture(scope="module")
def legs():
    return [
        leg for k, run in enumerate(tracked_arcs(PATAKO, GIVEN)) for leg in legs_of_poses(run, k, PATAKO, 2.0)
    ]


def test_a_hidden_slip_model_comes_back_within_its_own_error(legs):
    found = fit_odometry(level(SLIP), legs, PATAKO).model
    std = np.sqrt(np.diag(found.covariance))
    assert abs(found.turning_exponent - 0.7) < max(3.0 * std[0], 0.01) < 0.05
    assert abs(found.compaction_slip_ratio - 0.08) < max(3.0 * std[1], 0.002) < 0.02
    assert without_tilt(legs), "the noise of roll and pitch is no slope"
    assert found.grade_slip_ratio == 0.0
    assert not without_tilt([leg._replace(tilt_rad=leg.tilt_rad + 0.05) for leg in legs])
    track = fit_odometry(ENCODER, legs, PATAKO).model.track_ratio
    assert track == pytest.approx(1.0 / 0.6, rel=0.05)


def test_slip_that_is_known_beats_slip_that_is_not_on_runs_held_out(legs):
    ends = held_out_ends({"2 s": legs}, PATAKO, 3, 0)
    scores = score_legs(legs, {name: by["2 s"] for name, by in ends.items()}, 0)
    by_name = {kind.kind: kind for kind in scores.kinds}
    assert by_name[ENDO.name].gain_gyro > 0.5
    assert by_name[ENDO.name].gain_gyro_ci[0] > 0.0
    assert by_name[GYRODOMETRY.name].gain_gyro == 0.0
    assert all(kind.rmse_ci_m[0] <= kind.rmse_m <= kind.rmse_ci_m[1] for kind in scores.kinds)
    assert scores.n_runs == 12


def test_a_run_is_never_in_the_fit_that_predicts_it(legs):
    """A run whose poses are wrong changes what is predicted of others, not of itself."""
    legs = [leg for leg in legs if leg.run < 5]
    wrong = [leg._replace(moved=leg.moved * 5.0) if leg.run == 3 else leg for leg in legs]
    clean = held_out_ends({"2 s": legs}, PATAKO, 3, 1)[ENDO.name]["2 s"]
    spoiled = held_out_ends({"2 s": wrong}, PATAKO, 3, 1)[ENDO.name]["2 s"]
    own = np.array([leg.run == 3 for leg in legs])
    assert spoiled[own] == pytest.approx(clean[own], abs=1e-12)
    assert not np.allclose(spoiled[~own], clean[~own], atol=1e-9)


def test_the_mount_is_found_from_spins(legs):
    mount = np.array([-0.2, 0.05, 0.03])
    seen = [leg._replace(moved=of_point(leg.moved, mount)) for leg in legs]
    found = fit_odometry(level(SLIP), seen, PATAKO)
    assert found.mount == pytest.approx(mount, abs=0.02)


def test_too_little_is_refused(legs):
    with pytest.raises(DataError, match="3 legs have poses at both ends, 10 or more are required"):
        fit_odometry(ENDO, legs[:3], PATAKO)
    with pytest.raises(DataError, match="at least 20 are required for 20 folds"):
        held_out_ends({"2 s": legs}, PATAKO, 20, 0)
