"""Robots that lack what others have, and logs of the dynamic simulator, a richer model than the one under test."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.trial import hidden_runs
from studies.foreign.worlds import WORLDS, driven_by, runs_of

from terrain.discrepancy.diagnosed_runs import diagnose_runs
from terrain.discrepancy.grounds import simulation_for
from terrain.discrepancy.health.readings import candidate_changes
from terrain.discrepancy.powertrain import traces_of
from terrain.discrepancy.robot_terms import in_robot_terms, value_in_robot_terms
from terrain.discrepancy.runs import signals_of
from terrain.discrepancy.verdict import Tier, Value
from terrain.effects import CHANNELS, effect_named, library_of, vector_of
from terrain.errors import DataError
from terrain.estimation.estimate import enriched, estimate_run
from terrain.extension import region_of
from terrain.records import Label, RunLog
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, make_planar, planar_ground, replay
from terrain.simulation.run import simulate, simulate_run
from terrain.terramechanics.soil import load_soil

pytestmark = pytest.mark.usefixtures("without_next_drive")
AGRIMARO, HUSKY, CAR, MARMOTTE, PATAKO = map(
    load_robot, ("agrimaro", "husky", "adap2e", "marmotte", "patako")
)
BARE = """name: mule
drive: skid_steer
wheel_radius_m: {value: 0.3, unit: m, source: me}
track_m: {value: 1.08, unit: m, source: me}
wheelbase_m: {value: 0.9, unit: m, source: assumed}
mass_kg: {value: 280.0, unit: kg, source: me}
"""
WIDE = {"effective_track_ratio": 0.4}


def test_a_robot_of_which_geometry_and_mass_are_known_is_replayed_explained_and_filtered(tmp_path):
    """It turns as if its track were 40 % wider."""
    path = tmp_path / "mule.yaml"
    path.write_text(BARE)
    robot = load_robot(path)
    runs = [
        simulate_run(robot, "asphalt", "complex", 0, i, duration_s=30.0, effects=WIDE) for i in range(1, 5)
    ]
    # two routes: the simulation that wrote the log, and its replay from the wheel speeds logged
    signals = signals_of(runs[0], robot)
    logged = (signals.wheel_speed_mps, signals.steer_rad, signals.grade_rad, signals.roll_rad)
    # copies: read-only arrays would be another signature, for which nothing else compiles
    copies = (values.copy() for values in logged)
    seen = replay(make_planar(robot, Ground()), vector_of(WIDE), signals.dt_s, *copies)
    column = CHANNELS.index("yaw_rate_radps")
    assert np.std((signals.measured - seen)[50:-50, column]) < 0.03 < np.nanstd(signals.measured[:, column])
    library = [effect_named("effective_track"), effect_named("lever_arm")]
    (cause,) = diagnose_runs(runs, robot, library, None, 0).diagnosis.causes
    assert (cause.name, cause.parameters[0].value) == ("effective_track", pytest.approx(0.4, abs=0.05))
    assert np.isfinite(enriched(estimate_run(runs[0], robot, "slip")).streams["estimator"].values).all()


def test_a_log_of_a_car_has_one_wheel_a_region_and_no_columns_to_exchange():
    run = simulate(CAR, np.tile((1.0, 0.0, 0.2), (501, 1)), Ground(), 0)
    region = region_of([run], CAR)
    assert region.wheel_speed_mps[1] == pytest.approx(1.0, abs=1e-3)
    assert region.yaw_rate_radps[1] == pytest.approx(0.2, abs=1e-3)
    without = RunLog("a", CAR.name, {k: v for k, v in run.streams.items() if k != "steering"})
    assert region_of([without], CAR).yaw_rate_radps is None
    with pytest.raises(DataError, match="no stream 'steering'"):
        signals_of(without, CAR)
    assert all(change.wheel < 1 and change.pair == (0, 1) for change in candidate_changes(CAR))
    assert traces_of([run] * 5, CAR)[0].measured.shape[1] == 1


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


# -- Logs of the dynamic simulator ---------------------------------------------------------------------------

LIBRARY = library_of("swerve")
FEW = tuple(map(effect_named, ("effective_track", "lever_arm", "payload", "wheel_radius")))
"""Causes; on which ground runs are simulated does not depend on how many there could be."""


def dynamic_runs(effects=None, robot=AGRIMARO, terrain="grass", n=6, **options):
    return [simulate_run(robot, terrain, "survey", 0, i + 1, effects=effects, **options) for i in range(n)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "options"),
    [
        ({}, {}),
        ({}, {"terrain": "firm_soil_gravel", "vary": True}),
        ({"wheel_radius_ratio": 0.05}, {}),
        ({"camera_latency_s": 0.1}, {}),
        ({"payload_ratio": 0.3}, {}),
    ],
)
def test_an_effect_hidden_in_the_plant_is_named_and_nothing_else(effects, options):
    runs = dynamic_runs(effects, **options)
    diagnosis = diagnose_runs(runs, AGRIMARO, LIBRARY, 0, 0).diagnosis
    assert diagnosis.values == {name: pytest.approx(value, rel=0.15) for name, value in effects.items()}
    assert (diagnosis.ambiguous_sets, diagnosis.excluded_runs, diagnosis.faults) == ((), (), ())
    if not effects:
        assert diagnosis.verdict in (None, Tier.NOT_SHOWN)


def relabelled(runs, label):
    return [replace(run, labels=(Label(0.0, 5.0, label),)) for run in runs]


def test_runs_are_simulated_on_the_soil_of_their_label_where_they_need_it():
    runs = dynamic_runs(n=9, duration_s=20.0)
    found = diagnose_runs(runs, AGRIMARO, FEW, 0, 0)
    simulation = found.simulation
    assert [match[:2] for match in found.terrains] == [("grass", "grass")]
    soil = planar_ground(AGRIMARO, load_soil("grass"))
    assert simulation.grounds["grass"]._replace(effective_ratio=1.0) == soil
    assert simulation.model_error
    on = [simulation.planar_on(label) for label in ("grass", "moon", "")]
    grass, moon, plain = (planar.params.tobytes() for planar in on)
    assert grass == make_planar(AGRIMARO, simulation.grounds["grass"]).params.tobytes() != plain
    assert moon == plain == make_planar(AGRIMARO, Ground()).params.tobytes()


LIGHT = """name: light
drive: skid_steer
wheel_radius_m: {value: 0.1, unit: m, source: me}
track_m: {value: 0.36, unit: m, source: me}
wheelbase_m: {value: 0.26, unit: m, source: me}
mass_kg: {value: 17.0, unit: kg, source: me}
"""


def test_of_a_set_the_member_of_a_usual_size_is_built_in_whatever_the_label(tmp_path):
    """Wheels of a light robot slip by 10 %, far from the soil of its label; it turns as with a track of 0.57 m."""
    path = tmp_path / "light.yaml"
    path.write_text(LIGHT)
    robot, drives = load_robot(path), rich_drives(np.random.default_rng(7), 6, 20.0)
    hidden = {"effective_track_ratio": 0.57 / 0.36 - 1.0, "ground_slip_ratio": 0.10}
    runs = [
        replace(run, streams={name: run.streams[name] for name in ("wheels", "imu", "odometry")})
        for run in hidden_runs(robot, drives, np.random.SeedSequence(7), hidden)
    ]
    found = []
    for label in ("grass", "zork"):
        diagnosis = diagnose_runs(relabelled(runs, label), robot, library_of("skid_steer"), 0, 0).diagnosis
        (track,) = [value for cause in diagnosis.causes for value in cause.parameters]
        assert track.value == pytest.approx(hidden["effective_track_ratio"], abs=0.02)
        # beside a wheel radius, which would be as good and stranger, the track is another
        assert 0.36 * (1.0 + track.low) < 0.52
        (of_set,) = diagnosis.of_sets
        assert (of_set.name, of_set.parameters[0].value) == ("ground_slip", pytest.approx(0.10, abs=0.01))
        assert [{"wheel_radius", "ground_slip"} <= set(names) for names in diagnosis.ambiguous_sets] == [True]
        found.append((diagnosis.ambiguous_sets, track))
    assert found[0] == found[1]


@pytest.mark.slow
def test_a_soil_that_only_all_parameters_together_repair_is_not_that_of_the_runs(tmp_path):
    """A light robot of a foreign world, speeds logged by another radius: on grass thirty parameters fit, no five."""
    path = tmp_path / "light.yaml"
    path.write_text(LIGHT)
    robot, world = load_robot(path), WORLDS["plain", "skid"]()
    places = np.array([[x, y] for x in (0.131, -0.131) for y in (0.188, -0.188)])
    body = world.body._replace(wheels_m=places, radius_m=np.full(4, 0.098), mass_kg=17.0, inertia_kgm2=0.45)
    world = world._replace(body=body, sensing=world.sensing._replace(lidar_m=(0.0, 0.0)))
    given = []
    for run in runs_of(world, driven_by(world, 24, np.random.default_rng(7)), np.random.SeedSequence(7)):
        wheels = run.streams["wheels"]
        speeds = replace(wheels, values=wheels.values[:, :2], channels=wheels.channels[:2])
        given.append(RunLog(run.run_id, robot.name, {**run.streams, "wheels": speeds}))
    found = []
    for label in ("zork", "grass"):
        diagnosis = diagnose_runs(
            relabelled(given, label), robot, library_of("skid_steer"), None, 0
        ).diagnosis
        found.append({value.name: value.value for cause in diagnosis.causes for value in cause.parameters})
    assert found[0] == found[1]
    assert found[0]["ground_slip_ratio"] == pytest.approx(1.0 - 0.098 / 0.165, abs=0.01)


def test_a_label_that_helps_no_run_changes_nothing():
    """No label, that of another soil, and a foreign word: one simulation."""
    runs = dynamic_runs(robot=HUSKY, terrain="asphalt", n=4, duration_s=15.0)
    several = replace(runs[0], labels=(Label(0.0, 5.0, "grass"), Label(5.0, 9.0, "snow")))
    for label in ("snow", "moon"):
        given = [*relabelled(runs, label), replace(several, run_id="s")]
        found = diagnose_runs(given, HUSKY, FEW, 0, 0)
        assert [match[:2] for match in found.terrains] == [("", None), (label, None)]
        assert (found.simulation.grounds, found.simulation.model_error) == ({}, {})


@pytest.mark.parametrize(("robot", "effective"), [(AGRIMARO, 0.0), (HUSKY, 1.0)])
def test_tilt_acts_as_a_slope_but_not_where_a_body_rides_over_bumps(robot, effective):
    planar = {"effects": {}, "vary": True} if robot is HUSKY else {}
    runs = dynamic_runs(robot=robot, n=9, duration_s=30.0, **planar)
    simulation, _ = simulation_for(runs, robot, library_of(robot.drive))
    ground = simulation.grounds.get("grass", Ground())
    assert ground.effective_ratio == pytest.approx(effective, abs=0.05)
