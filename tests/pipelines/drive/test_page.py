"""The page of a drive shows the result, with any names of controllers, and draws what a run did."""

import base64
import math
import re
from dataclasses import replace
from html import escape

import matplotlib
import numpy as np
import pytest

from pipelines.drive.bar_figure import Panel, bars_figure
from pipelines.drive.controller_names import CONTROLLERS
from pipelines.drive.page import drive_page, write_drive_page
from pipelines.drive.results import DriveResult
from pipelines.drive.run_figures import drive_curves, run_figures, terrain_strips
from pipelines.drive.view import difference, drive_figures, shown_metrics
from pipelines.live.pilot_settings import PilotStatus
from pipelines.reporting.drawing import png_bytes
from pipelines.reporting.numbers import NOT_KNOWN
from terrain.control.comparison import MeanInterval, mean_interval
from terrain.control.drive_evaluation import METRICS
from terrain.control.power_state import DriveState
from terrain.control.slip_table import CurveEntry, SlipTable, load_slip_table
from terrain.records import RunLog, Stream

TABLE = load_slip_table()
NONE = MeanInterval(None, None, 0)
SPREAD = np.array([-0.06, 0.04, -0.04, 0.06])
"""Of a metric over the four seeds."""


def a_result(names=("plain", "ramp", "true_terrain"), values=None, **more):
    """A result of four seeds whose metrics have the mean 1, 2, ... in the order of the controllers.

    Parameters
    ----------
    values : by controller and metric, the values of the seeds in place of those
    """
    rows = {}
    for place, name in enumerate(names):
        metrics = dict.fromkeys(METRICS, 1.0 + place + SPREAD) | {"distance_5s_m": 3.0 - 0.1 * place + SPREAD}
        metrics |= (values or {}).get(name, {})
        rows[name] = tuple(
            dict(zip(metrics, row, strict=True)) for row in zip(*metrics.values(), strict=True)
        )
    result = DriveResult(
        scenario="starts",
        terrain="grass",
        robot="agrimaro",
        table="default",
        seeds=(0, 1, 2, 3),
        delay_s=0.05,
        grade_deg=0.0,
        ramp_mps2=0.6582,
        controllers={
            name: {key: mean_interval([row[key] for row in found]) for key in found[0]}
            for name, found in rows.items()
        },
        rows=rows,
    )
    return replace(result, **more)


def a_run(name="true_terrain", open_loop=False, terrains=("grass",), wheel_radps=7.0, slip=0.2):
    """2 s at 0.8 m/s: limited in the first, one refusal at its end, braking in the last half second."""
    time_s = np.arange(200) / 100
    columns = {"speed_x_mps": 0.8, "speed_y_mps": 0.0}
    columns |= {f"wheel_{i}_radps": wheel_radps for i in (1, 2, 3)} | {
        f"slip_{i}_ratio": slip for i in (1, 2, 3)
    }
    truth = Stream(time_s, np.tile(list(columns.values()), (200, 1)), tuple(columns))
    status = dict.fromkeys(PilotStatus._fields, np.full(100, math.nan)) | {"driven_mps": np.full(100, 0.9)}
    status |= {"desired_mps": np.ones(100), "status_code": np.zeros(100), "terrain_code": np.full(100, -1.0)}
    status["drive_state_code"] = np.full(100, float(DriveState.STEADY))
    if not open_loop:
        status |= {
            key: np.full(100, 0.2) for key in ("target_ratio", "aimed_ratio", "balance_ratio", "slip_ratio")
        }
        status["drive_state_code"] = np.repeat(
            [float(DriveState.TRACTION), float(DriveState.STEADY), float(DriveState.BRAKING)], [50, 25, 25]
        )
        status["status_code"] = np.where(np.arange(100) == 50, 2.0, 0.0)
        status["terrain_code"] = np.repeat([-1.0, list(TABLE.targets).index("clay")], 50)
    control = Stream(time_s[::2], np.column_stack(list(status.values())), tuple(status))
    edges = np.linspace(0, 2, len(terrains) + 1)
    labels = tuple(zip(edges[:-1], edges[1:], terrains, strict=True))
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


def test_the_page_names_every_controller_and_metric_and_loads_nothing():
    names = (*CONTROLLERS, "known:clay", "target:0.2", "true_terrain+track")
    page = drive_page(a_result(names), {"true_terrain": a_run()}, TABLE)
    for name in names:
        assert f"<dt>{name}</dt>" in page
        assert f"<th scope=col>{name}</th>" in page
    assert all(f"<code>{key}</code>" in page for key in METRICS)
    assert rows_of(page)["slip_peak"][2] == ["1", "0.906", "to", "1.09"]
    assert "no more than 0.658 m/s²" in page
    assert f"<dd>{NOT_KNOWN}</dd>" not in page
    assert "without error. With path tracking." in page
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_unknown_values_are_a_dash_and_values_of_few_seeds_say_so():
    nan, few = np.full(4, math.nan), np.array([math.nan, math.nan, 0.25, math.nan])
    values = {
        "plain": {"slip_peak": nan, "lock_s": nan},
        "ramp": {"slip_peak": nan, "lock_s": nan},
        "true_terrain": {"slip_peak": few, "lock_s": nan},
    }
    page = drive_page(a_result(values=values), {}, TABLE)
    assert rows_of(page)["slip_peak"][2:] == [[NOT_KNOWN], [NOT_KNOWN], ["0.25", "(1)"]]
    assert "Not defined here: longest lock of a wheel (<code>lock_s</code>)" in page


def test_names_of_users_are_escaped():
    name = "known:<b>&mud"
    result = a_result(("plain", name), terrain="<i>", robot='"r"', table="<u>")
    page = drive_page(result, {name: a_run(name)}, TABLE)
    assert escape(name) in page
    assert not any(raw in page for raw in (name, "<i>gr", "on <i>", "<u>", "<b>&m"))


def test_a_difference_is_taken_seed_by_seed():
    plain, gain = np.array([1.0, 2.0, 3.0, 4.0]), np.array([-0.19, -0.21, -0.2, -0.2])
    values = {"plain": {"slip_peak": plain}, "true_terrain": {"slip_peak": plain + gain}}
    result = a_result(("plain", "true_terrain"), values)
    paired = difference(result, "true_terrain", "plain", "slip_peak")
    assert paired.mean == pytest.approx(-0.08)
    assert paired.is_significant
    assert paired.high - paired.low == pytest.approx(
        2 * 3.182 * gain.std(ddof=1) / 2 / plain.mean(), rel=1e-3
    )
    sentence = "true_terrain compared with plain: largest slip \N{MINUS SIGN}8.0\N{NO-BREAK SPACE}%"
    assert sentence in drive_page(result, {}, TABLE)
    values["true_terrain"]["slip_peak"] = plain + gain + [math.nan, 0.0, 0.0, 0.0]
    result = a_result(("plain", "true_terrain"), values)
    found = difference(result, "true_terrain", "plain", "slip_peak")
    assert found.mean == pytest.approx(gain[1:].mean() / 3.0)


def test_one_seed_has_no_interval():
    result = a_result(seeds=(7,))
    rows = {name: found[:1] for name, found in result.rows.items()}
    controllers = {
        name: {key: MeanInterval(value, None, 1) for key, value in found[0].items()}
        for name, found in rows.items()
    }
    result = replace(result, rows=rows, controllers=controllers)
    page = drive_page(result, {}, TABLE)
    assert "one seed, which gives no interval" in page
    assert "<b>+" not in page
    assert "<b>\N{MINUS SIGN}" not in page
    assert not difference(result, "true_terrain", "plain", "slip_peak").is_significant


def test_only_controllers_that_use_the_terrain_adapt_to_it():
    names = ("plain", "true_terrain", "true_terrain+track")
    result = a_result(names, scenario="course", terrain="course")
    page = drive_page(result, {}, TABLE)
    known = [["2", "1.91", "to", "2.09"], ["3", "2.91", "to", "3.09"]]
    assert rows_of(page)["adapt_s"][2:] == [[NOT_KNOWN], *known]
    assert "course on all terrains" in page
    assert "adapt_s" in shown_metrics(result)
    assert "adapt_s" not in shown_metrics(a_result())


def test_slip_is_signed_by_the_motion_and_filtered_as_its_estimate():
    forward, reversing = drive_curves(a_run(slip=0.2)), drive_curves(a_run(wheel_radps=-7.0, slip=-0.2))
    assert forward.slip[-1] == pytest.approx(0.2, abs=1e-6) == reversing.slip[-1]
    assert forward.slip[5] == pytest.approx(0.2 * (1 - math.exp(-6 * 0.01 / 0.05)))
    dragged = drive_curves(a_run(wheel_radps=-1.0, slip=-1.1))  # turns backwards while the robot moves on
    assert dragged.slip[-1] == pytest.approx(-1.0, abs=1e-6)
    locked = drive_curves(a_run(wheel_radps=0.0, slip=-1.0))
    assert locked.slip[-1] == pytest.approx(-1.0, abs=1e-6)


def test_a_run_shows_states_refusals_and_terrains():
    run = a_run(terrains=("grass", "clay"))
    plain = a_run("plain", open_loop=True, terrains=("grass", "clay"))
    pictures = run_figures({"true_terrain": run, "plain": plain}, TABLE)
    labels = {name: {text for axes in picture.axes for text in axes.get_legend_handles_labels()[1]}
              for name, picture in pictures.items()}  # fmt: skip
    assert {
        "traction: speed rises",
        "braking",
        "no correction: stale",
        "target",
        "target with its floor",
    } <= labels["true_terrain"]
    assert not labels["plain"] & {"target", "target with its floor", "braking", "no correction: stale"}
    assert pictures["true_terrain"].axes[1].get_ylim() == pictures["plain"].axes[1].get_ylim()
    strips = dict(terrain_strips(run, drive_curves(run), TABLE))
    assert [name for *_, name in strips["true"]] == ["grass", "clay"]
    assert strips["classified"] == [(1.0, 1.98, "clay")]
    assert set(dict(terrain_strips(plain, drive_curves(plain), TABLE))) == {"true"}
    assert terrain_strips(a_run(), drive_curves(a_run()), TABLE) == []


def test_curves_are_drawn_where_the_table_has_any():
    assert "curves" in drive_figures(a_result(), {}, with_curve())
    assert "curves" not in drive_figures(a_result(), {}, TABLE)


@pytest.mark.slow
def test_the_same_result_gives_the_same_bytes_whatever_matplotlib_is_set_to(tmp_path):
    def made(folder):
        write_drive_page(folder, a_result(("plain", "known:clay")), {"known:clay": a_run()}, with_curve())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*.*")}

    first = made(tmp_path / "a")
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "black", "lines.linewidth": 9}):
        assert made(tmp_path / "b") == first
    stems = ("bars", "run_known_clay", "curves")
    assert set(first) == {
        "drive.html",
        *(f"figures/{stem}.{end}" for stem in stems for end in ("png", "svg")),
    }
    for stem in stems:  # what is written beside the page is what is on it
        assert base64.b64encode(first[f"figures/{stem}.svg"]) in first["drive.html"]


def test_bars_with_wide_intervals_and_without_values_are_drawn():
    odd = Panel(
        "odd",
        {"plain": MeanInterval(1.0, (-50.0, 52.0), 2), "ramp": NONE, "fallback": MeanInterval(-0.5, None, 1)},
    )
    none = Panel(
        "none",
        {"plain": NONE, "ramp": MeanInterval(0.0, None, 1), "fallback": MeanInterval(0.0, (0.0, 0.0), 2)},
    )
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
