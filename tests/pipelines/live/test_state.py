"""What is kept over a restart: biases and terrain while they are fresh, nothing else, and nothing damaged."""

import math
from dataclasses import replace

import pytest

from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from terrain.control.live_state import (
    BELIEF_FRESH_S,
    BIASES_FRESH_S,
    Bias,
    LiveState,
    from_text,
    load_state,
    to_text,
)
from terrain.control.robot_control import PilotSettings
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import KnownTerrain
from terrain.errors import DataError
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")
STATE = LiveState("agrimaro", "vio15", 1e9, {"gyro_bias_radps": Bias(0.01, 1e-3)}, "grass", 0.9, 0.1)


@pytest.fixture(scope="module")
def samples():
    """Of a robot whose gyro has a bias that its description does not know."""
    biased = ROBOT.with_parts(sensors=replace(ROBOT.sensors, gyro_bias_z_radps=0.02))
    return list(replay(simulate_run(biased, "grass", "complex", 3, duration_s=28.0)))


@pytest.fixture(scope="module")
def before(samples):
    """A pilot that has driven for 20 s."""
    return driven(LivePilot(ROBOT, source=KnownTerrain()), samples, to_s=20.0)


def driven(pilot, samples, from_s=0.0, to_s=math.inf):
    for sample in samples:
        if from_s <= sample.time_s < to_s:
            pilot.step(sample)
    return pilot


def bias_of(pilot):
    return pilot.state(0.0).biases["gyro_bias_radps"]


def test_a_pilot_that_is_restored_knows_the_biases_and_the_terrain_at_once(samples, before):
    state = from_text(to_text(before.state(1000.0)))
    assert (state.robot, state.filter, state.terrain) == ("agrimaro", "vio15", "grass")
    assert state.biases["gyro_bias_radps"].mean == pytest.approx(0.02, abs=0.003)
    after, anew = LivePilot(ROBOT), LivePilot(ROBOT)
    assert after.restore(state, 1002.0).terrain == "grass"
    assert bias_of(after).mean == bias_of(before).mean
    assert after.target_ratio == before.target_ratio
    first = next(sample for sample in samples if sample.time_s >= 20.0)
    assert after.step(first).status["terrain_code"] == list(load_slip_table().targets).index("grass")
    assert anew.step(first).status["terrain_code"] == -1.0
    driven(after, samples, 20.1, 21.0), driven(anew, samples, 20.1, 21.0)
    assert abs(bias_of(after).mean - 0.02) < 0.004
    assert bias_of(after).std < bias_of(anew).std
    with pytest.raises(DataError):
        after.restore(state, 1002.0)


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


AGRIMARO, OTHER = ("agrimaro", "vio15"), ("husky", "vio15")


@pytest.mark.parametrize(
    ("age_s", "whose", "biases", "belief"),
    [
        *((age_s, AGRIMARO, True, True) for age_s in (0.0, -0.5)),
        (BELIEF_FRESH_S + 0.1, AGRIMARO, True, False),
        *((age_s, AGRIMARO, False, False) for age_s in (BIASES_FRESH_S + 0.1, -10.0, math.nan, math.inf)),
        (0.0, OTHER, False, False),
        (0.0, ("agrimaro", "vio12"), False, True),
    ],
)
def test_only_what_is_fresh_is_used(age_s, whose, biases, belief):
    found = STATE.usable(*whose, STATE.saved_s + age_s)
    assert bool(found.biases) is biases
    assert (found.terrain == "grass") is belief
    assert math.isfinite(found.target_ratio) is belief


def test_a_clock_of_stamps_that_starts_anew_does_not_silence_a_restored_belief(samples, before):
    """The belief was of stamps near 20 s; the robot's stamps start at 0 again."""
    pilot = LivePilot(ROBOT, load_slip_table(), KnownTerrain(lambda _: "tiles"))
    pilot.restore(before.state(1000.0), 1000.5)
    assert driven(pilot, samples, to_s=5.0).belief.terrain == "tiles"


def test_open_loop_pilots_and_observers_have_a_state_without_biases(mower_model):
    plain = LivePilot(ROBOT, settings=PilotSettings(controller="plain"))
    assert (plain.state(5.0).biases, plain.state(5.0).filter) == ({}, "")
    plain.restore(STATE, STATE.saved_s)
    observer = Observer(mower_model)
    observer.restore(replace(STATE, robot="", filter=""), STATE.saved_s)
    assert observer.belief.terrain == observer.state(7.0).terrain == "grass"


def test_a_state_with_one_wrong_letter_anywhere_is_refused_or_read_as_it_was():
    text, n_refused = to_text(STATE), 0
    for k, letter in enumerate(text):
        damaged = text[:k] + chr((ord(letter) + 1) % 128) + text[k + 1 :]
        try:
            assert to_text(from_text(damaged)) == text  # a blank between words
        except DataError:
            n_refused += 1
    assert n_refused > 0.8 * len(text)


def test_a_file_is_read_back_or_refused_in_one_sentence_with_its_name(tmp_path):
    path = tmp_path / "robot.json"
    assert load_state(path) is None
    unknown = replace(STATE, robot="\u00e9\n", terrain="", probability=math.nan, target_ratio=math.nan)
    for state in (STATE, unknown):
        path.write_text(to_text(state))
        assert repr(load_state(path)) == repr(state)
    negative = to_text(STATE).replace("0.001", "-0.001")
    odd = ["", "[]", "null", "[" * 60_000, "\x00", "1" * 5000, "\udcff", " " * 100_000, negative]
    for damaged in (*odd, '{"version": 2, "sha256": "", "state": {}}'):
        path.write_bytes(damaged.encode(errors="surrogateescape"))
        with pytest.raises(DataError, match=r"^[^\n]*robot\.json: [^\n]*$"):
            load_state(path)
    with pytest.raises(DataError, match="should be greater than 0"):
        from_text(negative)
    with pytest.raises(DataError, match="is a folder"):
        load_state(tmp_path)
