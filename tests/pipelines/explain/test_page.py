"""The page of a diagnosis says what the answer says, whatever the answer is."""

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from pipelines.explain.page import explain_page, figure_view
from pipelines.explain.results import Explanation, HeldOutGain
from pipelines.explain.view import RunPicture
from pipelines.explain.wording import limit_text, quantity, verdict_text
from pipelines.reporting.json_file import as_json
from pipelines.reporting.numbers import NOT_KNOWN
from pipelines.reporting.pictures import png_image
from terrain.discrepancy.filter_gain import Change, Comparison
from terrain.discrepancy.gain import ChannelGain, Gain, Reduction
from terrain.discrepancy.health.faults import Column, Fault, FaultKind
from terrain.discrepancy.health.runs import Clock, Excluded
from terrain.discrepancy.nameless import Learned, Nameless
from terrain.discrepancy.next_drive import next_command
from terrain.discrepancy.response_slopes import Slope
from terrain.discrepancy.statements import Statement
from terrain.discrepancy.verdict import (
    Cause,
    Diagnosis,
    Limit,
    NextDrive,
    Residual,
    RuledOut,
    RunGroup,
    Unexplained,
    Value,
    Varying,
    Verdict,
)
from terrain.robots import load_robot

LIMITS = (
    Limit("steering_offset_1_rad", 0.003, "rad", "several speeds"),
    Limit("payload_ratio", np.inf, "ratio", "slopes"),
    Limit("clock_rate_ratio", 0.05, "ratio", "switching"),
)


def a_diagnosis(**more):
    empty = {
        "robot": "a<b>",
        "verdict": Verdict.NONE,
        "causes": (),
        "parameters": (),
        "cov": np.empty((0, 0)),
        "ambiguous_sets": (),
        "ambiguous_values": {},
        "unexplained": (),
        "limits": LIMITS,
        "not_excited": (),
        "ruled_out": (RuledOut("scrub", "the runs show nothing of it", 0.44),),
        "excluded_runs": (),
        "clocks": (),
        "next_drive": None,
        "residual_before": {"speed_x_mps": Residual(0.02, 0.01, 0.75)},
        "residual_after": {"speed_x_mps": Residual(0.01, 0.01, 0.0)},
        "n_runs": 5,
    }
    return Diagnosis(**(empty | more))


def a_cause():
    values = (Value("lever_x_m", 0.1, "m", 0.09, 0.11), Value("lever_y_m", -0.05, "m", -0.06, -0.04))
    return Cause("lever_arm", ("an_alias",), values, 0.4, 0.3, 0.5, ("speed_y_mps", "speed_x_mps"), 9.04, 4.0)


def a_gain(refused=False, high=0.8, **comparisons):
    channel = ChannelGain(0.02, 0.01, 2.0, np.nan, Reduction(0.75, -0.1 if refused else 0.7, high))
    whole = Reduction(0.5, -0.2 if refused else 0.4, 0.6)
    found = Gain(("r1", "r2"), (), "thirds of runs", {"speed_x_mps": channel}, whole)
    return HeldOutGain(found, None, {"filter": None, **comparisons})


def a_result(gain=None, **more):
    return Explanation(
        data="field & co",
        data_digest="0123456789abcdef",
        description="husky.yaml",
        model=None,
        terrain=None,
        diagnosis=a_diagnosis(**more),
        built_in={},
        terrains=(),
        effects=("payload",),
        seed=4,
        used=("r3",),
        held_out=("r1", "r2"),
        gain=gain or HeldOutGain(None, "nothing was built in"),
        extended=None,
        page=Path("explain.html"),
    )


def text_of(page):
    text = unescape(re.sub(r"<[^>]+>", " ", page.partition("<body>")[2]))
    return " ".join(text.replace("\N{MINUS SIGN}", "-").split())


def page_of(result, runs=()):
    return explain_page(result, [figure_view("stretch", "<svg/>", b"png")], runs)


def test_a_cause_is_shown_with_value_interval_gain_and_aliases():
    result = a_result(a_gain(), verdict=Verdict.EXPLAINED, causes=(a_cause(),))
    text = text_of(page_of(result))
    assert "The simulation lacks lever arm (0.1 m, -50 mm)." in text.replace("\xa0", " ")
    assert "lever_x_m 0.1 m 0.09 to 0.11 40 % 30 % to 50 % speed to the left, speed ahead 9" in text
    assert "no log distinguishes it from: an alias" in text
    assert "On 2 held-out runs the extension removes 50 % of the squared residual" in text
    assert "commanded" not in text  # no run logs commands
    assert "Values are added to what the description has already" in text


def test_sentences_come_first_then_gains_then_withdrawn_then_pictures_and_nothing_is_fetched():
    runs = [
        RunPicture("first", "pictures/a.png", png_image(b"png", "first")),
        RunPicture("2 > 1", 'pictures/"b".png', None),
    ]
    fault = Fault(FaultKind.SIGN, Column.GYRO, ("r3",), -1.0, "the gyro's sign is turned", "multiply", None)
    withdrawn = RuledOut("clock_offset", "it changes", 9.0, (Value("clock_offset_s", 0.1, "s", 0.09, 0.11),))
    statement = Statement(
        "speed_x_mps", Slope(0.5, 0.1), (), 0.2, 0.1, "", "speed ahead: it drives too fast.", True
    )
    result = a_result(
        a_gain(), causes=(a_cause(),), faults=(fault,), ruled_out=(withdrawn,), not_excited=LIMITS[1:]
    )
    page = page_of(replace(result, statements=(statement,)), runs)
    marks = [
        "The gyro&#39;s sign is turned.",
        "<b>Speed ahead</b>: it drives too fast.",
        "The simulation lacks",
    ]
    marks += [
        "Gain on held-out runs",
        "Withdrawn",
        "0.1\xa0s (90\xa0ms to 0.11\xa0s)",
        "<img",
        "Not excited",
        "Where these",
    ]
    places = [page.index(mark) for mark in marks]
    assert places == sorted(places)
    assert re.findall(r'(?:src|href)="(?!data:)([^"]*)', page) == ["pictures/&#34;b&#34;.png"]
    assert "<script" not in page
    assert "<summary>first</summary>" in page
    assert ">2 &gt; 1</a>" in page
    assert "a&lt;b&gt;" in page
    assert "<b>gets" not in page


def test_a_gain_that_is_refused_is_not_claimed():
    text = text_of(page_of(a_result(a_gain(refused=True), causes=(a_cause(),))))
    assert "no gain can be claimed" in text
    assert "no gain to claim" in text
    worse = a_gain(refused=True, high=-0.05)
    assert "worse than before" in text_of(page_of(a_result(worse, causes=(a_cause(),))))
    learned = Nameless(2, {"speed_x_mps": Learned(0.02, 0.01, 0.76, 0.75, -0.02)}, 0.76, 0.75)
    text = text_of(page_of(a_result(replace(a_gain(), nameless=learned), causes=(a_cause(),))))
    assert "speed ahead m/s 0.02 0.01 75 % 70 % to 80 % 76 %" in text.replace("\xa0", " ")
    assert "a nameless learner 76 %: little is left to find." in text
    bare = text_of(page_of(a_result()))
    assert "The gain on held-out runs was not measured: nothing was built in." in bare


def test_errors_of_filter_and_classifier_are_shown_where_there_are_any():
    errors = {"speed_mps": Change(0.1, 0.05, (-0.06, -0.04))}
    accuracy = {"accuracy": Change(0.8, 0.9, None)}
    gain = a_gain(
        filter=Comparison("vio12", None, 2, errors), classifier=Comparison("svm", None, 2, accuracy, ("a",))
    )
    text = text_of(page_of(a_result(gain, causes=(a_cause(),))))
    assert "Error of the filter vio12" in text
    assert "speed, root mean square m/s 0.1 0.05 -0.06 to -0.04" in text
    assert f"accuracy 0.8 0.9 {NOT_KNOWN}" in text
    gain = a_gain(filter=Comparison("vio12", "no camera", 2, {}))
    assert "Not measured: no camera" in text_of(page_of(a_result(gain, causes=(a_cause(),))))


def test_an_ambiguous_set_is_shown_with_what_would_distinguish_it_and_what_to_drive():
    values = {
        name: (Value(f"{name}_ratio", 0.2, "ratio", 0.1, 0.3),) for name in ("payload", "motor_constant")
    }
    result = a_result(
        verdict=Verdict.AMBIGUOUS,
        ambiguous_sets=(("payload", "motor_constant"),),
        ambiguous_values=values,
        next_drive=NextDrive("climb", 6.0, "it parts them"),
    )
    text = text_of(page_of(result)).replace("\xa0", " ")
    assert "One of payload or motor constant is present, and these runs cannot distinguish them." in text
    assert (
        "payload 20 % (10 % to 30 %) accelerations and slopes; speed ahead distinguishes it from motor "
        "constant" in text
    )
    assert "Scenario climb, on a slope of 6° It parts them." in text


def test_unexplained_channels_effects_not_excited_and_excluded_runs_are_shown():
    result = a_result(
        verdict=Verdict.UNEXPLAINED,
        unexplained=(
            Unexplained("current_a", "wheel 1 turn", 12.34, 0.2),
            Unexplained("speed_x_mps", "time", np.inf, 0),
        ),
        not_excited=LIMITS[1:],
        excluded_runs=(Excluded("r<9>", "its gyro stands still"),),
        clocks=(Clock("r3", 0.0123, 0.001), Clock("r4", np.nan, np.inf)),
    )
    page = page_of(result)
    text = text_of(page).replace("\xa0", " ")
    assert (
        "The residual is systematic, without a known cause, in sum of the currents and speed ahead." in text
    )
    assert "Of 3 parameters that may be wrong, 2 could not have been detected." in text
    assert "sum of the currents depends on wheel 1 turn 12.3 20 %" in text
    assert "A payload of any size would not have been detected." in text
    assert "A clock rate of any size that is likely (up to 2 %) would not have been detected." in text
    assert "A steering offset 1 under 3 mrad would not have been detected." in text
    assert "r<9> its gyro stands still" in text
    assert f"r3 12.3 ms 1 ms r4 {NOT_KNOWN} {NOT_KNOWN}" in text
    assert "scrub The runs show nothing of it. 0.4" in text


def test_nothing_found_says_so():
    assert verdict_text(a_result().diagnosis) == "These runs show nothing that the simulation lacks."


@pytest.mark.parametrize(
    ("parameter", "value", "text"),
    [
        ("gyro_bias_radps", -0.00314, "-3.1 mrad/s"),
        ("camera_latency_s", 0.25, "0.25 s"),
        ("viscous_drag_nspm", 12.3, "12 N s/m"),
        ("scrub_ratio", 0.0094, "0.0094"),
        ("accel_bias_mps2", 0.046, "0.046 m/s²"),
        ("wheel_radius_ratio", np.nan, NOT_KNOWN),
    ],
)
def test_quantities_have_two_digits_and_a_readable_unit(parameter, value, text):
    assert quantity(parameter, value).replace("\xa0", " ").replace("\N{MINUS SIGN}", "-") == text


def test_limits_of_what_is_always_there_say_off_by():
    text = limit_text(Limit("effective_track_ratio", 0.048, "ratio", "turns"), False)
    assert text.replace("\xa0", " ") == "An effective track off by under 4.8 % would not have been detected."


def test_json_holds_null_where_nothing_is_known():
    result = a_result(a_gain(filter=Comparison("vio12", "no camera", 2, {})), not_excited=LIMITS[1:])
    shown = json.loads(json.dumps(as_json(result), allow_nan=False))
    assert [limit["detection_limit"] for limit in shown["detection_limits"]] == [0.003, None, 0.05]
    assert shown["not_excited"] == shown["detection_limits"][1:]
    assert shown["gain"]["channels"]["speed_x_mps"]["white_after"] is None
    assert (shown["gain"]["measured"], shown["gain"]["ci"]) == (True, [0.4, 0.6])
    assert set(shown["gain"]["filter"]) == {"name", "reason", "n_runs", "errors"}
    assert as_json(a_result())["gain"] == {"measured": False, "reason": "nothing was built in"}


def test_an_effect_that_differs_from_run_to_run_is_given_with_its_groups_and_rivals():
    groups = RunGroup(0.0, 0.01, ("a", "b")), RunGroup(0.3, 0.01, tuple("cdefgh"))
    each = Varying("payload", "payload_ratio", "ratio", ("scrub",), 0.1, 0.14, 9.0, groups, "current_a")
    result = a_result(verdict=Verdict.VARIES, varying=(each,))
    text = text_of(page_of(result)).replace("\xa0", " ")
    assert "The size of payload differs from run to run." in text
    assert "10 % on average, with a standard deviation of 14 %." in text
    assert "Two groups: 0 % in 2 runs (a, b), and 30 % in 6 runs (c, d, e, f, g, ...)." in text
    assert "These runs do not distinguish that from scrub." in text


def test_the_next_drive_is_a_command_and_terrains_that_differ_are_named():
    result = a_result(next_drive=NextDrive("climb", 6.0, "it parts them"))
    assert next_command(result.diagnosis, "my robot.yaml", load_robot("husky"), ()) == (
        "terrain simulate --robot 'my robot.yaml' --terrain grass --scenario climb --grade 6 --runs 8 "
        "--out next_drive"
    )
    apart = {"ice": Slope(0.4, 0.01), "snow": Slope(0.5, 0.01)}
    text = text_of(page_of(replace(result, next_command="terrain simulate", terrains_apart=apart)))
    assert "In simulation first: terrain simulate" in text
    assert "measured over simulated is 0.40 on ice and 0.50 on snow." in text
    assert "Explain each by itself with --terrain ice or --terrain snow." in text
