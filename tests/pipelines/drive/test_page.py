"""The page of a drive says what the result says, whoever is named how, and draws what a run did."""

import base64
import math
import re
from html import escape

import matplotlib
import numpy as np
import pytest

from pipelines.drive.controllers import CONTROLLERS
from pipelines.drive.drive import KEYS
from pipelines.drive.figures import bars_figure, drawn, ground_strips, run_figures
from pipelines.drive.page import difference, drive_figures, drive_page, shown_keys, write_drive_page
from pipelines.reporting.drawing import NOT_KNOWN, png_bytes
from terrain.control.slip_table import CurveEntry, SlipTable, load_slip_table
from terrain.control.traction import BRAKING, STEADY, TRACTION
from terrain.records import RunLog, Stream

TABLE = load_slip_table()
SAYS = ("status_code", "terrain_ratio", "probability_ratio", "target_ratio", "aimed_ratio",
        "balance_ratio", "slip_ratio", "slip_std_ratio", "stale_s", "drive_state_ratio", "driven_mps",
        "desired_mps")  # fmt: skip


def figure(mean, half=0.1, n=4):
    return {"mean": mean, "ci": None if mean is None else [mean - half, mean + half], "n": n}


def a_result(names=("plain", "ramp", "oracle"), scenario="starts", **more):
    by_name = {
        name: {key: figure(1.0 + place) for key in KEYS} | {"distance_5s_m": figure(3.0 - 0.1 * place)}
        for place, name in enumerate(names)
    }
    result = {
        "scenario": scenario,
        "terrain": "grass",
        "robot": "agrimaro",
        "table": "default",
        "seeds": [0, 1, 2, 3],
        "delay_s": 0.05,
        "grade_deg": 0.0,
        "ramp_mps2": 0.6582,
        "controllers": by_name,
    }
    return result | more


def a_run(name="oracle", blind=False, grounds=("grass",), wheel_radps=7.0, slip=0.2):
    """2 s at 0.8 m/s: held back in the first, one refusal at its end, braking in the last half second."""
    time_s = np.arange(200) / 100
    columns = {"speed_x_mps": 0.8, "speed_y_mps": 0.0}
    columns |= {f"wheel_{i}_radps": wheel_radps for i in (1, 2, 3)} | {
        f"slip_{i}_ratio": slip for i in (1, 2, 3)
    }
    truth = Stream(time_s, np.tile(list(columns.values()), (200, 1)), tuple(columns))
    told = dict.fromkeys(SAYS, np.full(100, math.nan)) | {"driven_mps": np.full(100, 0.9)}
    told |= {"desired_mps": np.ones(100), "status_code": np.zeros(100), "terrain_ratio": np.full(100, -1.0)}
    told["drive_state_ratio"] = np.full(100, float(STEADY))
    if not blind:
        told |= {
            key: np.full(100, 0.2) for key in ("target_ratio", "aimed_ratio", "balance_ratio", "slip_ratio")
        }
        told["drive_state_ratio"] = np.repeat([float(TRACTION), float(STEADY), float(BRAKING)], [50, 25, 25])
        told["status_code"] = np.where(np.arange(100) == 50, 2.0, 0.0)
        told["terrain_ratio"] = np.repeat([-1.0, list(TABLE.targets).index("clay")], 50)
    control = Stream(time_s[::2], np.column_stack(list(told.values())), tuple(told))
    edges = np.linspace(0, 2, len(grounds) + 1)
    labels = tuple(zip(edges[:-1], edges[1:], grounds, strict=True))
    return RunLog(name, "agrimaro", {"truth": truth, "control": control}, labels)


def with_curve():
    numbers = dict.fromkeys((field for field in CurveEntry.__dataclass_fields__), 0.1)
    numbers |= {
        "law": "janosi",
        "parameters": {"limit_ratio": 0.5, "shear_ratio": 0.2},
        "peak_status": "peak",
    }
    numbers |= {"peak_interval_ratio": (0.5, 0.6), "slip_range_ratio": (0.0, 0.7), "n_runs": 5}
    return SlipTable("t", "unknown", TABLE.targets, curves={"clay": CurveEntry(**numbers)})


def rows_of(page):
    """Return the cells of each table row, by the key in its second cell."""
    found = {}
    for row in re.findall(r"<tr>(.*?)</tr>", page, flags=re.S):
        cells = [
            re.sub("<[^>]+>", " ", cell).split() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, flags=re.S)
        ]
        found[" ".join(cells[1]) if len(cells) > 1 else ""] = cells
    return found


def test_the_page_names_every_controller_and_figure_and_fetches_nothing():
    names = (*CONTROLLERS, "told:clay", "target:0.2", "oracle+track")
    page = drive_page(a_result(names), {"oracle": a_run()}, TABLE)
    for name in names:
        assert f"<dt>{name}</dt>" in page
        assert f"<th scope=col>{name}</th>" in page
    assert all(f"<code>{key}</code>" in page for key in KEYS)
    assert rows_of(page)["slip_peak"][2] == ["1", "0.9", "to", "1.1"]
    assert "no more than 0.658 m/s²" in page
    assert f"<dd>{NOT_KNOWN}</dd>" not in page
    assert "would bring. Held to its way." in page
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_what_nobody_knows_is_a_dash_and_a_figure_of_few_days_says_so():
    result = a_result()
    of = result["controllers"]
    of["plain"]["slip_peak"] = figure(None, n=0)
    of["ramp"]["slip_peak"] = {"mean": math.nan, "ci": [math.nan, math.nan], "n": 0}
    of["oracle"]["slip_peak"] = {"mean": 0.25, "ci": None, "n": 1}
    page = drive_page(result, {}, TABLE)
    assert rows_of(page)["slip_peak"][2:] == [[NOT_KNOWN], [NOT_KNOWN], ["0.25", "(1)"]]
    for figures in of.values():
        figures["lock_s"] = figure(None, n=0)
    assert "Not defined here: longest lock of a wheel (<code>lock_s</code>)" in drive_page(result, {}, TABLE)


def test_words_of_users_are_escaped():
    name = "told:<b>&mud"
    result = a_result(("plain", name), terrain="<i>", robot='"r"', table="<u>")
    page = drive_page(result, {name: a_run(name)}, TABLE)
    assert escape(name) in page
    assert not any(raw in page for raw in (name, "<i>gr", "on <i>", "<u>", "<b>&m"))


def test_a_difference_is_taken_day_by_day_where_days_are_known():
    result = a_result(("plain", "oracle"))
    plain, gain = np.array([1.0, 2.0, 3.0, 4.0]), np.array([-0.19, -0.21, -0.2, -0.2])
    for name, values in (("plain", plain), ("oracle", plain + gain)):
        half = 3.182 * values.std(ddof=1) / 2
        result["controllers"][name]["slip_peak"] = figure(values.mean(), half)
    apart = difference(result, "oracle", "plain", "slip_peak")
    assert apart.mean == pytest.approx(-0.08)
    assert not apart.told_apart
    result["rows"] = {
        "plain": [{"slip_peak": x} for x in plain],
        "oracle": [{"slip_peak": x} for x in plain + gain],
    }
    paired = difference(result, "oracle", "plain", "slip_peak")
    assert paired.mean == pytest.approx(-0.08)
    assert paired.told_apart
    assert paired.high - paired.low == pytest.approx(
        2 * 3.182 * gain.std(ddof=1) / 2 / plain.mean(), rel=1e-3
    )
    assert "oracle against plain: largest slip \N{MINUS SIGN}8.0\N{NO-BREAK SPACE}%" in drive_page(
        result, {}, TABLE
    )
    result["rows"]["oracle"][0]["slip_peak"] = math.nan
    assert difference(result, "oracle", "plain", "slip_peak").mean == pytest.approx(gain[1:].mean() / 3.0)


def test_one_day_claims_no_interval():
    result = a_result(seeds=[7])
    for figures in result["controllers"].values():
        for value in figures.values():
            value |= {"ci": None, "n": 1}
    page = drive_page(result, {}, TABLE)
    assert "one day, which shows no spread" in page
    assert "<b>+" not in page
    assert "<b>\N{MINUS SIGN}" not in page
    assert not difference(result, "oracle", "plain", "slip_peak").told_apart


def test_only_who_hears_of_the_ground_adapts_to_it():
    result = a_result(("plain", "oracle"), scenario="course", terrain="course")
    page = drive_page(result, {}, TABLE)
    assert rows_of(page)["adapt_s"][2:] == [[NOT_KNOWN], ["2", "1.9", "to", "2.1"]]
    assert "course on all grounds" in page
    assert "adapt_s" in shown_keys(result)
    assert "adapt_s" not in shown_keys(a_result())


def test_slip_is_signed_by_the_way_and_smoothed_as_its_estimate():
    forward, reversing = drawn(a_run(slip=0.2)), drawn(a_run(wheel_radps=-7.0, slip=-0.2))
    assert forward.slip[-1] == pytest.approx(0.2, abs=1e-6) == reversing.slip[-1]
    assert forward.slip[5] == pytest.approx(0.2 * (1 - math.exp(-6 * 0.01 / 0.05)))
    dragged = drawn(a_run(wheel_radps=-1.0, slip=-1.1))  # turns backwards, the robot still goes on
    assert dragged.slip[-1] == pytest.approx(-1.0, abs=1e-6)


def test_a_run_shows_states_refusals_and_grounds():
    run = a_run(grounds=("grass", "clay"))
    plain = a_run("plain", blind=True, grounds=("grass", "clay"))
    pictures = run_figures({"oracle": run, "plain": plain}, TABLE)
    labels = {name: {text for axes in picture.axes for text in axes.get_legend_handles_labels()[1]}
              for name, picture in pictures.items()}  # fmt: skip
    assert {"traction: speed rises", "braking", "no correction: stale", "target", "aimed for"} <= labels[
        "oracle"
    ]
    assert not labels["plain"] & {"target", "aimed for", "braking", "no correction: stale"}
    assert pictures["oracle"].axes[1].get_ylim() == pictures["plain"].axes[1].get_ylim()
    strips = dict(ground_strips(run, drawn(run), TABLE))
    assert [name for *_, name in strips["true"]] == ["grass", "clay"]
    assert strips["believed"] == [(1.0, 1.98, "clay")]
    assert set(dict(ground_strips(plain, drawn(plain), TABLE))) == {"true"}
    assert ground_strips(a_run(), drawn(a_run()), TABLE) == []


def test_curves_are_drawn_where_the_table_has_any():
    assert "curves" in drive_figures(a_result(), {}, with_curve())
    assert "curves" not in drive_figures(a_result(), {}, TABLE)


def test_the_same_result_gives_the_same_bytes_whatever_matplotlib_is_set_to(tmp_path):
    def made(folder):
        write_drive_page(folder, a_result(("plain", "told:clay")), {"told:clay": a_run()}, with_curve())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*.*")}

    first = made(tmp_path / "a")
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "black", "lines.linewidth": 9}):
        assert made(tmp_path / "b") == first
    stems = ("bars", "run_told_clay", "curves")
    assert set(first) == {
        "drive.html",
        *(f"figures/{stem}.{end}" for stem in stems for end in ("png", "svg")),
    }
    for stem in stems:  # what is written beside the page is what is on it
        assert base64.b64encode(first[f"figures/{stem}.svg"]) in first["drive.html"]


def test_bars_survive_intervals_wider_than_the_picture_and_no_figure_at_all():
    from pipelines.drive.figures import Panel

    odd = Panel("odd", {"plain": (1.0, [-50.0, 52.0]), "ramp": (None, None), "fixed": (-0.5, None)})
    none = Panel("none", {"plain": (None, None), "ramp": (0.0, None), "fixed": (0.0, [0.0, 0.0])})
    picture = bars_figure([odd, none], 4)
    low, high = picture.axes[0].get_xlim()
    assert -2.0 < low < -0.5
    assert 1.0 < high < 3.0
    assert [text.get_text().strip() for text in picture.axes[0].texts] == [
        "1",
        NOT_KNOWN,
        "\N{MINUS SIGN}0.5",
    ]
    assert png_bytes(picture)
