"""The page of a diagnosis says what the answer says, whatever the answer is."""

import re
from html import unescape

import numpy as np
import pytest

from pipelines.explain.page import RunPicture, explain_page, limit_words, quantity, verdict_words
from pipelines.reporting.drawing import NOT_KNOWN
from terrain.discrepancy.verdict import (
    Cause,
    Clock,
    Diagnosis,
    Excluded,
    Leftover,
    Limit,
    NextDrive,
    Residual,
    RuledOut,
    Value,
)

LIMITS = (
    Limit("steering_offset_1_rad", 0.003, "rad", "several speeds"),
    Limit("payload_ratio", np.inf, "ratio", "slopes"),
    Limit("clock_rate_ratio", 0.05, "ratio", "switching"),
)


def a_diagnosis(**more):
    empty = {
        "robot": "a<b>",
        "verdict": "none",
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


def a_gain(refused=False, **more):
    channel = {
        "rms_before": 0.02,
        "rms_after": 0.01,
        "white_before": 2.0,
        "white_after": None,
        "reduction": 0.75,
        "ci": [-0.1 if refused else 0.7, 0.8],
        "refused": refused,
    }
    found = {"reduction": 0.5, "ci": [-0.2 if refused else 0.4, 0.6], "refused": refused}
    return {
        "measured": True,
        "runs": ["r1", "r2"],
        "excluded_runs": [],
        "clusters": "thirds of runs",
        "channels": {"speed_x_mps": channel},
        "filter": None,
        **found,
        **more,
    }


def a_result(gain=None, **more):
    told = {
        "data": "field & co",
        "data_digest": "0123456789abcdef",
        "description": "husky.yaml",
        "model": None,
        "built_in": {},
        "terrain": None,
        "effects": ["payload"],
        "seed": 4,
        "used": ["r3"],
        "held_out": ["r1", "r2"],
        "gain": gain or {"measured": False, "reason": "nothing was built in"},
        "extended": None,
        "page": "explain.html",
    }
    return a_diagnosis(**more).as_json() | told


def text_of(page):
    text = unescape(re.sub(r"<[^>]+>", " ", page.partition("<body>")[2]))
    return " ".join(text.replace("\N{MINUS SIGN}", "-").split())


def page_of(result, runs=()):
    return explain_page(result, {"stretch": ("<svg/>", b"png")}, runs)


def test_a_cause_stands_with_value_interval_gain_and_what_no_log_tells_it_from():
    result = a_result(a_gain(), verdict="explained", causes=(a_cause(),))
    text = text_of(page_of(result))
    assert "The simulation lacks lever arm (0.1 m, -50 mm)." in text.replace("\xa0", " ")
    assert "lever_x_m 0.1 m 0.09 to 0.11 40 % 30 % to 50 % speed to the left, speed ahead 9" in text
    assert "no log tells it from: an alias" in text
    assert "On 2 runs that had no say in it, what was built in takes 50 % of the squared residual" in text
    assert "Values are over what the description has already" in text


def test_pictures_come_before_tables_and_nothing_is_fetched():
    runs = [RunPicture("first", "pictures/a.png", b"png"), RunPicture("2 > 1", 'pictures/"b".png', None)]
    page = page_of(a_result(a_gain(), causes=(a_cause(),)), runs)
    assert 0 < page.index("<img") < page.index("<table")
    assert re.findall(r'(?:src|href)="(?!data:)([^"]*)', page) == ["pictures/&quot;b&quot;.png"]
    assert "<script" not in page
    assert "<summary>first</summary>" in page
    assert ">2 &gt; 1</a>" in page
    assert "a&lt;b&gt;" in page
    assert "<b>gets" not in page


def test_a_gain_that_is_refused_is_not_claimed():
    text = text_of(page_of(a_result(a_gain(refused=True), causes=(a_cause(),))))
    assert "no gain can be claimed" in text
    assert "no gain to claim" in text
    worse = a_gain(refused=True)
    worse["channels"]["speed_x_mps"]["ci"] = [-0.5, -0.1]
    assert "worse than before" in text_of(page_of(a_result(worse, causes=(a_cause(),))))
    bare = text_of(page_of(a_result()))
    assert "A gain on untouched runs was not measured: nothing was built in." in bare


def test_errors_of_filter_and_classifier_are_shown_where_there_are_any():
    errors = {"speed_mps": {"before": 0.1, "after": 0.05, "change_ci": [-0.06, -0.04]}}
    accuracy = {"accuracy": {"before": 0.8, "after": 0.9, "change_ci": None}}
    gain = a_gain(
        filter={"name": "vio12", "reason": None, "errors": errors},
        classifier={"name": "svm", "reason": None, "errors": accuracy},
    )
    text = text_of(page_of(a_result(gain, causes=(a_cause(),))))
    assert "Error of the filter vio12" in text
    assert "speed, root mean square m/s 0.1 0.05 -0.06 to -0.04" in text
    assert f"accuracy 0.8 0.9 {NOT_KNOWN}" in text
    gain = a_gain(filter={"name": "vio12", "reason": "no camera", "errors": {}})
    assert "Not measured: no camera" in text_of(page_of(a_result(gain, causes=(a_cause(),))))


def test_a_set_that_is_not_told_apart_says_what_would_part_it_and_what_to_drive():
    values = {
        name: (Value(f"{name}_ratio", 0.2, "ratio", 0.1, 0.3),) for name in ("payload", "motor_constant")
    }
    result = a_result(
        verdict="ambiguous",
        ambiguous_sets=(("payload", "motor_constant"),),
        ambiguous_values=values,
        next_drive=NextDrive("climb", 6.0, "it parts them"),
    )
    text = text_of(page_of(result)).replace("\xa0", " ")
    assert "One of payload or motor constant is there, and these runs do not tell which." in text
    assert (
        "payload 20 % (10 % to 30 %) accelerations and slopes; speed ahead parts it from motor constant"
        in text
    )
    assert "scenario climb, grade deg 6.0 It parts them." in text


def test_what_has_no_name_what_was_not_excited_and_what_does_not_belong():
    result = a_result(
        verdict="unexplained",
        unexplained=(
            Leftover("current_a", "wheel 1 turn", 12.34, 0.2),
            Leftover("speed_x_mps", "time", np.inf, 0),
        ),
        not_excited=LIMITS[1:],
        excluded_runs=(Excluded("r<9>", "its gyro stands still"),),
        clocks=(Clock("r3", 0.0123, 0.001), Clock("r4", np.nan, np.inf)),
    )
    page = page_of(result)
    text = text_of(page).replace("\xa0", " ")
    assert "Something without a name shows in sum of the currents and speed ahead." in text
    assert "Of 3 numbers that may be wrong, 2 could not have been seen." in text
    assert "sum of the currents wheel 1 turn 12.3 20 %" in text
    assert "A payload of any size would not have been seen." in text
    assert "A clock rate of any size that is likely (up to 2 %) would not have been seen." in text
    assert "A steering offset 1 under 3 mrad would not have been seen." in text
    assert "r<9> its gyro stands still" in text
    assert f"r3 12.3 ms 1 ms r4 {NOT_KNOWN} {NOT_KNOWN}" in text
    assert "scrub the runs show nothing of it 0.4" in text


def test_nothing_found_says_so():
    assert verdict_words(a_result()) == "These runs show nothing that the simulation lacks."


@pytest.mark.parametrize(
    ("parameter", "value", "said"),
    [
        ("gyro_bias_radps", -0.00314, "-3.1 mrad/s"),
        ("camera_latency_s", 0.25, "0.25 s"),
        ("viscous_drag_nspm", 12.3, "12 N s/m"),
        ("scrub_ratio", 0.0094, "0.0094"),
        ("accel_bias_mps2", 0.046, "0.046 m/s²"),
        ("wheel_radius_ratio", np.nan, NOT_KNOWN),
    ],
)
def test_quantities_are_said_as_people_say_them(parameter, value, said):
    assert quantity(parameter, value).replace("\xa0", " ").replace("\N{MINUS SIGN}", "-") == said


def test_limits_of_what_is_always_there_say_off_by():
    words = limit_words({"name": "effective_track_ratio", "detection_limit": 0.048}, False)
    assert words.replace("\xa0", " ") == "An effective track off by under 4.8 % would not have been seen."
