"""Slip measured from outside, of runs whose slip is known, and the steady targets that are learned from it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from pipelines.slip.estimate import estimate_runs
from pipelines.slip.learn_slip import learn_slip_table
from pipelines.slip.measured import SHORT_STRIDE_S
from terrain.control.learned_table import BRAKES, FEW_RUNS, NO_PEAK, SPINS
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import rolling_matrix
from terrain.logs.run_folders import write_run
from terrain.records import Label, RunLog, Stream, TargetStatus
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.slip_learning.ground_changes import MAX_DELAY_S
from terrain.slip_learning.measured import BODY_CHANNELS, measured_slip

ROBOTINO = load_robot("robotino")
LENGTH_S = 9.0
SLIP = {"cork": 0.1, "moss": 0.4}
CURRENT = {"cork": 0.4, "moss": 0.8}


def omni_run(rng, run_id, terrain, direction, slip, current_a, session="", noise=(0.0, 0.0)):
    """Return a run at 0.1 m/s in one direction, by its slip and currents, seen by a camera above."""
    time_s = np.arange(0.0, LENGTH_S, 0.031)
    twist = 0.1 * np.array([np.cos(direction), np.sin(direction), 0.0])
    wheels = twist @ rolling_matrix(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad).T
    flat = np.zeros((time_s.size, 3))
    travelled = np.cumsum(0.1 * (1 - np.asarray(slip)) * np.ones(time_s.size)) * 0.031
    pose = np.outer(travelled, 10 * twist) + rng.normal(0.0, 0.0005, flat.shape)
    current = flat + np.reshape(current_a, (-1, 1)) + rng.normal(0.0, noise[0], flat.shape)
    rates = flat + ROBOTINO.logged_rates(wheels) + rng.normal(0.0, noise[1], flat.shape)
    channels = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
    commanded = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    streams = {
        "wheels": Stream(time_s, np.hstack([rates, current]), channels),
        "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
        "commands": Stream(time_s, np.tile(twist, (time_s.size, 1)), commanded),
    }
    labels = (Label(0.0, LENGTH_S, terrain),) if terrain else ()
    return with_wheel_speeds(RunLog(run_id, "robotino", streams, labels, session=session), ROBOTINO)


@pytest.fixture(scope="module")
def one_ground():
    rng = np.random.default_rng(0)
    return [
        omni_run(rng, f"{name}_{i:02d}", name, i * 0.6, SLIP[name], CURRENT[name], noise=(0.05, 0.5))
        for name in SLIP
        for i in range(10)
    ]


@pytest.fixture(scope="module")
def two_grounds():
    """Runs without a label, half on each of two grounds."""
    rng, first = np.random.default_rng(1), np.arange(0.0, 9.0, 0.031) < 4.5
    slip, current = (np.where(first, both["cork"], both["moss"]) for both in (SLIP, CURRENT))
    return [omni_run(rng, f"both_{i}", "", i, slip, current, "border", (0.05, 0.5)) for i in range(6)]


def measured_slips(runs, **options):
    return estimate_runs(runs, filter="pose", **({"delay_s": 0.0} | options)).result


def test_slip_by_surface_and_its_prediction(one_ground, two_grounds):
    result = measured_slips([*one_ground, *two_grounds], predict=True)
    found = {row.terrain: row for row in result.surfaces}
    assert list(found) == ["cork", "moss", ""]
    for name, slip in SLIP.items():
        assert found[name].slip_ratio == pytest.approx(slip, abs=0.01)
        assert found[name].held_out < 0.01
    by_name = {row.held_out: row for row in result.predictions}
    assert set(by_name) == {"runs", "regimes", "border"}
    assert by_name["runs"].rms < 0.02
    assert by_name["runs"].coverage > 0.9
    assert by_name["border"].n_runs == 6
    assert set(result.pictures) == {"slip_by_surface", "slip_by_run", "slip_by_motion"}
    assert result.report.answer.startswith(
        "Within one session: what another day does is not shown. robotino slips by 0.1"
    )


def test_changes_are_found_and_judged(one_ground, two_grounds):
    from pipelines.learn.ground_changes import find_changes

    result = find_changes(two_grounds, one_ground)
    assert result.n_steps == 6
    assert result.found_ratio == 1.0
    assert -0.25 <= result.delay_median_s < 2.0
    assert all(-0.25 <= run.delay_s <= MAX_DELAY_S for run in result.runs)
    # currents that change long before the slip, or after it: the change is not found, and an early alarm is false
    rng, time_s = np.random.default_rng(2), np.arange(0.0, LENGTH_S, 0.031)
    for slip_s, current_s in ((6.0, 2.5), (2.5, 6.5)):
        slip, current = (
            np.where(time_s < at_s, both["cork"], both["moss"])
            for both, at_s in ((SLIP, slip_s), (CURRENT, current_s))
        )
        run = omni_run(rng, "apart", "", 0.5, slip, current, "border", (0.05, 0.5))
        apart = find_changes([run], one_ground)
        assert (apart.n_steps, apart.found_ratio) == (1, 0.0)
        assert apart.runs[0].changes
        assert (apart.n_early >= 1) == (current_s < slip_s)
    low, high = result.false_alarm_interval
    assert low <= result.false_alarm_ratio <= high
    sessions = [replace(run, session=f"session {i % 2}") for i, run in enumerate(one_ground)]
    assert find_changes([run], sessions).false_alarm_interval[1] > 2 * high  # of two units, not of 20
    quiet = find_changes(one_ground[:5], one_ground[5:])
    assert (quiet.n_steps, quiet.n_without_step, np.isnan(quiet.found_ratio)) == (0, 5, True)
    with pytest.raises(DataError, match="is watched and calibrated on"):
        find_changes(one_ground[:5], one_ground)


def test_what_cannot_be_measured_is_refused_in_one_sentence(one_ground):
    blind = [replace(run, streams={"wheels": run.streams["wheels"]}) for run in one_ground[:2]]
    other = replace(one_ground[0], robot="husky", run_id="other")
    for runs, options, error, sentence in (
        (blind, {}, DataError, r"none of 2 runs has a slip; the first for this: run cork_00: nothing"),
        ([one_ground[0], other], {}, DataError, "of the robots husky, robotino"),
        (one_ground, {"predict": True, "hold_out": ("loaded",)}, DataError, "there is no session 'loaded'"),
        ([other], {"rollers": True}, ConfigError, "drive 'skid_steer' has no rollers"),
    ):
        with pytest.raises(error, match=sentence):
            measured_slips(runs, **options)


def test_the_stream_has_the_slip_of_the_body_and_what_it_turns_also_where_a_lidar_misses_scans():
    """A skid-steer robot whose slip ahead, drift aside and loss of turning are known."""
    robot, time_s = load_robot("husky"), np.arange(0.0, 12.0, 0.05)
    rolled = np.column_stack([np.full(time_s.size, 0.8), np.full(time_s.size, 0.4)])  # right and left wheels
    ahead_mps, turn_radps = 0.6, 0.4 / robot.track_m
    twist = np.tile([0.9 * ahead_mps, 0.06, 0.5 * turn_radps], (time_s.size, 1))
    twist[time_s % 0.5 > 0.24] = np.nan
    streams = {
        "wheels": Stream(time_s, rolled, ("speed_right_mps", "speed_left_mps")),
        "lidar": Stream(time_s, twist, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")),
    }
    over = {"window_s": 0.5, "stride_s": 0.1, "whole": True}
    slip = measured_slip(RunLog("a", "husky", streams), robot, **over).stream
    known = np.isfinite(slip.values).all(axis=1)
    assert known.mean() > 0.5
    found = slip.columns(BODY_CHANNELS)[known]
    np.testing.assert_allclose(found, np.tile([0.1, 0.1, 0.5], (len(found), 1)), atol=1e-6)
    streams["wheels"] = Stream(time_s, np.tile([0.6, 0.59], (time_s.size, 1)), streams["wheels"].channels)
    straight = measured_slip(RunLog("a", "husky", streams), robot, **over).stream
    assert np.isfinite(straight.columns(BODY_CHANNELS[:2])).mean() > 0.5
    assert np.isnan(
        straight.columns(BODY_CHANNELS[2:])
    ).all()  # wheels that do not turn the robot lose no turning


def test_the_command_writes_result_runs_and_pictures(terrain, place, one_ground):
    for run in one_ground[::2]:
        write_run(run, place / "one")
    words = ("estimate", "--filter", "pose", "--data", "one", "--out", "out", "--figures", "figures")
    code, out, err = terrain(*words, "--json", "slip.json")
    assert code == 0, err
    assert "moss" in out
    document = json.loads((place / "slip.json").read_text(encoding="utf-8"))
    assert document["surfaces"][1]["slip_ratio"] == pytest.approx(0.4, abs=0.01)
    assert document["figures"][0].endswith("slip_by_surface.png")
    (run, *_), wheels = load_runs(place / "out"), ("slip_1_ratio", "slip_2_ratio", "slip_3_ratio")
    slip, log = run.streams["slip"], run.streams["wheels"]
    assert (slip.channels, run.filter) == ((*wheels, *BODY_CHANNELS), "pose")
    assert np.nanmedian(np.abs(slip.columns(wheels))) == pytest.approx(0.1, abs=0.03)
    # it covers the run, so that no window is lost to it
    assert slip.time_s[0] == pytest.approx(log.time_s[0])
    assert log.time_s[-1] - slip.time_s[-1] < SHORT_STRIDE_S
    assert "is there already" in terrain(*words)[2]


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(0)
    slips = rng.normal(0.3, 0.02, 12)
    moss = [
        omni_run(rng, f"moss_{name}_{i}", "moss", 0.3 * i, slip, 0.6, name)
        for name, each in {"monday": slips, "friday": slips + 0.1}.items()
        for i, slip in enumerate(each)
    ]
    return moss + [omni_run(rng, f"cork_{i}", "cork", 0.3 * i, 0.1, 0.6) for i in range(2)]


@pytest.fixture(scope="module")
def learned(runs):
    return learn_slip_table(runs, ROBOTINO)


def test_steady_slip_and_thrust_are_learned_and_what_was_not_driven_stays_assumed(tmp_path, learned):
    table = load_slip_table(learned.save(tmp_path / "table.yaml"), robot="robotino")
    moss, cork = table.targets["moss"], table.targets["cork"]
    assert moss["steady"].status is TargetStatus.ESTIMATED
    assert moss["steady"].slip_ratio == pytest.approx(0.35, abs=0.02)
    low, high = 0.3, 0.4  # of the two sessions: a new one's deviation is sqrt(1.5) times theirs
    assert moss["steady"].slip_std == pytest.approx((high - low) / 2**0.5 * 1.5**0.5, abs=0.01)
    assert (moss["steady"].n_sessions, moss["steady"].n_runs) == (2, 24)
    assert moss["traction"].status is TargetStatus.UNESTIMATED
    assert moss["traction"].slip_ratio >= moss["steady"].slip_ratio + 0.03
    assert {target.status for target in cork.values()} == {TargetStatus.UNESTIMATED}
    assert [learned.surfaces[name]["reason"] for name in ("moss", "cork")] == [NO_PEAK, FEW_RUNS]
    motors = ROBOTINO.motors
    torque = 0.6 * motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    expected = (torque - motors.friction_nm) / ROBOTINO.wheel_radius_m / (ROBOTINO.mass_kg * 9.80665 / 3)
    found = learned.surfaces["moss"]
    assert found["current_a"][0] == pytest.approx(0.6)
    assert found["thrust_ratio"][0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("slips", "reason", "steady"),
    [
        ((0.93, 0.95, 0.96), SPINS, None),
        ((-0.004, -0.001, 0.003), NO_PEAK, 0.0),
        ((-0.09, -0.1, -0.11), BRAKES, None),
    ],
)
def test_a_slip_that_is_no_operating_point_is_not_learned_and_one_about_0_is_0(slips, reason, steady):
    rng = np.random.default_rng(1)
    runs = [omni_run(rng, f"ice_{i}", "ice", 0.3 * i, slip, 0.6) for i, slip in enumerate(slips)]
    found = learn_slip_table(runs, ROBOTINO).surfaces["ice"]
    assert found["reason"] == reason
    if steady is not None:
        assert found["targets"]["steady"]["slip_ratio"] == steady
    assert (found["targets"]["steady"]["status"] == "estimated") == (steady is not None)


def test_what_a_session_costs_another_is_the_difference_that_was_hidden(runs, learned):
    transfers = learned.transfers
    assert [(each.learned, each.driven) for each in transfers] == [("friday", "monday"), ("monday", "friday")]
    low, high = transfers[1].interval
    assert low < 0.1 < high
    assert high - low < 0.1
    assert low < transfers[1].difference < high
    assert transfers[1].difference == -transfers[0].difference
    assert (transfers[1].n_learned, transfers[1].n_driven) == (12, 12)
    # a session of few runs has a difference without an interval
    for each in learn_slip_table(runs[:14], ROBOTINO).transfers:  # two of the second session
        assert abs(each.difference) > 0.05
        assert np.isnan(each.interval).all()


def without_currents(run):
    wheels = run.streams["wheels"]
    names = [name for name in wheels.channels if not name.startswith("current")]
    bare = Stream(wheels.time_s, wheels.columns(names), names)
    return replace(run, streams={**run.streams, "wheels": bare})


@pytest.mark.parametrize(("soil", "least"), [("dry_sand", 0.1), ("clay", 0.01)])
def test_slip_of_a_simulated_skid_steer_robot_is_that_of_its_truth(soil, least):
    husky = load_robot("husky")
    driven = [simulate_run(husky, soil, "straight", 3, i, duration_s=12.0) for i in range(3)]
    truths = [run.streams["truth"] for run in driven]
    late = [truth.channel("slip_left_ratio")[truth.time_s > 6.0] for truth in truths]
    truth, bare = float(np.median(np.concatenate(late))), map(without_currents, driven)
    for each, height in ((driven, "thrust of a wheel over its load"), (bare, "surface")):
        table = learn_slip_table(each, husky)
        (row,) = table.surfaces.values()
        assert truth > least
        assert row["slip"].slip_ratio == pytest.approx(truth, abs=3 * row["slip"].std)
        assert row["slip"].std < 0.02
        assert table.targets[soil]["steady"].slip_ratio == pytest.approx(row["slip"].slip_ratio, abs=1e-4)
        assert table.pictures["operating_points"].panels[0].y_label == height
        assert np.isfinite(row["current_a"][0]) == (height != "surface")


def test_runs_that_are_not_used_are_named_and_runs_that_show_no_slip_refused(runs):
    streams = dict(runs[0].streams)
    halves = (Label(0.0, 4.0, "moss"), Label(4.0, 8.0, "cork"))
    others = [RunLog("bare", "robotino", streams), RunLog("both", "robotino", streams, halves)]
    result = learn_slip_table([*runs, *others], ROBOTINO)
    assert result.skipped == ("run bare: has no label", "run both: is on 2 terrains: moss, cork")
    assert result.n_runs == len(runs)
    blind = replace(runs[0], run_id="a", streams={"wheels": runs[0].streams["wheels"]})
    for given, robot, sentence in (
        ([blind], ROBOTINO, "none of 1 runs has a slip; the first for this: run a: nothing"),
        ([replace(runs[0], labels=())], ROBOTINO, "none of 1 runs has a label"),
        (runs, load_robot("husky"), "of the robot 'robotino': a table is learned for one, 'husky'"),
    ):
        with pytest.raises(DataError, match=sentence):
            learn_slip_table(given, robot)


@pytest.mark.slow
def test_measured_runs_reach_what_is_stated(measured):
    """Bounds are those of the task, not today's figures: a wrong sign or scale misses them by far."""
    runs = load_runs(measured("robotino") / "one_surface")
    result = measured_slips(runs, delay_s=None, predict=True)
    slips = {row.terrain: row.slip_ratio for row in result.surfaces}
    assert slips["table"] < slips["brown"] < slips["gray"] < slips["green"]
    for row in result.predictions:
        assert row.rms < 0.05
        assert 0.9 <= row.coverage <= 0.98
    learned = learn_slip_table(runs, ROBOTINO).surfaces
    slips = {name: row["slip"].slip_ratio for name, row in learned.items()}
    assert slips == pytest.approx({"table": 0.10, "brown": 0.14, "gray": 0.29, "green": 0.50}, abs=0.03)
