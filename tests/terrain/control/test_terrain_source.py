"""A known terrain is given at its changes, and no terrain never."""

import numpy as np

from terrain.control.switching import KnownTerrain, TerrainSource
from terrain.records import Sample


def test_a_known_terrain_is_given_once_a_change_and_no_terrain_never():
    known = KnownTerrain(lambda terrain: {"clay": "grass"}.get(terrain, terrain))
    terrains = ["", "clay", "clay", "", "clay", "snow", "snow", ""]
    samples = [Sample(float(k), np.zeros(3), {}, terrain) for k, terrain in enumerate(terrains)]
    found = [tuple(one) for sample in samples for one in known.update(sample, [])]
    assert found == [(1.0, "grass", 1.0), (5.0, "snow", 1.0)]
    assert not any(TerrainSource().update(sample, []) for sample in samples)
