"""What an effect's value rests on: the described number, and whether somebody measured it."""

from dataclasses import replace

import pytest
import yaml

from terrain.effects import PARAMETER, parameters_of
from terrain.extension import Origin, apply_homes, basis_of
from terrain.files.names import data_folder
from terrain.robots import load_robot, robot_from

NAMES = ("agrimaro", "husky", "warthog", "marmotte")


def yaml_of(name):
    return yaml.safe_load((data_folder("robots") / f"{name}.yaml").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_a_number_is_assumed_where_its_source_says_so_and_only_there(name):
    described = yaml_of(name)
    sections = {"": described} | {
        f"{key}.": value for key, value in described.items() if "source" not in value
    }
    expected = {
        f"{prefix}{key}"
        for prefix, entries in sections.items()
        if isinstance(entries, dict)
        for key, entry in entries.items()
        if isinstance(entry, dict) and entry.get("source", "").startswith("assumed")
    }
    robot = load_robot(name)
    assert robot.assumed == expected
    assert replace(robot, track_m=robot.track_m).assumed == expected


@pytest.mark.parametrize("name", NAMES)
def test_the_extended_number_is_the_one_that_filters_take(name):
    """Two routes: the number that is reported, and the description with the effect applied."""
    robot = load_robot(name)
    for parameter in parameters_of(robot.drive):
        extended = apply_homes(replace(robot, effects={parameter: 0.1}))
        for basis in basis_of(robot, parameter, 0.1):
            if basis.origin is not Origin.LEFT_OUT and parameter not in extended.effects:
                part = extended.parts[basis.section] if basis.section else extended
                assert getattr(part, basis.field) == basis.extended
        assert len(basis_of(robot, parameter)) == len(PARAMETER[parameter].homes)


def test_a_lever_arm_rests_on_what_was_assumed_of_the_camera():
    described = yaml_of("husky")
    (basis,) = basis_of(robot_from("husky.yaml", described), "lever_x_m", -0.23)
    assert (basis.name, basis.origin) == ("camera.lever_x_m", Origin.ASSUMED)
    assert (basis.described, basis.extended) == (0.35, pytest.approx(0.12))
    described["camera"]["lever_x_m"]["source"] = "measured with a ruler, not assumed"
    (basis,) = basis_of(robot_from("husky.yaml", described), "lever_x_m", -0.23)
    assert basis.origin is Origin.SOURCED
    del described["camera"]
    (basis,) = basis_of(robot_from("husky.yaml", described), "lever_x_m", -0.23)
    assert (basis.origin, basis.described, basis.extended) == (Origin.LEFT_OUT, 0.0, pytest.approx(-0.23))


def test_effects_of_the_robot_itself_are_not_applied_twice():
    robot = replace(load_robot("husky"), effects={"lever_x_m": 0.5, "effective_track_ratio": 1.5})
    (basis,) = basis_of(robot, "effective_track_ratio", 1.5)
    assert basis.extended == pytest.approx(2.5 * 0.5708)
    assert basis.described == 0.5708
