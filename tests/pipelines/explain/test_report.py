"""The report of a diagnosis says what the answer says, whatever the answer is."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.explain.explanation import five_questions
from pipelines.explain.figures import dependence_figures, parts_figure, run_figure, spectra_figure
from pipelines.report.numbers import NOT_KNOWN
from pipelines.report.terminal import terminal_text
from terrain.discrepancy import verdict
from terrain.discrepancy.diagnosed_runs import HeldOutGain
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.held_out import Change, Comparison
from terrain.discrepancy.learner import LearnedGain
from terrain.discrepancy.patterns import Kind
from terrain.discrepancy.runs import Excluded, measured_channels
from terrain.discrepancy.verdict import Clock
from terrain.learned_term import LearnedTerm
from terrain.robots import load_robot

HUSKY = load_robot("husky")
LIMITS = (
    verdict.Limit("steering_offset_1_rad", 0.003, "rad", "several speeds"),
    verdict.Limit("payload_ratio", np.inf, "ratio", "slopes"),
    verdict.Limit("clock_rate_ratio", 0.05, "ratio", "switching"),
    verdict.Limit("effective_track_ratio", 0.048, "ratio", "turns"),
)
LEVER_ARM = verdict.Cause(
    "lever_arm",
    ("an_alias",),
    (verdict.Value("lever_x_m", 0.1, "m", 0.09, 0.11), verdict.Value("lever_y_m", -0.05, "m", -0.06, -0.04)),
    *(0.4, (0.3, 0.5), ("speed_y_mps", "speed_x_mps"), 9.04, 4.0),
)


def a_gain(refused=False, **comparisons):
    """Return a gain on two runs, and the verdict of its only channel."""
    ends = (-0.2 if refused else 0.4, 0.6), refused
    gain = Gain("2 runs held out", ("r1", "r2"), (), "thirds of runs", {}, 0.5, *ends, 0.76, (0.7, 0.8))
    return HeldOutGain(gain, None, {"filter": None, **comparisons})


AHEAD = verdict.ChannelVerdict(
    *("speed_x_mps", verdict.Tier.NAMED, ("lever_arm",), 0.02, 0.01),
    *(0.75, (0.7, 0.8), False, 0.009, 0.76, (0.7, 0.8), (-0.02, 0.02)),
)


@pytest.fixture
def explained(few):
    """Return what makes a result without any finding but those that are given."""

    def make(gain=None, robot=HUSKY, **findings):
        empty = {
            "robot": "a<b>",
            "causes": (),
            "channels": (),
            "unexplained": (),
            "candidates": (),
            "detection_limits": LIMITS,
            "not_shown": (),
            "next_drive": None,
        }
        empty["ruled_out"] = (verdict.RuledOut("scrub", "the runs show nothing of it", 0.44),)
        nothing = a_gain().gain._replace(reduction=np.nan, ci=(np.nan, np.nan), refused=True)
        gain = gain or HeldOutGain(nothing)
        diagnosis = replace(few.diagnosis, **(empty | findings))
        diagnosed = replace(few.diagnosed, diagnosis=diagnosis, whole_gain=gain.gain)
        return replace(few, diagnosed=diagnosed, gain=gain, statements=(), robot=robot)

    return make


def text_of(result):
    text = terminal_text(result.report, details=True, width=400)
    return " ".join(text.replace("\N{MINUS SIGN}", "-").replace("\xa0", " ").split())


def test_the_first_screen_answers_what_why_how_certain_what_for_and_what_next(explained):
    result = explained(a_gain(), causes=(LEVER_ARM,), channels=(AHEAD,))
    answer = result.report.answer.replace("\xa0", " ").replace("\N{MINUS SIGN}", "-")
    assert answer == (
        "The simulated speed ahead is off by 0.02 m/s rms: with the measured point 0.45 m ahead and 0.05 m right of "
        "the centre (described: 0.35 m, assumed) the rms error of its speed ahead falls from 0.02 to 0.01 m/s, judged "
        "on 2 runs held out."
    )
    text = text_of(result)
    for stated in (
        "What is wrong The simulated speed ahead is off by 0.02 m/s rms",
        "Why The measured point 0.45 m ahead and 0.05 m right of the centre",
        "How certain Confirmed on runs left out of the fit, with 95 % intervals: lever arm 0.45 m (0.44 to 0.46) and "
        "-50 mm (-60 to -40 mm)",
        "What it gains Against the simulation as it is, on 2 runs held out: over all channels named causes remove 50 % "
        "(40 to 60 %); a black-box learner would remove 76 % (70 to 80 %)",
        "What next Simulate and estimate with extended.yaml in place of the robot's file",
        "lever arm (lever x) 0.45 m (0.44 to 0.46) 40.0 % 9.0",
        "No log distinguishes lever arm from an alias.",
    ):
        assert stated in text
    nothing = explained().report
    assert nothing.answer == "These runs show nothing that the simulation of a<b> gets wrong."
    blind = explained(not_shown=LIMITS[1:2]).report
    assert blind.answer.startswith(
        "These runs confirm nothing that the simulation of a<b> gets wrong, and could not"
    )
    assert "What next Nothing is open that a drive of this robot would show" in text_of(explained())


def test_a_channel_that_nothing_explains_leads_where_nothing_is_explained(explained):
    open_ = AHEAD._replace(tier=verdict.Tier.UNEXPLAINED, causes=(), gain=np.nan, rms_after=np.nan)
    result = explained(channels=(open_,), candidates=(LEVER_ARM._replace(tier=verdict.Tier.CANDIDATE),))
    assert "no cause could be named for it; a learner without names removes 76" in result.report.answer
    assert "not built in: lever arm" in text_of(result)
    two = explained(a_gain(), channels=(open_._replace(channel="current_a"), AHEAD), causes=(LEVER_ARM,))
    assert two.report.answer.startswith("The simulated speed ahead")
    assert "No known cause for sum of the motor currents" in text_of(two)


def test_what_was_learned_is_no_reason_where_it_is_no_better_on_runs_held_out(explained):
    values = np.array([-0.1]), np.array([[1e-4]]), {"speed_mps": (0.0, 1.0)}
    term = LearnedTerm("speed_x_mps", ("speed_mps",), *values, says="speed lost")
    for reduction, is_better in ((0.7, True), (0.5, False)):
        result = explained(a_gain(), channels=(AHEAD,))
        gains = (LearnedGain("speed_x_mps", term.says, 0.5, reduction, (-0.1, 0.3), 0.8),)
        with_terms = replace(result.diagnosed.with_terms, learned=(term,))
        diagnosed = replace(result.diagnosed, with_terms=with_terms, learned_gains=gains)
        why, how_certain = (row[1] for row in five_questions(replace(result, diagnosed=diagnosed)).rows[1:3])
        assert ("learned: speed lost" in why) == is_better
        assert ("what was learned of speed ahead" in how_certain) != is_better


FILTER = Comparison("vio12", None, 2, {"speed_mps": Change(0.1, 0.05, (-0.06, -0.04))})
CLASSIFIER = Comparison("svm", None, 2, {"accuracy": Change(0.8, 0.9, None)}, ("a",))
RIVALS = {
    name: (verdict.Value(f"{name}_ratio", 0.2, "ratio", 0.1, 0.3),) for name in ("payload", "motor_constant")
}
OF_SET = LEVER_ARM._replace(
    name="payload", aliases=(), parameters=RIVALS["payload"], tier=verdict.Tier.SET, channels=("current_a",)
)
GROUPS = verdict.RunGroup(0.0, 0.01, ("a", "b")), verdict.RunGroup(0.3, 0.01, tuple("cdefgh"))
ON_TERRAINS = GROUPS[0]._replace(name="sand"), GROUPS[1]._replace(name="grass")
PAYLOAD = verdict.Varying(
    *("payload", "payload_ratio", "ratio", ("scrub",), 0.1, 0.14, 9.0, GROUPS, "current_a"),
    *(Kind.GROUPS, 0.3, (0.26, 0.34)),
)
LEFT = (
    verdict.Unexplained("current_a", "wheel 1 turn", 12.34, 0.2),
    verdict.Unexplained("speed_x_mps", "time", np.inf, 0),
)


@pytest.mark.parametrize(
    ("findings", "stated"),
    [
        (
            {"gain": a_gain(refused=True)},
            ("over all channels named causes remove 50 % (-20 to 60 %), which may be nothing",),
        ),
        (
            {"gain": replace(a_gain(), built_in_before=a_gain().gain)},
            ("What the description has already: Judged on 2 runs held out, the extension removes 50 %",),
        ),
        (
            {"gain": a_gain(filter=FILTER, classifier=CLASSIFIER), "channels": (AHEAD,)},
            (
                "speed ahead m/s named lever arm 0.02 0.01 75.0 % 70.0 to 80.0 % 76.0 % 70.0 to 80.0 %",
                "speed, root mean square m/s 0.1 0.05 -0.06 to -0.04",
                f"accuracy 0.8 0.9 {NOT_KNOWN}",
            ),
        ),
        (
            {"gain": a_gain(filter=Comparison("vio12", "no camera", 2, {}))},
            ("vio12 is not measured: no camera",),
        ),
        (
            {"ambiguous_sets": (tuple(RIVALS),), "ambiguous_values": RIVALS, "of_sets": (OF_SET,)},
            (
                "Why One of payload or motor constant (built in as",
                "20 % (10 to 30 %) accelerations and slopes; speed ahead distinguishes it from motor constant",
            ),
        ),
        (
            {"not_shown": LIMITS[1:3], "unexplained": LEFT, "varying": (PAYLOAD,)},
            (
                "depends on wheel 1 turn 12.3 20.0 %",
                "hese drives cannot test 2 of 4 parameters, which may be wrong all the same",
                "A payload of any size would not have been detected.",
                "A clock rate of any size that is likely (up to 2 %) would not have been detected.",
                "An effective track off by under 4.8 % would not have been detected.",
                "scrub The runs show nothing of it. 0.4",
                "The payload differs between two groups of runs by 30 % (26 to 34 %): 50.0 kg in 2 runs (a, b) and "
                "65.0 kg in 6 runs (c, d, e, f, g, ...). It may as well be scrub that differs",
            ),
        ),
        (
            {"varying": (PAYLOAD._replace(pattern=Kind.TERRAINS, groups=ON_TERRAINS),)},
            (
                "The payload differs between terrains by 30 % (26 to 34 %): 50.0 kg on sand (2) and 65.0 kg "
                "on grass (6).",
            ),
        ),
        (
            {
                "clocks": (Clock("r3", 0.0123, 0.001), Clock("r4", np.nan, np.inf)),
                "excluded_runs": (Excluded("r<9>", "its gyro stands still"),),
                "next_drive": verdict.NextDrive(((0.5, 0, 0, 2, 1),), 6.0, "it parts them", 62, 9.6, 4),
            },
            (
                f"r3 0.0123 0.0010 r4 {NOT_KNOWN}",
                "excluded as unfit: r<9>.",
                "r<9> its gyro stands still",
                "Drive next_drive.csv (62 s of speeds and yaw rates, facing up a slope of 6°, on a field "
                "of 10 by 4 m): it parts them",
            ),
        ),
    ],
)
def test_what_was_found_is_stated_with_its_numbers(explained, findings, stated):
    text = text_of(explained(**findings))
    assert [each for each in stated if each not in text] == []


def test_robots_on_tracks_have_sprockets(explained):
    value = verdict.Value("wheel_radius_ratio", 0.1, "ratio", 0.09, 0.11)
    cause = LEVER_ARM._replace(name="wheel_radius", aliases=(), parameters=(value,))
    of = AHEAD._replace(causes=("wheel_radius",))
    text = text_of(explained(causes=(cause,), channels=(of,), robot=load_robot("marmotte")))
    assert "sprocket radius 0.13" in text
    assert "wheel" not in text.partition("Where these numbers")[0]


def test_figures_show_the_residual_before_and_after_with_the_band_about_the_extended_robot(few):
    """The hidden camera yaw shows in the sideways speed, and is gone with the cause built in."""
    runs, noise, name = few.diagnosed.compared, few.diagnosed.noise, "speed_y_mps"
    band, measured, before, after = run_figure(runs[0], few.diagnosed.deviation, [name]).panels[0].marks
    half = (np.asarray(band.high) - np.asarray(band.low)) / 2
    errors = [np.nanstd(np.asarray(each.y) - np.asarray(measured.y)) for each in (before, after)]
    assert errors[1] < np.nanmean(half) < errors[0]
    np.testing.assert_allclose(np.asarray(band.high) + np.asarray(band.low), 2.0 * np.asarray(after.y))
    strongest, every = dependence_figures(runs, noise)
    place = measured_channels(runs).index(name)
    for panel in (strongest.panels[place], every[place].panels[0]):
        first, second = panel.marks
        assert np.nanstd(second.y) < 0.5 * np.nanstd(first.y)
    spectra = spectra_figure(runs, noise, 2.5)
    levels = {each.label: np.median(each.y) for each in spectra.panels[place].marks}
    assert levels["noise"] == pytest.approx(levels["extended"], abs=5.0)
    band, points = parts_figure(few.diagnosed.parts).panels[0].marks
    (value,) = few.diagnosis.causes[0].parameters
    assert (band.low[0], band.high[0]) == (value.low, value.high)
    assert points.low[0] < value.value < points.high[0]
