"""``terrain calibrate --what odometry``: on measured commands held out, and input that cannot be judged."""

import numpy as np
import pytest

from pipelines.report.results import silent
from pipelines.slip.calibrate import Settings, run
from terrain.errors import ConfigError, DataError
from terrain.estimation.models.slip_model import read_slip_model
from terrain.logs.run_folders import write_run
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import PrescribedSlip
from terrain.simulation.run import simulate


def judged(folder, **also):
    return run(Settings(data=folder, what="odometry", **{"robot": "patako", "folds": 3, **also}), silent)


@pytest.fixture(scope="module")
def turns(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("turns"), np.random.default_rng(3)
    given = PrescribedSlip(slip_ratio=0.1, turning_loss_ratio=0.5, turning_exponent=0.6)
    for k in range(6):
        belts = np.tile(rng.uniform(-0.1, 0.15, 2), (501, 1))
        write_run(simulate(load_robot("patako"), belts, given, k, run_id=f"run_{k}"), folder)
    return folder


def test_slip_that_is_known_gains_and_its_model_is_a_file(turns, tmp_path):
    result = judged(turns, out=tmp_path / "slip.yaml", lengths=(2.0, 4.0))
    assert [round(scores.length_s) for scores in result.scores] == [2, 4]
    assert result.n_runs == 6
    assert result.adaptive is None
    longer = {kind.kind: kind for kind in result.scores[1].kinds}
    assert longer["slip-compensated"].gain_encoder > 0.5
    found = result.parameters["turning_exponent"]
    assert found.low < 0.6 < found.high
    written = read_slip_model(tmp_path / "slip.yaml", "patako")
    assert written.turning_exponent == pytest.approx(found.value, rel=1e-5)


@pytest.mark.slow
def test_commands_of_the_measured_marmotte_held_out(measured):
    result = judged(measured("drive_marmotte"), robot="marmotte", folds=3)
    assert [round(scores.length_s) for scores in result.scores] == [2, 6]
    for scores, least in zip(result.scores, (0.15, 0.3), strict=True):
        kinds = {kind.kind: kind for kind in scores.kinds}
        assert kinds["slip-compensated"].gain_encoder_ci[0] > 0.5 * least
        assert kinds["slip-compensated"].gain_encoder > least
        assert kinds["slip-compensated"].gain_gyro_ci[0] > 0.0
    assert result.observed_point_m[0] == pytest.approx(-0.05, abs=0.02)
    assert result.adaptive.n_runs > 100


def test_what_cannot_be_judged_is_refused_and_a_model_that_is_there_left_as_it_is(turns, tmp_path):
    (tmp_path / "slip.yaml").write_text("mine")
    for also, error, message in (
        ({"robot": "husky"}, ConfigError, "drive 'skid_steer' has no tracks"),
        ({"lengths": (0.0,)}, ConfigError, "--lengths is 0.0: input should be greater than or equal to 0.2"),
        ({"lengths": (60.0,)}, DataError, "no run has poses"),
        ({"folds": 7}, DataError, "6 runs have legs, at least 7 are required"),
        ({"out": tmp_path / "slip.yaml"}, ConfigError, "is there already"),
    ):
        with pytest.raises(error, match=message):
            judged(turns, **also)
    assert (tmp_path / "slip.yaml").read_text() == "mine"
