"""Tracked and car-like robots, whose logs have no currents: what is theirs is named, and nothing else."""

import numpy as np
import pytest
from studies.blind_trials.drives import CAR_MPS2, STEP_HZ, car_drives, rich_drives
from studies.blind_trials.hidden import Row, cases_of, hidden_runs
from studies.blind_trials.limits import limits_of
from studies.blind_trials.trial import run_trial, simulation_of

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.faults import candidate_changes
from terrain.discrepancy.next_drive import next_command
from terrain.discrepancy.powertrain import traces_of
from terrain.discrepancy.robot_terms import in_robot_terms, value_in_robot_terms
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.verdict import Value
from terrain.effects import CURRENT, effect_named
from terrain.errors import DataError
from terrain.extension import region_of
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.planar.run import simulate_planar

CAR, MARMOTTE, PATAKO = load_robot("adap2e"), load_robot("marmotte"), load_robot("patako")


class World:
    """A robot, six drives of 40 s, and how small effects these could show."""

    def __init__(self, robot):
        self.robot, rng = robot, np.random.default_rng(8)
        self.drives = car_drives(rng, CAR, 6, 40.0) if robot is CAR else rich_drives(rng, 6, 40.0)
        self.limits = limits_of(robot, self.drives)

    def diagnosed(self, hidden):
        runs = hidden_runs(self.robot, self.drives, np.random.SeedSequence(21), hidden)
        return diagnose(runs, simulation_of(self.robot))


@pytest.fixture(scope="module")
def worlds():
    return {robot.name: World(robot) for robot in (CAR, MARMOTTE, PATAKO)}


def values_of(found):
    return {value.name: value for cause in found.causes for value in cause.values}


@pytest.mark.parametrize("robot", [CAR, pytest.param(MARMOTTE, marks=pytest.mark.slow)], ids=lambda r: r.name)
def test_where_nothing_is_hidden_nothing_is_named(worlds, robot):
    found = worlds[robot.name].diagnosed({})
    assert (found.causes, found.ambiguous_sets, found.excluded_runs, found.faults) == ((), (), (), ())
    assert CURRENT not in found.residual_before


@pytest.mark.parametrize(
    ("robot", "hidden"),
    [
        ("adap2e", {"understeer_s2pm": 0.01}),
        ("adap2e", {"cornering_stiffness_ratio": -0.3}),
        pytest.param("adap2e", {"side_hill_slip_ratio": 0.15}, marks=pytest.mark.slow),
        pytest.param("adap2e", {"steering_offset_front_rad": 0.01}, marks=pytest.mark.slow),
        pytest.param("adap2e", {"steering_backlash_rad": 0.01}, marks=pytest.mark.slow),
        pytest.param(
            "adap2e", {"understeer_s2pm": 0.02, "cornering_stiffness_ratio": 0.4}, marks=pytest.mark.slow
        ),
        ("marmotte", {"turning_slip_ratio": 0.1}),
        pytest.param("marmotte", {"side_hill_slip_ratio": 0.2}, marks=pytest.mark.slow),
        pytest.param("patako", {"force_slip_ratio": 0.4}, marks=pytest.mark.slow),
        pytest.param("patako", {"wheel_radius_ratio": 0.05}, marks=pytest.mark.slow),
        pytest.param(
            "patako", {"turning_slip_ratio": 0.5, "turning_slip_power_ratio": 0.4}, marks=pytest.mark.slow
        ),
    ],
    ids=lambda given: given if isinstance(given, str) else "+".join(given),
)
def test_what_is_theirs_is_named_with_its_value_and_nothing_beside_it(worlds, robot, hidden):
    found = worlds[robot].diagnosed(hidden)
    values = values_of(found)
    assert set(values) == set(hidden), (found.verdict, found.ambiguous_sets)
    for name, size in hidden.items():
        std = (values[name].high - values[name].low) / (2 * 2.13)
        assert abs(values[name].value - size) < 4 * std, name


def test_a_side_slope_and_a_turn_part_the_stiffness_of_tyres_from_a_slide_on_side_slopes(worlds):
    limits = worlds["adap2e"].limits
    stiffness, slide = effect_named("cornering_stiffness"), effect_named("side_hill_slip")
    assert not limits.alike(stiffness, slide)
    hidden = {"cornering_stiffness_ratio": 3.0 * limits.of(stiffness)}
    assert not limits.in_place_of(stiffness, hidden, slide)
    assert limits.in_place_of(stiffness, {"cornering_stiffness_ratio": 0.01 * limits.of(stiffness)}, slide)


def test_drives_of_a_car_keep_to_what_it_can():
    drives = car_drives(np.random.default_rng(0), CAR, 3, 60.0)
    for twist in drives.twists:
        speed, turn = twist[:, 0], twist[:, 2]
        assert 2.0 < speed.max() <= 0.5 * CAR.speed_max_mps
        assert speed.min() < -0.1
        assert not twist[-1].any()
        assert np.abs(np.diff(speed)).max() * STEP_HZ <= CAR_MPS2 + 1e-9
        assert np.abs(turn).max() > 0.3
        curvature = turn[speed != 0.0] / speed[speed != 0.0]
        assert np.abs(curvature).max() < np.tan(CAR.steering_max_rad) / CAR.wheelbase_m


def logged(twist=(1.0, 0.0, 0.2), n=501):
    return simulate_planar(CAR, np.tile(twist, (n, 1)), 0)


def test_a_log_of_a_car_has_one_wheel_a_region_and_no_columns_to_exchange():
    run = logged()
    region = region_of([run], CAR)
    assert region.wheel_speed_mps[1] == pytest.approx(1.0, abs=1e-3)
    assert region.yaw_rate_radps[1] == pytest.approx(0.2, abs=1e-3)
    without = RunLog("a", CAR.name, {k: v for k, v in run.streams.items() if k != "steering"})
    assert region_of([without], CAR).yaw_rate_radps is None
    with pytest.raises(DataError, match="no stream 'steering'"):
        signals_of(without, CAR)
    assert all(change.wheel < 1 and change.pair == (0, 1) for change in candidate_changes(CAR))
    assert traces_of([logged() for _ in range(5)], CAR)[0].measured.shape[1] == 1


def test_words_are_those_of_the_robot():
    radius = Value("wheel_radius_ratio", 0.05, "ratio", 0.045, 0.055)
    assert in_robot_terms("wheel_radius", [radius], MARMOTTE).startswith(
        "a sprocket radius of 0.1250 m (described"
    )
    assert "assumed" in in_robot_terms("wheel_radius", [radius], PATAKO)
    side = Value("one_sided_radius_ratio", 0.05, "ratio", 0.045, 0.055)
    assert in_robot_terms("one_sided_radius", [side], MARMOTTE).startswith("sprockets that are 5.0 % larger")
    less = Value("understeer_s2pm", 0.03, "s2pm", 0.025, 0.035)
    text = in_robot_terms("understeer", [less], CAR)
    assert text == "an understeer of 0.030 s²/m (described: 0 s²/m), which turns it 9.1 % less at 2 m/s"
    soft = value_in_robot_terms("cornering_stiffness_ratio", -0.2, -0.25, -0.15, CAR)
    assert soft == "12000 N/rad (11250 to 12750)"


def test_a_next_drive_of_a_car_is_one_that_it_can_drive(worlds):
    runs = hidden_runs(
        CAR,
        worlds["adap2e"].drives._replace(twists=[np.tile([0.4, 0.0, 0.0], (2001, 1))] * 6),
        np.random.SeedSequence(2),
        {},
    )
    found = diagnose(runs, simulation_of(CAR))
    assert "understeer_s2pm" in [limit.name for limit in found.not_excited]
    command = next_command(found, "adap2e", CAR, ())
    assert "--robot adap2e" in command
    assert "spot_turn" not in command


@pytest.mark.slow
@pytest.mark.parametrize("row", [Row.TRACKED, Row.CAR])
def test_blind_trials_name_what_is_hidden_and_nothing_else(row):
    trials = [run_trial(case) for case in cases_of(row, 12, 77, 8)]
    assert not any(t.wrong for t in trials)
    hidden = [t for t in trials if t.causes]
    assert len(hidden) < len(trials)
    assert sum(t.found(t.causes[0]) for t in hidden) >= len(hidden) - 1
