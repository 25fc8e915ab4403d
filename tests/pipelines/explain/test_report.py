"""The report of a diagnosis says what the answer says, whatever the answer is."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipelines.explain.explanation import ExplainResult
from pipelines.explain.figures import (
    dependence_figure,
    parts_figure,
    run_figure,
    spectra_figure,
    strongest_figure,
)
from pipelines.explain.sentences import limit_text, terrain_notes
from pipelines.report import NOT_KNOWN, quantity
from pipelines.report.json_file import as_json
from pipelines.report.terminal import terminal_text
from terrain.discrepancy.compared import ComparedRun, channels_of, example_stretch
from terrain.discrepancy.diagnosed_runs import DiagnosedRuns, HeldOutGain
from terrain.discrepancy.filter_gain import Change, Comparison
from terrain.discrepancy.gain import ChannelGain, Gain, Reduction
from terrain.discrepancy.health.runs import Clock, Excluded
from terrain.discrepancy.nameless import Learned, Nameless
from terrain.discrepancy.next_drive import next_command
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.parts import Part, PartValues
from terrain.discrepancy.response_slopes import Slope
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.statements import Statement
from terrain.discrepancy.terrain_match import TerrainMatch
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
from terrain.effects import CHANNELS
from terrain.robots import load_robot

HUSKY = load_robot("husky")
RATE_HZ = 6.25
C = CHANNELS.index("speed_x_mps")
LIMITS = (
    Limit("steering_offset_1_rad", 0.003, "rad", "several speeds"),
    Limit("payload_ratio", np.inf, "ratio", "slopes"),
    Limit("clock_rate_ratio", 0.05, "ratio", "switching"),
)


def a_noise(std=0.01):
    """White noise of that size at any speed, in two channels."""
    growth = np.full((len(CHANNELS), 3), np.nan)
    filters = np.full((len(CHANNELS), 7), np.nan)
    for c in (0, C):
        growth[c] = std**2, 0.0, 0.0
        filters[c] = 1.0, *np.zeros(6)
    return Noise(growth, filters, np.full(len(CHANNELS), std))


def a_run(name="r", off=0.0, seed=0, n=300, held_out=False, after=True):
    rng = np.random.default_rng(seed)
    measured = np.full((n, len(CHANNELS)), np.nan)
    measured[:, [0, C]] = 0.01 * rng.standard_normal((n, 2))
    measured[:, C] += off
    before = np.zeros_like(measured)
    fixed = before.copy()
    fixed[:, C] = off
    time_s = np.arange(n) / RATE_HZ
    inputs = {"speed_mps": np.sin(time_s), "roll_rad": np.zeros(n), "time_s": time_s}
    return ComparedRun(
        name, "grass", held_out, time_s, np.ones(n), measured, before, fixed if after else None, inputs
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


def a_result(gain=None, runs=(), statements=(), robot=HUSKY, **more):
    diagnosed = DiagnosedRuns(
        diagnosis=a_diagnosis(**more),
        simulation=Simulation(HUSKY),
        extended=None,
        terrains=(),
        fit=(),
        used=(),
        held_out=(),
        compared=tuple(runs),
        held_signals=(),
        noise=a_noise(),
        low_pass=None,
        parts=(),
        acting={},
    )
    return ExplainResult(
        data="field & co",
        data_digest="0123456789abcdef",
        description="husky.yaml",
        terrain=None,
        effects=("payload",),
        seed=4,
        robot=robot,
        diagnosed=diagnosed,
        gain=gain or HeldOutGain(None, "nothing was built in"),
        extended=None,
        statements=tuple(statements),
        terms={},
        next_command=None,
        terrains_apart={},
        powertrain=None,
    )


def text_of(result):
    text = terminal_text(result.report, details=True, width=400)
    return " ".join(text.replace("\N{MINUS SIGN}", "-").replace("\xa0", " ").split())


def test_the_answer_is_the_cause_with_its_interval_and_the_gain():
    result = a_result(a_gain(), verdict=Verdict.EXPLAINED, causes=(a_cause(),))
    answer = result.report.answer.replace("\xa0", " ").replace("\N{MINUS SIGN}", "-")
    assert answer == (
        "The simulation of a<b> lacks lever arm, 0.1 m (90 mm to 0.11 m) and -50 mm (-60 mm to -40 mm). On 2 "
        "held-out runs the extension removes 50.0 % (40.0 to 60.0 %) of the whitened squared residual."
    )
    text = text_of(result)
    assert "lever arm 0.1 m 90 mm to 0.11 m 40.0 % 9.0" in text
    assert "No log distinguishes lever arm from an alias." in text
    assert "Values are added to what the description has already" in text
    assert "commanded" not in text  # no run logs commands


def test_what_is_stated_and_faulty_comes_before_the_causes_and_the_rest_is_folded():
    slope, nan = Slope(1.0, 0.1), float("nan")
    stated = [
        Statement("speed_x_mps", slope, (), 0.1, nan, "", f"speed ahead: it is {i}", i < 5) for i in range(7)
    ]
    report = a_result(statements=stated, excluded_runs=(Excluded("r9", "its gyro stands still"),)).report
    shown = " ".join(str(part) for part in report.parts)
    assert [f"it is {i}" in shown for i in range(4)] == [True, True, True, False]
    assert "Runs that were excluded as unfit: r9." in shown
    assert "its gyro stands still" not in shown
    assert report.details[0].title == "Channel by channel"


def test_a_gain_that_is_refused_is_not_claimed():
    text = text_of(a_result(a_gain(refused=True), causes=(a_cause(),)))
    assert "no gain can be claimed" in text
    assert "no gain to claim" in text
    assert " worse " in text_of(a_result(a_gain(refused=True, high=-0.05), causes=(a_cause(),)))
    learned = Nameless(2, {"speed_x_mps": Learned(0.02, 0.01, 0.76, 0.75, -0.02)}, 0.76, 0.75)
    text = text_of(a_result(replace(a_gain(), nameless=learned), causes=(a_cause(),)))
    assert "speed ahead m/s 0.02 0.01 75.0 % 70.0 to 80.0 % 76.0 %" in text
    assert "a black-box reference 76 %: little is left to find." in text
    assert "The gain on held-out runs was not measured: nothing was built in." in text_of(a_result())


def test_errors_of_filter_and_classifier_are_shown_where_there_are_any():
    errors = {"speed_mps": Change(0.1, 0.05, (-0.06, -0.04))}
    accuracy = {"accuracy": Change(0.8, 0.9, None)}
    gain = a_gain(
        filter=Comparison("vio12", None, 2, errors), classifier=Comparison("svm", None, 2, accuracy, ("a",))
    )
    text = text_of(a_result(gain, causes=(a_cause(),)))
    assert "Error of the filter vio12" in text
    assert "speed, root mean square m/s 0.1 0.05 -0.06 to -0.04" in text
    assert f"accuracy 0.8 0.9 {NOT_KNOWN}" in text
    gain = a_gain(filter=Comparison("vio12", "no camera", 2, {}))
    assert "not measured: no camera" in text_of(a_result(gain, causes=(a_cause(),)))


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
    text = text_of(result)
    assert "One of payload or motor constant is present, and these runs cannot distinguish them." in text
    assert (
        "payload 20 % (10 % to 30 %) accelerations and slopes; speed ahead distinguishes it from motor "
        "constant" in text
    )
    assert "Scenario climb, on a slope of 6°: it parts them." in text
    assert next_command(result.diagnosis, "my robot.yaml", HUSKY, ()) == (
        "terrain simulate --robot 'my robot.yaml' --terrain grass --scenario climb --grade 6 --runs 8 "
        "--out next_drive"
    )


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
    text = text_of(result)
    assert (
        "The residual is systematic, without a known cause, in sum of the currents and speed ahead." in text
    )
    assert "Of 3 parameters that may be wrong, 2 could not have been detected." in text
    assert "sum of the currents depends on wheel 1 turn 12.3 20.0 %" in text
    assert "A payload of any size would not have been detected." in text
    assert "A clock rate of any size that is likely (up to 2 %) would not have been detected." in text
    assert "A steering offset 1 under 3 mrad would not have been detected." in text
    assert "r<9> its gyro stands still" in text
    assert f"r3 12.3 1.0 r4 {NOT_KNOWN}" in text
    assert "scrub The runs show nothing of it. 0.4" in text
    assert a_result().report.answer.startswith("These runs show nothing that the simulation of a<b> lacks.")


def test_an_effect_that_differs_from_run_to_run_is_given_with_its_groups_and_rivals():
    groups = RunGroup(0.0, 0.01, ("a", "b")), RunGroup(0.3, 0.01, tuple("cdefgh"))
    each = Varying("payload", "payload_ratio", "ratio", ("scrub",), 0.1, 0.14, 9.0, groups, "current_a")
    text = text_of(a_result(verdict=Verdict.VARIES, varying=(each,)))
    assert "The size of payload differs from run to run." in text
    assert "10 % on average, with a standard deviation of 14 %." in text
    assert "Two groups: 0 % in 2 runs (a, b), and 30 % in 6 runs (c, d, e, f, g, ...)." in text
    assert "These runs do not distinguish that from scrub." in text


def test_terrains_that_differ_or_are_bumpy_are_named():
    apart = {"ice": Slope(0.4, 0.01), "snow": Slope(0.5, 0.01)}
    first, second = terrain_notes([TerrainMatch("gravel", "gravel", 0.25)], apart)
    assert "25 % of the measured tilt" in first
    assert "measured over simulated is 0.40 on ice and 0.50 on snow." in second
    assert "Explain each by itself with --terrain ice or --terrain snow." in second
    assert terrain_notes([TerrainMatch("grass", "grass", 1.0)], {}) == ()


def test_robots_on_tracks_have_sprockets():
    cause = a_cause()._replace(
        name="wheel_radius", aliases=(), values=(Value("wheel_radius_ratio", 0.1, "ratio", 0.09, 0.11),)
    )
    text = text_of(a_result(causes=(cause,), robot=load_robot("marmotte")))
    assert "lacks sprocket radius, 10 %" in text
    assert "wheel" not in text.partition("Where these numbers")[0]


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


def test_the_example_stretch_is_of_a_run_with_larger_residuals_than_most():
    runs = [a_run(f"r{i}", off=0.02 * i, seed=i) for i in (3, 0, 2, 4, 1)]
    found = example_stretch(runs, a_noise())
    assert found.run_id == "r3"
    assert 19.0 < found.time_s[-1] - found.time_s[0] <= 20.0
    assert len(example_stretch([a_run(n=50)], a_noise()).time_s) == 50


def test_figures_show_the_residual_before_and_after_with_the_noise_about_the_measurement():
    runs = [a_run(f"r{i}", off=0.5, seed=i) for i in range(3)]
    noise, channels = a_noise(), channels_of(runs)
    band, measured, before, after = run_figure(runs[0], noise, ["speed_x_mps"]).panels[0].marks
    assert np.allclose(band.high - measured.y, 2 * 0.01)
    assert np.median(np.abs(before.y - measured.y)) > 0.4
    assert np.median(np.abs(after.y - measured.y)) < 0.02
    for figure in (strongest_figure(runs, channels), dependence_figure(runs, noise, "speed_x_mps")):
        first, second = figure.panels[-1].marks
        assert np.nanmean(first.y) == pytest.approx(0.5, abs=0.01)
        assert np.nanmean(second.y) == pytest.approx(0.0, abs=0.01)
    levels = {
        mark.label: np.median(mark.y) for mark in spectra_figure(runs, noise, 2.5, channels).panels[1].marks
    }
    assert levels["noise"] == pytest.approx(levels["with the causes built in"], abs=3.0)
    values = PartValues(
        Value("lever_x_m", 0.1, "m", 0.05, 0.15),
        (Part("first third", 0.1, 0.1), Part("rest", np.nan, np.nan)),
    )
    band, points = parts_figure([values]).panels[0].marks
    assert (band.low[0], band.high[0]) == (0.05, 0.15)
    assert points.low[0] == pytest.approx(0.0)
