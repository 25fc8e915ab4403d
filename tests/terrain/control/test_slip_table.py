"""Tables of target slips: the packaged one, what is refused in a file, and that a written table is read back."""

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
from terrain.records import SlipTarget
from terrain.slip_learning.curve import LAW_BOUNDS, LAW_PARAMETERS

SLIPS = {"traction": 0.2, "braking": -0.3, "steady": 0.1}
SNOW = ("terrains", "SNOW", "traction")
SAND = ("terrains", "sand")
CURVE = (*SAND, "curve")
RATIOS = ("peak_slip", "balance_slip", "peak_based_slip", "resistance", "traction_efficiency")


def numbers(terrain, *learned):
    return {state: SlipTarget(terrain, state, slip, *learned) for state, slip in SLIPS.items()}


def sand_table():
    """A small table of a robot, with a curve."""
    curve = CurveEntry(
        law="janosi",
        parameters={"limit_ratio": 0.5, "shear_ratio": 0.2},
        peak_interval_ratio=(0.5, 0.7),
        peak_status="no_peak",
        slip_range_ratio=(0.0, 0.7),
        resistance_std=0.01,
        n_runs=6,
        n_sessions=2,
        **{f"{name}_ratio": 0.3 for name in RATIOS},
        **{f"{state}_energy_jpm": 90.0 for state in DRIVE_STATES},
    )
    targets = {"unknown": numbers("unknown", math.nan, 0, "unestimated", "median")}
    targets["sand"] = numbers("sand", 0.01, 6, "estimated", "runs", 2)
    return SlipTable("own", "unknown", targets, "agrimaro", {"sand": curve})


def learned():
    """Return the content of that table, of schema 2."""
    return yaml.safe_load(yaml.safe_dump(table_content(sand_table())))


def plain():
    """Return the content of a small table of schema 1."""
    entry = {state: {"slip_ratio": slip, "source": "assumed"} for state, slip in SLIPS.items()}
    terrains = {
        name: {state: dict(number) for state, number in entry.items()} for name in ("unknown", "SNOW")
    }
    return {"name": "own", "fallback": "unknown", "terrains": terrains}


def changed(content, place, value):
    """Replace what lies at a place of a content, or remove it."""
    *path, last = place
    inner = content
    for key in path:
        inner = inner[key]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return content


def write(folder, content):
    path = folder / "table.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_the_packaged_table_has_a_sound_and_sourced_number_everywhere():
    table = load_slip_table()
    assert {"ASPHALT", "ICE", "SNOW", "PLOUGHED", table.fallback} <= set(table.targets)
    for terrain, by_state in table.targets.items():
        assert tuple(by_state) == DRIVE_STATES
        for state, target in by_state.items():
            assert (target.terrain, target.drive_state) == (terrain, state)
            assert target.source.strip()
            assert math.isnan(target.slip_std) == (target.n_runs == 0) == (target.status == "unestimated")
        assert by_state["braking"].slip_ratio < 0 <= by_state["steady"].slip_ratio
        assert by_state["steady"].slip_ratio <= by_state["traction"].slip_ratio


def test_a_table_of_either_schema_is_read_and_unknown_or_invalid_terrain_falls_back(tmp_path):
    table = load_slip_table(write(tmp_path, plain()), robot="agrimaro")
    assert (table.robot, table.lookup("LAVA")) == ("", table.targets["unknown"])
    table = load_slip_table(write(tmp_path, learned()), robot="agrimaro")
    assert table.lookup("sand")["traction"] == ("sand", "traction", 0.2, 0.01, 6, "estimated", "runs", 2)
    assert table.curves["sand"].peak_interval_ratio == (0.5, 0.7)
    table = load_slip_table(write(tmp_path, changed(learned(), (*SAND, "traction", "status"), "invalid")))
    assert table.lookup("sand") == table.targets["unknown"]


REFUSED = [
    (("extra",), 1, "key 'extra' is unknown"),
    (("fallback",), "LAVA", "the fallback 'LAVA' is no entry of terrains"),
    (("terrains",), ["SNOW"], "the fallback 'unknown' is no entry of terrains"),
    (("terrains", "SNOW", "steady"), ..., "SNOW: key 'steady' is missing"),
    ((*SNOW, "slip_ratio"), 1.5, "SNOW: traction.slip_ratio is 1.5"),
    ((*SNOW, "slip_ratio"), math.nan, "SNOW: traction.slip_ratio is nan"),
    ((*SNOW, "slip_ratio"), True, "SNOW: traction.slip_ratio is True"),
    ((*SNOW, "slip_ratio"), -0.1, "SNOW, traction: slip_ratio is -0.1; traction slip cannot be neg"),
    ((*SNOW, "slip_ratio"), 0.05, "SNOW: steady slip 0.1 is over that of traction, 0.05"),
    ((*SNOW, "source"), " ", "SNOW: traction.source is"),
    ((*SNOW, "unit"), "%", "SNOW: key 'traction.unit' is unknown"),
    ((*SNOW, "n_runs"), 3, "SNOW, traction: slip_std and n_runs go together"),
]
REFUSED_LEARNED = [
    (("schema",), 3, "schema 3 is newer than 2"),
    (("robot",), ..., "key 'robot' is missing"),
    (("robot",), "", "robot is '', the name of one"),
    (("robot",), "husky", "the table is for robot 'husky', not for 'agrimaro'"),
    (("terrains", "unknown", "steady", "status"), "invalid", "the fallback 'unknown' is invalid"),
    ((*SAND, "braking", "slip_ratio"), 0.1, "sand, braking: slip_ratio is 0.1; braking slip cannot"),
    ((*SAND, "traction", "status"), "good", "sand: traction.status is 'good'"),
    ((*SAND, "reason"), 3, "sand: reason is 3"),
    ((*SAND, "traction", "n_sessions"), 7, "sand, traction: n_sessions is 7, of 6 runs"),
    ((*CURVE, "law"), "linear", "sand, curve: law is 'linear'"),
    ((*CURVE, "parameters", "limit_ratio"), ..., "sand, curve: parameters: key 'limit_ratio' is missing"),
    ((*CURVE, "parameters", "shear_ratio"), 0.0, "sand, curve: shear_ratio is 0; 0.001 to 20"),
    ((*CURVE, "peak_status"), "top", "sand: curve.peak_status is 'top'"),
    ((*CURVE, "peak_interval_ratio"), [0.7, 0.5], "sand, curve: peak_interval_ratio is 0.7 to 0.5"),
    ((*CURVE, "n_runs"), 0, "sand: curve.n_runs is 0"),
]


@pytest.mark.parametrize(
    ("content", "place", "value", "fault"),
    [(plain, *row) for row in REFUSED] + [(learned, *row) for row in REFUSED_LEARNED],
)
def test_a_table_that_is_not_accepted_is_refused_in_one_sentence(tmp_path, content, place, value, fault):
    path = write(tmp_path, changed(content(), place, value))
    with pytest.raises(ConfigError, match=rf"table\.yaml: {fault}") as refusal:
        load_slip_table(path, robot="agrimaro")
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_no_table_is_refused(tmp_path):
    twice = yaml.safe_dump(learned()) + "name: again\n"
    for text, fault in (("a: [1", "is no YAML"), ("- 1", "a mapping with"), (twice, "twice")):
        with pytest.raises(ConfigError, match=rf"table\.yaml.*{fault}"):
            load_slip_table(write(tmp_path, text))
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be opened"):
        load_slip_table(tmp_path / "nowhere.yaml")


def ratio(low, high):
    return st.floats(low, high, allow_nan=False)


words = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cs", "Cc", "Z"]), min_size=1, max_size=12
).filter(lambda text: text.strip() == text)


@st.composite
def tables(draw):
    terrains, number = draw(st.lists(words, min_size=1, max_size=4, unique=True)), ratio(-1, 1)
    pair = st.tuples(number, number).map(lambda edges: (min(edges), max(edges)))
    targets, curves = {}, {}
    for terrain in terrains:
        steady, traction = sorted(draw(st.tuples(ratio(0, 1), ratio(0, 1))))
        slips = {"traction": traction, "braking": draw(ratio(-1, 0)), "steady": steady}
        known = (draw(ratio(0, 1)), draw(st.integers(1, 99)), "estimated")
        known = known if draw(st.booleans()) else (math.nan, 0, "unestimated")
        targets[terrain] = {s: SlipTarget(terrain, s, slips[s], *known, draw(words)) for s in DRIVE_STATES}
        law = draw(st.sampled_from(sorted(LAW_PARAMETERS)))
        bounds = zip(LAW_PARAMETERS[law], *LAW_BOUNDS[law], strict=True)
        curves[terrain] = replace(
            sand_table().curves["sand"],
            law=law,
            parameters={name: draw(ratio(least, most)) for name, least, most in bounds},
            peak_interval_ratio=draw(pair),
            peak_status=draw(st.sampled_from(["peak", "no_peak"])),
            working_slip_ratio=draw(st.none() | number),
            **{f"{name}_ratio": draw(number) for name in RATIOS},
        )
    some = draw(st.lists(st.sampled_from(terrains), unique=True))
    reasons = {terrain: draw(words) for terrain in some}
    return SlipTable(draw(words), terrains[0], targets, draw(words), {t: curves[t] for t in some}, reasons)


@settings(max_examples=25, deadline=None)
@given(table=tables())
def test_a_written_file_is_read_back_unchanged(tmp_path_factory, table):
    path = tmp_path_factory.getbasetemp() / "written.yaml"
    write_slip_table(table, path)
    found = load_slip_table(path, robot=table.robot)
    assert table_content(found) == table_content(table)
    assert (found.curves, found.reasons, found.robot) == (table.curves, table.reasons, table.robot)


def test_only_a_robots_table_is_written_and_whole_or_not_at_all(tmp_path):
    with pytest.raises(ConfigError, match="is no robot's"):
        write_slip_table(replace(sand_table(), robot=""), tmp_path / "new.yaml")
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrainError, match="cannot be written"):
        write_slip_table(sand_table(), tmp_path / "file" / "new.yaml")
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
