import math

import pytest
import yaml

from terrain.control.slip_table import DRIVE_STATES, load_slip_table
from terrain.errors import ConfigError
from terrain.resources import data_folder


def table_with(**number):
    """Return the content of a small valid table in which a number of SNOW in traction is replaced."""
    entry = {
        "traction": {"slip_ratio": 0.1, "source": "assumed"},
        "braking": {"slip_ratio": -0.1, "source": "assumed"},
        "steady": {"slip_ratio": 0.0, "source": "assumed"},
    }
    snow = {state: dict(target) for state, target in entry.items()}
    snow["traction"] = {key: value for key, value in (snow["traction"] | number).items() if value is not ...}
    return {"name": "own", "fallback": "unknown", "terrains": {"unknown": entry, "SNOW": snow}}


def write(folder, content):
    path = folder / "table.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_the_packaged_table_has_a_sound_and_sourced_number_everywhere():
    table = load_slip_table()
    measured = {
        "ASPHALT",
        "FLOORING",
        "ICE",
        "SANDY_LOAM",
        "SNOW",
        "CONCRETE",
        "DIRT_ROAD",
        "PLOUGHED",
        "UNPLOUGHED",
    }
    assert measured | {table.fallback} <= set(table.targets)
    for terrain, by_state in table.targets.items():
        assert tuple(by_state) == DRIVE_STATES
        for state, target in by_state.items():
            assert (target.terrain, target.drive_state) == (terrain, state)
            assert target.source.strip()
            if target.source == "assumed":
                assert (target.status, target.n_runs) == ("unestimated", 0)
            assert math.isnan(target.slip_std) == (target.n_runs == 0)
        assert by_state["braking"].slip_ratio < 0 <= by_state["steady"].slip_ratio
        assert by_state["steady"].slip_ratio <= by_state["traction"].slip_ratio
    raw = yaml.safe_load((data_folder("target_slip") / "default.yaml").read_text())
    assert raw["terrains"]["ICE"]["traction"]["slip_ratio"] == table.lookup("ICE")["traction"].slip_ratio


def test_a_terrain_without_an_entry_gets_the_fallback_under_its_own_name(tmp_path):
    table = load_slip_table(write(tmp_path, table_with()))
    assert table.lookup("LAVA") == table.targets["unknown"]
    assert {target.terrain for target in table.lookup("LAVA").values()} == {"unknown"}
    assert {target.terrain for target in table.lookup("SNOW").values()} == {"SNOW"}


def test_a_number_with_runs_behind_it_is_estimated(tmp_path):
    learned = table_with(slip_ratio=0.17, slip_std=0.02, n_runs=6, source="six runs")
    target = load_slip_table(write(tmp_path, learned)).lookup("SNOW")["traction"]
    assert target == ("SNOW", "traction", 0.17, 0.02, 6, "estimated", "six runs")


@pytest.mark.parametrize(
    ("number", "fault"),
    [
        ({"slip_ratio": 1.5}, r"slip_ratio is 1.5; it must be a number within \[-1, 1\]"),
        ({"slip_ratio": float("nan")}, "slip_ratio is nan"),
        ({"slip_ratio": "much"}, "slip_ratio is 'much'"),
        ({"slip_ratio": True}, "slip_ratio is True"),
        ({"slip_ratio": -0.1}, "slip_ratio is -0.1; traction slip cannot be negative"),
        ({"source": ...}, "needs slip_ratio and source"),
        ({"source": " "}, "source must be a text, or 'assumed'"),
        ({"source": None}, "source must be a text, or 'assumed'"),
        ({"unit": "%"}, "needs slip_ratio and source"),
        ({"n_runs": 3}, "slip_std and n_runs go together"),
        ({"slip_std": 0.1}, "slip_std and n_runs go together"),
        ({"slip_std": -0.1, "n_runs": 3}, "slip_std is -0.1"),
        ({"slip_std": 0.1, "n_runs": 2.5}, "n_runs is 2.5"),
        ({"slip_std": True, "n_runs": 3}, "slip_std is True"),
    ],
)
def test_a_number_that_is_not_accepted_is_named(tmp_path, number, fault):
    path = write(tmp_path, table_with(**number))
    with pytest.raises(ConfigError, match=rf"table\.yaml: SNOW, traction: .*{fault}"):
        load_slip_table(path)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("a: [1", "is no YAML"),
        ("", "a slip table holds just the keys name, fallback and terrains"),
        ("- 1", "a slip table holds just the keys name, fallback and terrains"),
        (table_with() | {"extra": 1}, "a slip table holds just the keys name, fallback and terrains"),
        (table_with() | {"fallback": "LAVA"}, "the fallback 'LAVA' is no entry of terrains"),
        (table_with() | {"fallback": ["SNOW"]}, "the fallback .*SNOW.* is no entry of terrains"),
        (table_with() | {"terrains": ["SNOW"]}, "the fallback 'unknown' is no entry of terrains"),
        (table_with() | {"terrains": {"unknown": {"traction": {}}}}, "unknown needs just the drive states"),
    ],
)
def test_a_file_that_is_no_table_is_refused(tmp_path, content, fault):
    path = write(tmp_path, content)
    with pytest.raises(ConfigError, match=rf"table\.yaml: {fault}"):
        load_slip_table(path)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read \(No such file"):
        load_slip_table(tmp_path / "nowhere.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match=r"binary\.yaml: cannot be read"):
        load_slip_table(tmp_path / "binary.yaml")
