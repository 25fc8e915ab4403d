"""What is kept over a restart: biases and terrain while they are fresh, nothing else, and nothing damaged."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.state import (
    BELIEF_FRESH_S,
    BIASES_FRESH_S,
    Bias,
    LiveState,
    from_text,
    load_state,
    restorable,
    save_state,
    to_text,
)
from pipelines.live.terrain_source import KnownTerrain
from terrain.control.pilot_settings import PilotSettings
from terrain.control.slip_table import load_slip_table
from terrain.errors import DataError
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")
BIASED = ROBOT.with_parts(sensors=replace(ROBOT.sensors, gyro_bias_z_radps=0.02))
STATE = LiveState("agrimaro", "vio15", 1e9, {"gyro_bias_radps": Bias(0.01, 1e-3)}, "grass", 0.9, 0.1)


@pytest.fixture(scope="module")
def log():
    """Of a robot whose gyro has a bias that its description does not know."""
    return simulate_run(BIASED, "grass", "complex", 3, duration_s=60.0)


def driven(pilot, log, from_s=0.0, to_s=math.inf):
    for sample in replay(log):
        if from_s <= sample.time_s < to_s:
            pilot.step(sample)
    return pilot


def bias_of(pilot):
    return pilot.state(0.0).biases["gyro_bias_radps"]


def test_a_pilot_that_is_restored_knows_the_biases_and_the_terrain_at_once(log):
    before = driven(LivePilot(ROBOT, source=KnownTerrain()), log, to_s=40.0)
    state = from_text(to_text(before.state(1000.0)))
    assert (state.robot, state.filter, state.terrain) == ("agrimaro", "vio15", "grass")
    assert state.biases["gyro_bias_radps"].mean == pytest.approx(0.02, abs=0.003)
    after, anew = LivePilot(ROBOT), LivePilot(ROBOT)
    fresh = after.restore(state, 1002.0)
    assert fresh.belief.terrain == "grass"
    assert bias_of(after).mean == bias_of(before).mean
    first = next(sample for sample in replay(log) if sample.time_s >= 40.0)
    code = after.step(first).status["terrain_code"]
    assert after.terrains[int(code)] == "grass"
    assert anew.step(first).status["terrain_code"] == -1.0
    driven(after, log, 40.1, 41.0), driven(anew, log, 40.1, 41.0)
    assert abs(bias_of(after).mean - 0.02) < 0.004
    assert bias_of(after).std < bias_of(anew).std
    yaw_of = [pilot.estimate.mean[2] for pilot in (after, anew)]
    assert np.isfinite(yaw_of).all()


def test_a_bias_is_believed_less_with_time_and_never_less_than_without_it():
    stds = []
    for age_s in (0.0, 100.0, 500.0):
        pilot = LivePilot(ROBOT)
        pilot.restore(STATE, STATE.saved_s + age_s)
        stds.append(bias_of(pilot).std)
    assert stds[0] == 1e-3
    assert stds == sorted(stds)
    assert stds[2] > 2e-3
    vague = replace(STATE, biases={"gyro_bias_radps": Bias(0.5, 10.0)})
    pilot = LivePilot(ROBOT)
    pilot.restore(vague, STATE.saved_s)
    assert bias_of(pilot) == bias_of(LivePilot(ROBOT))


@pytest.mark.parametrize(
    ("age_s", "biases", "belief"),
    [
        (0.0, True, True),
        (-0.5, True, True),
        (BELIEF_FRESH_S + 0.1, True, False),
        (BIASES_FRESH_S + 0.1, False, False),
        (-10.0, False, False),
        (math.nan, False, False),
        (math.inf, False, False),
    ],
)
def test_only_what_is_fresh_is_used(age_s, biases, belief):
    found = restorable(STATE, "agrimaro", "vio15", STATE.saved_s + age_s)
    assert bool(found.biases) is biases
    assert (found.belief.terrain == "grass") is belief
    assert math.isfinite(found.target_ratio) is belief


def test_a_state_of_another_robot_or_filter_gives_nothing_of_its_own():
    other = restorable(STATE, "husky", "skid", STATE.saved_s)
    assert (dict(other.biases), other.belief.terrain) == ({}, "")
    same_robot = restorable(STATE, "agrimaro", "slip14", STATE.saved_s)
    assert (dict(same_robot.biases), same_robot.belief.terrain) == ({}, "grass")


def test_a_clock_of_stamps_that_starts_anew_does_not_silence_a_restored_belief(log):
    """The belief was of stamps near 40 s; the robot's stamps start at 0 again."""
    state = driven(LivePilot(ROBOT, source=KnownTerrain()), log, to_s=40.0).state(1000.0)
    pilot = LivePilot(ROBOT, load_slip_table(), KnownTerrain(lambda _: "tiles"))
    pilot.restore(state, 1000.5)
    code = [pilot.step(sample).status for sample in replay(log) if sample.time_s < 5.0][-1]["terrain_code"]
    assert pilot.terrains[int(code)] == "tiles"


def test_open_loop_pilots_have_a_state_without_biases():
    state = LivePilot(ROBOT, settings=PilotSettings(controller="plain")).state(5.0)
    assert (state.biases, state.filter) == ({}, "")
    LivePilot(ROBOT, settings=PilotSettings(controller="plain")).restore(STATE, STATE.saved_s)


finite = st.floats(-1e6, 1e6)


@given(
    saved_s=finite,
    bias=st.tuples(finite, st.floats(1e-9, 1e3)),
    terrain=st.text(max_size=20),
    probability=st.one_of(st.just(math.nan), st.floats(0, 1)),
)
def test_a_state_is_read_as_it_was_written(saved_s, bias, terrain, probability):
    state = LiveState("r", "f", saved_s, {"gyro_bias_radps": Bias(*bias)}, terrain, probability, math.nan)
    assert to_text(from_text(to_text(state))) == to_text(state)
    assert from_text(to_text(state)).biases == state.biases


def test_a_state_with_one_wrong_letter_anywhere_is_refused_or_read_as_it_was():
    text = to_text(STATE)
    n_refused = 0
    for k, letter in enumerate(text):
        damaged = text[:k] + chr((ord(letter) + 1) % 128) + text[k + 1 :]
        try:
            assert to_text(from_text(damaged)) == text  # a blank between words
        except DataError:
            n_refused += 1
    assert n_refused > 0.8 * len(text)


@pytest.mark.parametrize(
    "text", ["", "[]", "null", "[" * 100_000, '{"version": 2, "sha256": "", "state": {}}', "\x00", "1" * 5000]
)
def test_what_is_no_state_is_refused_in_one_sentence(text):
    with pytest.raises(DataError) as refused:
        from_text(text)
    assert "\n" not in str(refused.value)


def test_a_checksum_that_fits_does_not_make_nonsense_a_state():
    text = to_text(STATE)
    with pytest.raises(DataError, match="should be greater than 0"):
        from_text(text.replace("0.001", "-0.001"))


def test_a_file_is_written_whole_read_back_and_refused_with_its_name(tmp_path):
    path = tmp_path / "robot.json"
    assert load_state(path) is None
    save_state(path, STATE)
    assert load_state(path) == STATE
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"robot\.json"):
        load_state(path)
    path.write_bytes(b" " * 100_000)
    with pytest.raises(DataError, match="larger than"):
        load_state(path)
    with pytest.raises(DataError, match="cannot be opened"):
        load_state(tmp_path)


def test_an_observer_keeps_its_belief(mower_model):
    observer = Observer(mower_model)
    observer.restore(replace(STATE, robot="", filter=""), STATE.saved_s)
    assert observer.belief.terrain == "grass"
    assert observer.state(7.0).terrain == "grass"
