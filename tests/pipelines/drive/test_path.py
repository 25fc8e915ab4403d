"""`terrain drive --path`: a path of the user is followed and judged, and wrong input is one sentence."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest

from pipelines.drive.drive import Settings, SlipSourceName, run
from pipelines.report.results import as_json, silent
from terrain.control.car_following import SlipSource
from terrain.errors import ConfigError


def follow(robot="adap2e", **settings):
    return run(Settings(robot=robot, **settings), silent)


def bend(n=80, radius=12.0):
    angle = np.linspace(0.0, 2.0, n)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


@pytest.fixture
def path_csv(tmp_path):
    file = tmp_path / "bend.csv"
    np.savetxt(file, bend(), delimiter=",", header="x_m,y_m", comments="")
    return file


def test_names_of_observers_are_those_of_the_controller():
    assert tuple(SlipSource) == get_args(SlipSourceName)


@pytest.mark.parametrize("observer", ["multi-grip", "dynamic"])
def test_a_path_is_followed_and_written(path_csv, tmp_path, observer):
    out = tmp_path / "out"
    result = follow(path=path_csv, slope_deg=5.0, observer=observer, out=out)
    assert result.reached_end
    assert result.within_limit
    assert result.lateral_max_m < result.limit_m == pytest.approx(0.3)
    assert result.length_m == pytest.approx(24.0, abs=0.1)
    assert all(file.is_file() for file in result.files)
    document = as_json(result)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert sum(result.statuses["steering"].values()) == sum(result.statuses["observer"].values())
    assert "within a tenth of the speed" in result.page.read_text(encoding="utf-8")
    assert [section.title for section in result.report.details][1] == "What the observer gave"
    table = np.genfromtxt(out / "drive.csv", delimiter=",", names=True)
    assert table["lateral_m"].size == sum(result.statuses["path"].values())
    assert np.abs(table["lateral_m"]).max() == pytest.approx(result.lateral_max_m, rel=1e-4)


def test_an_offset_and_a_stop(path_csv, tmp_path):
    result = follow(path=path_csv, speed_mps=2.0, offset=1.0, stop=(12.0,))
    assert (result.page, result.files, list(tmp_path.iterdir())) == (None, (), [path_csv])
    assert len(result.to_pandas()) == sum(result.statuses["path"].values())
    assert result.lateral_max_m < 0.2
    assert result.duration_s > 24.0 / 2.0 + 3.0


def test_a_path_too_tight_is_driven_and_named(tmp_path):
    file = tmp_path / "tight.csv"
    np.savetxt(file, bend(radius=1.5, n=60), delimiter=";")
    result = follow(path=file, speed_mps=1.0)
    assert "curvature is 0.6" in result.warnings[0]
    assert any("limit" in warning for warning in result.warnings)


def test_a_skid_steer_robot_follows_a_path_with_its_pilot(tmp_path):
    file, out = tmp_path / "bend.csv", tmp_path / "out"
    np.savetxt(file, bend(radius=4.0, n=40), delimiter=",", header="x_m,y_m", comments="")
    result = follow(robot="husky", path=file, terrain="grass", stop=(4.0,), offset=0.5, out=out)
    assert result.reached_end
    assert result.lateral_max_m < 0.1
    assert result.duration_s > result.length_m / result.speed_mps + 3.0
    assert sum(result.statuses["pilot"].values()) >= sum(result.statuses["path"].values())
    document = as_json(result)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    table = np.genfromtxt(out / "drive.csv", delimiter=",", names=True)
    assert np.abs(table["lateral_m"] - 0.5).max() == pytest.approx(result.lateral_max_m, rel=1e-3)
    assert "a tenth of the speed" in result.page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"robot": "husky", "grip": 0.5}, "--grip is accepted of car-like robots, not of husky"),
        ({"robot": "husky", "observer": "none"}, "--observer is accepted of car-like robots"),
        ({"robot": "husky", "speed_mps": 5.0}, "--speed is 5; husky drives at most 1.01 m/s"),
        ({"robot": "husky", "terrain": "moon"}, "moon"),
        ({"terrain": "clay"}, "--terrain is accepted of robots that are not car-like, as adap2e is"),
    ],
)
def test_options_of_other_robots_are_refused_in_a_sentence(path_csv, settings, message):
    with pytest.raises(ConfigError, match=message):
        follow(path=path_csv, **settings)
