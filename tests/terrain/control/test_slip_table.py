import math
from dataclasses import replace

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.control.slip_table import (
    DRIVE_STATES,
    CurveEntry,
    SlipTable,
    load_slip_table,
    table_content,
    write_slip_table,
)
from terrain.errors import ConfigError, TerrainError
from terrain.files.names import data_folder
from terrain.records import SlipTarget
from terrain.slip_learning.curve import LAW_BOUNDS, LAW_PARAMETERS


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
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be opened \(No such file"):
        load_slip_table(tmp_path / "nowhere.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match=r"binary\.yaml: is no YAML"):
        load_slip_table(tmp_path / "binary.yaml")


def learned_with(place=(), value=..., **top):
    """Return the content of a small table of schema 2, what lies at a place replaced or removed."""
    entry = {
        "traction": {
            "slip_ratio": 0.2,
            "slip_std": 0.01,
            "n_runs": 6,
            "status": "estimated",
            "source": "runs",
        },
        "braking": {
            "slip_ratio": -0.3,
            "slip_std": 0.01,
            "n_runs": 6,
            "status": "estimated",
            "source": "runs",
        },
        "steady": {"slip_ratio": 0.1, "slip_std": 0.01, "n_runs": 6, "status": "estimated", "source": "runs"},
        "curve": {
            "law": "janosi",
            "parameters": {"limit_ratio": 0.5, "shear_ratio": 0.2},
            "peak_slip_ratio": 0.6,
            "peak_interval_ratio": [0.5, 0.7],
            "peak_status": "no_peak",
            "slip_range_ratio": [0.0, 0.7],
            "resistance_ratio": 0.1,
            "resistance_std": 0.01,
            "balance_slip_ratio": 0.1,
            "peak_based_slip_ratio": 0.54,
            "traction_efficiency_ratio": 0.3,
            "traction_energy_jpm": 150.0,
            "braking_energy_jpm": -80.0,
            "steady_energy_jpm": 90.0,
            "n_runs": 6,
        },
    }
    unknown = {
        state: {"slip_ratio": entry[state]["slip_ratio"], "status": "unestimated", "source": "median"}
        for state in DRIVE_STATES
    }
    content = {
        "schema": 2,
        "name": "own",
        "robot": "agrimaro",
        "fallback": "unknown",
        "terrains": {"unknown": unknown, "sand": entry},
    } | top
    *path, last = place or (None,)
    inner = content
    for key in path:
        inner = inner[key]
    if place and value is ...:
        del inner[last]
    elif place:
        inner[last] = value
    return content


def test_a_learned_table_is_read_with_its_curve(tmp_path):
    table = load_slip_table(write(tmp_path, learned_with()), robot="agrimaro")
    assert table.lookup("sand")["traction"] == ("sand", "traction", 0.2, 0.01, 6, "estimated", "runs")
    assert table.curves["sand"].peak_interval_ratio == (0.5, 0.7)
    assert table.curves["sand"].working_slip_ratio is None
    assert table.lookup("lava")["steady"].status == "unestimated"


SAND = ("terrains", "sand")
CURVE = (*SAND, "curve")


@pytest.mark.parametrize(
    ("place", "value", "fault"),
    [
        (("schema",), 3, "schema 3 is newer than 2"),
        (("schema",), "2", "schema is '2', 1 or 2 is required"),
        (("robot",), ..., "key 'robot' is missing"),
        (("robot",), "", "robot is '', the name of one"),
        (("robot",), "husky", "the table is for robot 'husky', not for 'agrimaro'"),
        (("made_by",), "me", "key 'made_by' is unknown"),
        (("fallback",), "lava", "the fallback 'lava' is no entry"),
        (("terrains", "unknown", "steady", "status"), "invalid", "the fallback 'unknown' is invalid"),
        ((*SAND, "steady"), ..., "sand needs just the drive states"),
        ((*SAND, "colour"), "red", "sand needs just the drive states"),
        ((*SAND, "steady", "slip_ratio"), 0.25, "sand: steady slip 0.25 is over that of traction, 0.2"),
        (
            (*SAND, "braking", "slip_ratio"),
            0.1,
            "sand, braking: slip_ratio is 0.1; braking slip cannot be pos",
        ),
        ((*SAND, "traction", "slip_ratio"), float("nan"), "sand, traction: slip_ratio is nan"),
        ((*SAND, "traction", "slip_std"), float("inf"), "sand, traction: slip_std is inf"),
        ((*SAND, "traction", "status"), ..., "sand, traction: needs slip_ratio, status and source"),
        ((*SAND, "traction", "status"), "good", "sand, traction: status is 'good'"),
        ((*SAND, "traction", "n_runs"), ..., "slip_std and n_runs go together"),
        ((*SAND, "reason"), 3, "sand: reason is 3"),
        ((*CURVE, "law"), "linear", "curve: law is 'linear'"),
        ((*CURVE, "parameters", "limit_ratio"), ..., "parameters: key 'limit_ratio' is missing"),
        ((*CURVE, "parameters", "shear_ratio"), float("nan"), "shear_ratio is nan"),
        ((*CURVE, "parameters", "shear_ratio"), 0.0, "shear_ratio is 0; 0.001 to 20 are accepted"),
        ((*CURVE, "parameters", "limit_ratio"), -1, "limit_ratio is -1; 0.001 to 5 are accepted"),
        ((*CURVE, "peak_status"), "top", "peak_status is 'top'"),
        ((*CURVE, "peak_interval_ratio"), [0.7, 0.5], "peak_interval_ratio is .0.7, 0.5.; two rising"),
        ((*CURVE, "slip_range_ratio"), 0.5, "slip_range_ratio is 0.5; two numbers"),
        ((*CURVE, "peak_slip_ratio"), 7, "peak_slip_ratio is 7; it must be within"),
        ((*CURVE, "n_runs"), 0, "n_runs is 0"),
        ((*CURVE, "steady_energy_jpm"), "much", "steady_energy_jpm is 'much'"),
        ((*CURVE, "extra"), 1, "key 'extra' is unknown"),
    ],
)
def test_a_learned_table_that_is_not_accepted_is_refused_in_one_sentence(tmp_path, place, value, fault):
    path = write(tmp_path, learned_with(place, value))
    with pytest.raises(ConfigError, match=rf"table\.yaml.*{fault}") as refusal:
        load_slip_table(path, robot="agrimaro")
    assert "\n" not in str(refusal.value)


def test_a_key_given_twice_is_refused(tmp_path):
    text = yaml.safe_dump(learned_with()) + "name: again\n"
    with pytest.raises(ConfigError, match="key 'name' is given twice"):
        load_slip_table(write(tmp_path, text))


def test_a_table_of_schema_1_is_for_any_robot_and_must_rise_too(tmp_path):
    assert load_slip_table(write(tmp_path, table_with()), robot="agrimaro").robot == ""
    falling = table_with(slip_ratio=0.1)
    falling["terrains"]["SNOW"]["steady"]["slip_ratio"] = 0.2
    path = write(tmp_path, falling)
    with pytest.raises(ConfigError, match=r"SNOW: steady slip 0\.2 is over that of traction, 0\.1"):
        load_slip_table(path)


def test_an_invalid_entry_falls_back(tmp_path):
    content = learned_with((*SAND, "traction", "status"), "invalid")
    table = load_slip_table(write(tmp_path, content))
    assert table.lookup("sand") == table.targets["unknown"]
    assert table.targets["sand"]["traction"].status == "invalid"


def ratio(low, high):
    return st.floats(low, high, allow_nan=False)


words = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12
).filter(lambda text: text.strip() == text)


@st.composite
def targets(draw, terrain):
    steady, traction = sorted(draw(st.tuples(ratio(0, 1), ratio(0, 1))))
    slips = {"traction": traction, "braking": draw(ratio(-1, 0)), "steady": steady}
    learned = draw(st.booleans())
    return {
        state: SlipTarget(
            terrain,
            state,
            slips[state],
            draw(ratio(0, 1)) if learned else math.nan,
            draw(st.integers(1, 99)) if learned else 0,
            "estimated" if learned else "unestimated",
            draw(words),
        )
        for state in DRIVE_STATES
    }


@st.composite
def curves(draw):
    law = draw(st.sampled_from(sorted(LAW_PARAMETERS)))
    number = ratio(-1, 1)
    pair = st.tuples(number, number).map(lambda edges: (min(edges), max(edges)))
    energy = ratio(-1e4, 1e4)
    return CurveEntry(
        law,
        {
            name: draw(ratio(least, most))
            for name, least, most in zip(LAW_PARAMETERS[law], *LAW_BOUNDS[law], strict=True)
        },
        draw(number),
        draw(pair),
        draw(st.sampled_from(["peak", "no_peak"])),
        draw(pair),
        *(draw(number) for _ in range(4)),
        draw(st.none() | number),
        draw(number),
        *(draw(energy) for _ in range(3)),
        draw(st.integers(1, 99)),
    )


@st.composite
def tables(draw):
    terrains = draw(st.lists(words, min_size=1, max_size=4, unique=True))
    some = draw(st.lists(st.sampled_from(terrains), unique=True))
    return SlipTable(
        draw(words),
        terrains[0],
        {terrain: draw(targets(terrain)) for terrain in terrains},
        draw(words),
        {terrain: draw(curves()) for terrain in some},
        {terrain: draw(words) for terrain in some},
    )


@settings(max_examples=60, deadline=None)
@given(table=tables())
def test_a_written_file_is_read_back_unchanged(tmp_path_factory, table):
    path = tmp_path_factory.getbasetemp() / "written.yaml"
    write_slip_table(table, path)
    found = load_slip_table(path, robot=table.robot)
    assert table_content(found) == table_content(table)
    assert (found.curves, found.reasons, found.robot) == (table.curves, table.reasons, table.robot)


def test_only_a_robots_table_is_written_and_whole_or_not_at_all(tmp_path):
    table = load_slip_table(write(tmp_path, learned_with()))
    with pytest.raises(ConfigError, match="is no robot's"):
        write_slip_table(replace(table, robot=""), tmp_path / "new.yaml")
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrainError, match="cannot be written"):
        write_slip_table(table, tmp_path / "file" / "new.yaml")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "table.yaml"]
