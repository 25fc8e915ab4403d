"""`terrain explain` on logs of the dynamic simulator, a richer model than the one under test."""

from dataclasses import replace

import pytest

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.diagnosed_runs import simulation_for
from terrain.discrepancy.verdict import Verdict
from terrain.effects import library_of
from terrain.records import Label
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, make_planar, planar_ground
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import load_soil

AGRIMARO, HUSKY = load_robot("agrimaro"), load_robot("husky")
LIBRARY = library_of("swerve")


def runs_of(effects=None, robot=AGRIMARO, terrain="grass", n=6, **options):
    return [simulate_run(robot, terrain, "survey", 0, i + 1, effects=effects, **options) for i in range(n)]


def explained(runs):
    return diagnose(runs, simulation_for(runs, AGRIMARO, LIBRARY)[0], LIBRARY)


@pytest.mark.slow
@pytest.mark.parametrize("vary", [False, True])
@pytest.mark.parametrize("terrain", ["grass", "firm_soil_gravel"])
def test_without_a_hidden_effect_nothing_is_stated(terrain, vary):
    diagnosis = explained(runs_of(terrain=terrain, vary=vary))
    assert diagnosis.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    assert (diagnosis.excluded_runs, diagnosis.faults) == ((), ())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("wheel_radius_ratio", 0.05),
        ("camera_yaw_rad", 0.05),
        ("camera_latency_s", 0.1),
        ("gyro_scale_ratio", 0.1),
        ("payload_ratio", 0.3),
    ],
)
def test_an_effect_hidden_in_the_plant_is_named_and_nothing_else(parameter, value):
    diagnosis = explained(runs_of({parameter: value}))
    assert diagnosis.values == {parameter: pytest.approx(value, rel=0.15)}
    assert diagnosis.ambiguous_sets == ()


def test_a_run_is_simulated_on_the_soil_of_its_label_or_the_default_terrain():
    runs = runs_of(n=2, duration_s=10.0)
    unknown = [replace(run, run_id=f"u{i}", labels=(Label(0.0, 5.0, "moon"),)) for i, run in enumerate(runs)]
    several = replace(runs[0], run_id="s", labels=(Label(0.0, 5.0, "grass"), Label(5.0, 9.0, "snow")))
    simulation, matches = simulation_for([*runs, *unknown, several], AGRIMARO, LIBRARY)
    assert [match[:2] for match in matches] == [("", None), ("grass", "grass"), ("moon", None)]
    soil = planar_ground(AGRIMARO, load_soil("grass"))
    assert simulation.grounds["grass"]._replace(effective_ratio=1.0) == soil
    grass, moon, plain = (
        each.params.tobytes()
        for each in (
            simulation.planar_on("grass"),
            simulation.planar_on("moon"),
            make_planar(AGRIMARO, Ground()),
        )
    )
    assert grass == make_planar(AGRIMARO, simulation.grounds["grass"]).params.tobytes() != plain
    assert moon == simulation.planar.params.tobytes() == plain
    assert simulation_for(unknown, AGRIMARO, LIBRARY)[0].grounds == {}


@pytest.mark.parametrize(("robot", "effective"), [(AGRIMARO, 0.0), (HUSKY, 1.0)])
def test_tilt_acts_as_a_slope_but_not_where_a_body_rides_over_bumps(robot, effective):
    runs = runs_of(robot=robot, n=3, vary=robot is HUSKY)
    simulation, _ = simulation_for(runs, robot, library_of(robot.drive))
    assert simulation.grounds["grass"].effective_ratio == pytest.approx(effective, abs=0.05)
    assert simulation.tilt_is_slope("grass") == (simulation.grounds["grass"].effective_ratio == 1.0)
