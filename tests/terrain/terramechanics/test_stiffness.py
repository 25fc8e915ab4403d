"""Soils are ordered as the thesis orders them, and the packaged table of levels is whole."""

from dataclasses import replace
from itertools import pairwise

import pytest
import yaml

from terrain.classify.stiffness import StiffnessLevel
from terrain.errors import ConfigError
from terrain.terramechanics import stiffness
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.stiffness import known_levels, response_of, stiffness_level

WHEEL = 294.3, 0.2, 0.1, 0.12


def test_paved_ground_is_least_and_sand_most_difficult():
    """Thesis 8.1: compact and paved surfaces are the low extreme, sandy ones pose the greatest challenges."""
    difficulty = {name: response_of(load_soil(name), *WHEEL).difficulty_ratio for name in soil_names()}
    order = sorted(difficulty, key=difficulty.get)
    assert order[:2] == ["tiles", "asphalt"]
    assert order[-1] == "dry_sand"


def test_harder_levels_are_less_difficult_and_only_soft_ground_sinks():
    found = [response_of(load_soil(name), *WHEEL) for name in soil_names()]
    by_level = [[each for each in found if each.level is level] for level in StiffnessLevel]
    assert all(by_level)
    for softer, harder in pairwise(by_level):
        assert min(one.difficulty_ratio for one in softer) > max(one.difficulty_ratio for one in harder)
    assert all((each.sinkage_m > 0) == (each.level is StiffnessLevel.SOFT) for each in found)


@pytest.mark.parametrize("name", ["clay", "dry_sand", "tilled_loam"])
def test_a_heavier_wheel_sinks_deeper(name):
    soil = load_soil(name)
    light, heavy = (response_of(soil, load_n, *WHEEL[1:]) for load_n in (150.0, 600.0))
    assert light.sinkage_m < heavy.sinkage_m


def test_a_wheel_without_thrust_is_stuck():
    slick = replace(load_soil("snow"), peak_friction_ratio=1e-9)
    assert response_of(slick, *WHEEL).difficulty_ratio == pytest.approx(1.0, abs=1e-6)


def test_every_soil_has_a_level_and_every_level_of_the_table_a_source():
    levels = known_levels()
    assert {name: levels[name] for name in soil_names()} == {
        name: stiffness_level(load_soil(name)) for name in soil_names()
    }
    assert levels["SNOW"] is StiffnessLevel.SOFT  # deep; the soil "snow" is packed
    assert levels["snow"] is StiffnessLevel.HARD


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"level": "HARDISH", "source": "x"}, "level is 'HARDISH', one of SOFT, FIRM, HARD"),
        ({"level": ["HARD"], "source": "x"}, "level is "),
        ({"level": "HARD", "source": " "}, "has no source"),
        ({"level": "HARD"}, "key 'source' is missing"),
        ("HARD", "a mapping with level, source"),
    ],
)
def test_a_damaged_table_is_one_sentence(tmp_path, monkeypatch, entry, message):
    (tmp_path / "terrains").mkdir()
    text = yaml.safe_dump({"levels": {"MUD": entry}})
    (tmp_path / "terrains" / stiffness.TABLE).write_text(text)
    known = stiffness.data_folder
    monkeypatch.setattr(
        stiffness, "data_folder", lambda kind: tmp_path / kind if kind == "terrains" else known(kind)
    )
    with pytest.raises(ConfigError, match=message):
        known_levels()
