"""A robot of which geometry and mass are all that is known: simulated, explained and filtered."""

import numpy as np
import pytest

from terrain.discrepancy.diagnosed_runs import diagnose_runs
from terrain.discrepancy.runs import signals_of
from terrain.effects import CHANNELS, effect_named, vector_of
from terrain.estimation.estimate import enriched, estimate_run
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, make_planar, replay
from terrain.simulation.run import simulate_run

TEXT = """name: mule
drive: skid_steer
wheel_radius_m: {value: 0.3, unit: m, source: me}
track_m: {value: 1.08, unit: m, source: me}
wheelbase_m: {value: 0.9, unit: m, source: assumed}
mass_kg: {value: 280.0, unit: kg, source: me}
"""
WIDE = {"effective_track_ratio": 0.4}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "mule.yaml"
    path.write_text(TEXT)
    return load_robot(path)


def test_its_runs_are_replayed_explained_and_filtered_without_what_is_not_described(robot):
    """Of a robot that turns as if its track were 40 % wider."""
    runs = [
        simulate_run(robot, "asphalt", "complex", 0, number, duration_s=40.0, effects=WIDE)
        for number in range(1, 7)
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
    assert np.isfinite(enriched(estimate_run(runs[0], robot, "skid")).streams["estimator"].values).all()
