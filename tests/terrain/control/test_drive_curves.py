"""Curves of a drive, and its energy over distance."""

import math

import numpy as np
import pytest

from terrain.control.danzi_pid import DriveState
from terrain.control.drive_curves import drive_curves
from terrain.control.drive_metrics import EnergyCurve, energy_at_equal_distance
from terrain.control.slip_table import load_slip_table
from terrain.records import RunLog, Stream


def curves_of(wheel_radps=7.0, slip=0.2, terrains=("grass",), classified=None):
    """Those of 2 s at 0.8 m/s, by a pilot that estimates no slip; it classifies the terrain in the second."""
    time_s = np.arange(200) / 100
    columns = {"speed_x_mps": 0.8, "speed_y_mps": 0.0}
    columns |= {f"wheel_{i}_radps": wheel_radps for i in (1, 2, 3)}
    columns |= {f"slip_{i}_ratio": slip for i in (1, 2, 3)}
    status = dict.fromkeys(("aimed_ratio", "balance_ratio", "slip_ratio"), math.nan)
    status |= {"drive_state_code": float(DriveState.STEADY), "terrain_code": -1.0}
    streams = {
        name: Stream(time_s, np.tile(list(each.values()), (200, 1)), tuple(each))
        for name, each in (("truth", columns), ("control", status))
    }
    table, edges = load_slip_table(), np.linspace(0.0, 2.0, len(terrains) + 1)
    if classified is not None:
        values = streams["control"].values.copy()
        values[100:, -1] = list(table.targets).index(classified)
        streams["control"] = Stream(time_s, values, streams["control"].channels)
    labels = tuple(zip(edges[:-1], edges[1:], terrains, strict=True))
    return drive_curves(RunLog("run", "agrimaro", streams, labels), table)


def test_terrains_are_shown_where_there_are_several():
    both = curves_of(terrains=("grass", "clay"), classified="clay").terrains
    assert [name for *_, name in both["true"]] == ["grass", "clay"]
    assert both["classified"] == [(1.0, 1.99, "clay")]
    assert set(curves_of(terrains=("grass", "clay")).terrains) == {"true"}
    assert curves_of(classified="grass").terrains == {}


def test_slip_is_signed_by_the_motion_and_filtered_as_its_estimate():
    forward, reversing = curves_of(slip=0.2), curves_of(wheel_radps=-7.0, slip=-0.2)
    assert forward.slip[-1] == pytest.approx(0.2, abs=1e-6) == reversing.slip[-1]
    assert forward.slip[5] == pytest.approx(0.2 * (1 - math.exp(-6 * 0.01 / 0.05)))
    dragged = curves_of(wheel_radps=-1.0, slip=-1.1)  # turns backwards while the robot moves on
    assert dragged.slip[-1] == pytest.approx(-1.0, abs=1e-6)
    locked = curves_of(wheel_radps=0.0, slip=-1.0)
    assert locked.slip[-1] == pytest.approx(-1.0, abs=1e-6)


def test_energy_is_compared_over_the_distance_that_all_travelled():
    energy = np.array([0.0, 100.0, 300.0])
    fast, slow, stuck = (
        EnergyCurve(np.array(distance_m), energy)
        for distance_m in ([0.0, 4.0, 8.0], [0.0, 3.0, 6.0], [0.0, 0.5, 1.0])
    )
    found = energy_at_equal_distance([fast, slow, stuck])
    assert found == pytest.approx([200.0 / 6.0, 300.0 / 6.0, math.nan], nan_ok=True)
