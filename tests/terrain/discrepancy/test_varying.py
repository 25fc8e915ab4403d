"""Effects that differ from run to run: in two groups, at random, in one run alone, or not at all."""

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import Problem, search
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.varying import run_scatter, varying_effects
from terrain.discrepancy.verdict import Verdict
from terrain.effects import effect_named
from terrain.robots import load_robot

HUSKY = load_robot("husky")
SIMULATION = simulation_of(HUSKY)
RADIUS = "wheel_radius_ratio"
LIBRARY = tuple(
    effect_named(name)
    for name in ("wheel_radius", "effective_track", "payload", "gyro_scale", "camera_yaw", "accel_bias")
)
N_RUNS = 8


def runs(values, seed=1, name=RADIUS, robot=HUSKY):
    """Return runs of 30 s, each with a value of its own."""
    drives = rich_drives(np.random.default_rng(seed), N_RUNS, 30.0)
    return hidden_runs(robot, drives, np.random.SeedSequence(seed), [{name: float(x)} for x in values])


def searched(logs, library=LIBRARY, simulation=SIMULATION):
    """Return the problem of runs, and what the search finds."""
    signals = tuple(signals_of(run, simulation.robot) for run in logs)
    asked = Problem(signals, simulation, low_pass_of(signals), library)
    return asked, search(asked, asked.at(simulation.vector))


ODD = np.arange(N_RUNS) % 2


@pytest.fixture(scope="module")
def half():
    return runs(0.06 * ODD)


def test_half_of_the_runs_are_a_group_and_each_group_has_its_value(half):
    (found,) = varying_effects(*searched(half))
    assert (found.name, found.rivals, found.channel) == ("wheel_radius", (), "speed_x_mps")
    assert found.mean == pytest.approx(0.03, abs=0.005)
    assert found.scatter == pytest.approx(0.03 * np.sqrt(8 / 7), rel=0.3)
    one, other = found.groups
    assert one.run_ids == tuple(run.run_id for run in half[::2])
    assert other.run_ids == tuple(run.run_id for run in half[1::2])
    assert abs(one.value) < 4 * one.std < 0.01
    assert abs(other.value - 0.06) < 4 * other.std < 0.01


def test_that_is_the_answer_and_no_value_of_all_runs_is_named(half):
    found = diagnose(half, SIMULATION, LIBRARY)
    assert found.verdict == Verdict.VARIES
    assert (found.causes, found.ambiguous_sets) == ((), ())
    assert [each.name for each in found.varying] == ["wheel_radius"]


def test_a_spread_that_is_even_has_no_groups():
    values = np.linspace(-0.03, 0.09, N_RUNS)
    asked, searched_one = searched(runs(values))
    (found,) = varying_effects(asked, searched_one)
    assert (found.name, found.groups) == ("wheel_radius", ())
    assert found.scatter == pytest.approx(np.std(values, ddof=1), rel=0.3)
    assert run_scatter(searched_one, RADIUS) == pytest.approx(found.scatter, rel=0.02)
    assert run_scatter(searched_one, "camera_yaw_rad") < 0.01


@pytest.mark.parametrize("values", [np.zeros(N_RUNS), np.full(N_RUNS, 0.06), 0.06 * (np.arange(N_RUNS) == 3)])
def test_runs_that_are_alike_and_one_rogue_do_not_vary(values):
    assert varying_effects(*searched(runs(values))) == ()


def varying(name, value, library, robot=HUSKY):
    """Return what is found to vary where a parameter has a value in half of the runs alone."""
    logs = runs(value * ODD, name=name, robot=robot)
    effects = tuple(effect_named(each) for each in library)
    return varying_effects(*searched(logs, effects, simulation_of(robot)))


def test_an_effect_that_is_absent_at_its_bound_may_vary():
    (found,) = varying("encoder_lag_s", 0.03, ("encoder_lag", "clock_offset", "camera_latency"))
    assert (found.name, found.rivals) == ("encoder_lag", ())
    assert [group.value for group in found.groups] == pytest.approx([0.0, 0.03], abs=0.003)


def test_an_effect_does_not_vary_by_what_it_may_not_be():
    """An offset of one sign looks like an encoder that is early, which none is; of the other, late."""
    (found,) = varying("clock_offset_s", 0.03, ("encoder_lag", "clock_offset"))
    assert (found.name, found.rivals) == ("clock_offset", ())
    assert varying("clock_offset_s", 0.03, ("encoder_lag",)) == ()
    assert [each.name for each in varying("clock_offset_s", -0.03, ("encoder_lag",))] == ["encoder_lag"]


def test_a_wheel_of_half_of_the_runs_is_no_scatter_of_the_wheels():
    """What varies by itself would take most of it, were its scatter estimated first."""
    names = ("wheel_scale_2", "one_sided_radius", "wheel_radius", "gyro_bias", "steering_offset_2")
    (found,) = varying("wheel_scale_2_ratio", 0.05, names, load_robot("agrimaro"))
    assert (found.name, found.rivals) == ("wheel_scale_2", ())


def test_of_two_parameters_the_one_that_differs_is_stated():
    (found,) = varying("lever_y_m", 0.06, ("lever_arm", "camera_yaw", "gyro_scale"))
    assert (found.name, found.parameter) == ("lever_arm", "lever_y_m")
    assert [group.value for group in found.groups] == pytest.approx([0.0, 0.06], abs=0.01)


def test_a_value_far_from_where_sensitivities_are_taken_first_is_that_of_its_runs():
    (found,) = varying("effective_track_ratio", 0.8, ("effective_track", "turning_slip"))
    assert [group.value for group in found.groups] == pytest.approx([0.0, 0.8], rel=0.05, abs=0.04)
