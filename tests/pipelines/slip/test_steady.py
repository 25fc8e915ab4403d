from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from pipelines.cli.main import app
from pipelines.data.datasets import load_runs
from pipelines.slip.learn_slip import learn_slip_table
from terrain.control.measured_table import FEW_RUNS, NO_PEAK
from terrain.control.slip_table import load_slip_table
from terrain.errors import DataError
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream, TargetStatus
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOTINO = load_robot("robotino")


@pytest.fixture(scope="module")
def runs(omni_run):
    rng = np.random.default_rng(0)
    slips = rng.normal(0.3, 0.02, 12)
    sessions = {"monday": slips, "friday": slips + 0.1}
    return [
        *(
            omni_run(rng, f"moss_{name}_{i}", "moss", 0.3 * i, slip, 0.6, name)
            for name, each in sessions.items()
            for i, slip in enumerate(each)
        ),
        *(omni_run(rng, f"cork_{i}", "cork", 0.3 * i, 0.1, 0.6) for i in range(2)),
    ]


@pytest.fixture(scope="module")
def learned(runs):
    return learn_slip_table(runs, ROBOTINO)


def test_steady_slip_is_learned_and_what_was_not_driven_stays_assumed(tmp_path, learned):
    table = load_slip_table(learned.save(tmp_path / "table.yaml"), robot="robotino")
    moss, cork = table.targets["moss"], table.targets["cork"]
    assert moss["steady"].status is TargetStatus.ESTIMATED
    assert moss["steady"].slip_ratio == pytest.approx(0.35, abs=0.02)
    assert 0.0 < moss["steady"].slip_std < 0.05
    assert moss["steady"].n_runs == 24
    assert moss["traction"].status is TargetStatus.UNESTIMATED
    assert moss["traction"].slip_ratio >= moss["steady"].slip_ratio + 0.03
    assert {target.status for target in cork.values()} == {TargetStatus.UNESTIMATED}
    reasons = [learned.surfaces[name]["reason"] for name in ("moss", "cork")]
    assert reasons == [NO_PEAK, FEW_RUNS]


def test_the_thrust_of_a_point_is_that_of_its_current(learned):
    motors = ROBOTINO.motors
    torque = 0.6 * motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    expected = (torque - motors.friction_nm) / ROBOTINO.wheel_radius_m / (ROBOTINO.mass_kg * 9.80665 / 3)
    found = learned.surfaces["moss"]
    assert found["current_a"][0] == pytest.approx(0.6)
    assert found["thrust_ratio"][0] == pytest.approx(expected)


def test_what_a_session_costs_another_is_the_difference_that_was_hidden(learned):
    transfers = learned.transfers
    assert [(each.learned, each.driven) for each in transfers] == [("friday", "monday"), ("monday", "friday")]
    low, high = transfers[1].interval
    assert low < 0.1 < high
    assert high - low < 0.1
    assert low < transfers[1].difference < high
    assert transfers[1].difference == -transfers[0].difference
    assert (transfers[1].n_learned, transfers[1].n_driven) == (12, 12)


def test_a_session_of_few_runs_has_a_difference_without_an_interval(runs):
    for each in learn_slip_table(runs[:14], ROBOTINO).transfers:  # two of the second session
        assert abs(each.difference) > 0.05
        assert np.isnan(each.interval).all()


@pytest.mark.parametrize(("soil", "least"), [("dry_sand", 0.1), ("clay", 0.01)])
def test_slip_of_a_simulated_skid_steer_robot_is_that_of_its_truth(soil, least):
    husky = load_robot("husky")
    driven = [simulate_run(husky, soil, "straight", 3, i, duration_s=12.0) for i in range(3)]
    truths = [run.streams["truth"] for run in driven]
    late = [truth.channel("slip_left_ratio")[truth.time_s > 6.0] for truth in truths]
    truth = float(np.median(np.concatenate(late)))
    table = learn_slip_table(driven, husky)
    (row,) = table.surfaces.values()
    assert truth > least
    assert row["slip"].slip_ratio == pytest.approx(truth, abs=3 * row["slip"].std)
    assert row["slip"].std < 0.02
    assert table.targets[soil]["steady"].slip_ratio == pytest.approx(row["slip"].slip_ratio, abs=1e-4)


def test_runs_that_are_not_used_are_named(runs):
    streams = dict(runs[0].streams)
    halves = (Label(0.0, 4.0, "moss"), Label(4.0, 8.0, "cork"))
    others = [RunLog("bare", "robotino", streams), RunLog("both", "robotino", streams, halves)]
    result = learn_slip_table([*runs, *others], ROBOTINO)
    assert result.skipped == ("run bare: has no label", "run both: is on 2 terrains: moss, cork")
    assert result.n_runs == len(runs)


def test_the_picture_shows_what_is_known_over_slip(learned):
    husky = load_robot("husky")
    driven = [simulate_run(husky, "clay", "straight", 3, i, duration_s=8.0) for i in range(3)]
    bare = []
    for run in driven:
        wheels = run.streams["wheels"]
        names = [name for name in wheels.channels if not name.startswith("current")]
        values = np.column_stack([wheels.channel(name) for name in names])
        bare.append(replace(run, streams={**run.streams, "wheels": Stream(wheels.time_s, values, names)}))
    thrust, alone = "thrust of a wheel over its load", "surface"
    for table, label in (
        (learned, thrust),
        (learn_slip_table(driven, husky), thrust),
        (learn_slip_table(bare, husky), alone),
    ):
        assert table.pictures["operating_points"].panels[0].y_label == label
        known = np.isfinite([row["current_a"][0] for row in table.surfaces.values()])
        assert known.all() == (label == thrust)


def test_runs_that_show_no_slip_are_refused(runs):
    blind = replace(runs[0], run_id="a", streams={"wheels": runs[0].streams["wheels"]})
    for given, robot, sentence in (
        ([blind], ROBOTINO, "none of 1 runs has a slip; the first for this: run a: nothing"),
        ([replace(runs[0], labels=())], ROBOTINO, "none of 1 runs has a label"),
        (runs, load_robot("husky"), "of the robot 'robotino': a table is learned for one, 'husky'"),
    ):
        with pytest.raises(DataError, match=sentence):
            learn_slip_table(given, robot)


def test_the_command_writes_the_table_and_says_what_is_assumed(tmp_path, runs):
    for run in runs:
        write_run(run, tmp_path / "runs")
    command = ["learn-slip", "--robot", "robotino", "--data", str(tmp_path / "runs")]
    found = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "table.yaml")])
    assert found.exception is None, found.output
    assert "What is assumed was not measured" in found.output
    assert (tmp_path / "table.yaml").is_file()


@pytest.mark.slow
def test_measured_medians_of_the_robotino(measured):
    loaded = load_runs(measured("robotino") / "one_surface")
    result = learn_slip_table(loaded, ROBOTINO)
    slips = {name: row["slip"].slip_ratio for name, row in result.surfaces.items()}
    assert slips == pytest.approx({"table": 0.10, "brown": 0.14, "gray": 0.29, "green": 0.50}, abs=0.03)
