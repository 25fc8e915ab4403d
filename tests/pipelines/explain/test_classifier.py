"""A classifier that is trained in simulation, before and after the extension."""

from dataclasses import replace

import pytest

from pipelines.explain.classifier import classifier_gain
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

AGRIMARO = load_robot("agrimaro")


def runs_of(effects, terrain, n, seed):
    return [
        simulate_run(AGRIMARO, terrain, "survey", seed, i + 1, effects=effects, vary=True) for i in range(n)
    ]


@pytest.mark.slow
def test_a_classifier_gains_where_the_extension_matters_and_gives_a_reason_where_it_cannot_be_compared():
    effects = {"slip_resistance_ratio": 3.0}
    terrains = ("asphalt", "snow", "tiles")
    held = [run for name in terrains for run in runs_of(effects, name, 4, 9)]
    found = classifier_gain(held, AGRIMARO, {}, effects, 0, runs_a_terrain=5)
    assert (found.reason, found.n_runs, found.terrains) == (None, 12, terrains)
    accuracy = found.errors["accuracy"]
    assert 0.0 < accuracy.change_ci[0] < accuracy.after - accuracy.before < accuracy.change_ci[1]
    same = classifier_gain(held, AGRIMARO, {}, {}, 0, runs_a_terrain=2).errors["accuracy"]
    assert (same.before, same.change_ci) == (same.after, (0.0, 0.0))
    for few, reason in ((held[:3], "1 known terrain,"), (held[3:6], "3 runs are held out")):
        refused = classifier_gain(few, AGRIMARO, {}, effects, 0)
        assert refused.errors == {}
        assert reason in refused.reason
    slow = [replace(run, streams={"imu": run.streams["imu"]}) for run in held]
    assert "wheel" in classifier_gain(slow, AGRIMARO, {}, effects, 0, runs_a_terrain=2).reason
