"""What is hidden between commanded and measured wheel speeds comes back, and nothing else."""

import math
import re

import numpy as np
import pytest

from terrain.discrepancy.health.fault import Change, Column, Fault, FaultKind
from terrain.discrepancy.powertrain import ABSENT, NAMES, STEP_S, PartStatus, follow, powertrain_of
from terrain.logs.drive import DriveRobot, find_runs
from terrain.records import RunLog, Stream
from terrain.robots import load_robot

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
NOISE_RADPS = 0.05
FINE_S, PERIOD_S = 0.005, 0.05


def plain_response(commands, fine_n, start, values):
    """Speeds (runs, fine_n, wheels) by small steps, of commands (runs, m, wheels) held from 20 Hz."""
    p = dict(zip(NAMES, ABSENT, strict=True)) | values
    out = np.empty((len(commands), fine_n, commands.shape[2]))
    y = np.array(start, dtype=float)
    quick = -math.expm1(-FINE_S / p["time_constant_s"]) if p["time_constant_s"] else 1.0
    for k in range(fine_n):
        row = math.floor((k * FINE_S - p["delay_s"]) / PERIOD_S - 1e-9)  # a command acts after its stamp
        if row >= 0:
            x = commands[:, min(row, commands.shape[1] - 1)]
            if x.shape[1] == 2:
                common, half = p["gain_ratio"] * x.mean(axis=1), x[:, 1] - x[:, 0]
                common = np.clip(common, -p["common_limit_radps"], p["common_limit_radps"])
                half = 0.5 * p["difference_gain_ratio"] * half
                half = np.clip(half, -p["difference_limit_radps"], p["difference_limit_radps"])
                x = np.column_stack([common - half, common + half])
            else:
                x = p["gain_ratio"] * x
            size = np.abs(x)
            x = np.sign(x) * np.maximum(np.minimum(size, 2 * (size - p["deadband_radps"])), 0)
            x = np.clip(x, -p["wheel_limit_radps"], p["wheel_limit_radps"])
            y = y + np.clip(quick * (x - y), -p["slew_radps2"] * FINE_S, p["slew_radps2"] * FINE_S)
        out[:, k] = y
    return out


def run_of(i, robot, commands, rates):
    time_s, names = PERIOD_S * np.arange(len(commands)), [f"wheel_{wheel}_radps" for wheel in robot.wheels]
    speeds = robot.logged_rates(rates * robot.wheel_radius_m)
    wheels = Stream(time_s, speeds, robot.rate_channels)
    return RunLog(f"run_{i}", robot.name, {"wheels": wheels, "commands": Stream(time_s, commands, names)})


def commanded_runs(values, n=16, seed=0, robot=HUSKY, hold=1, sizes=6.0):
    """Runs of one step of the commands each, at 20 Hz; wheel speeds are new every ``hold`` samples."""
    rng = np.random.default_rng(seed)
    time_s, wheels = PERIOD_S * np.arange(120), robot.wheels
    before, after = rng.uniform(-sizes, sizes, (2, n, 1, len(wheels)))
    commands = np.where(time_s[:, None] < 1.0, before, after)
    n_fine = round(len(time_s) * PERIOD_S / FINE_S)
    start = plain_response(np.tile(before, (1, 200, 1)), n_fine, np.zeros((n, len(wheels))), values)[:, -1]
    rates = plain_response(commands, n_fine, start, values)[:, :: round(PERIOD_S / FINE_S)]
    rates = rates + NOISE_RADPS * rng.standard_normal(rates.shape)
    rates = rates[:, (np.arange(len(time_s)) // hold) * hold]
    return [run_of(i, robot, commands[i], rates[i]) for i in range(n)]


HIDDEN = {
    "nothing": ({}, {}),
    "delay": ({"delay_s": 0.23}, {}),
    "late, slow and limited": ({"delay_s": 0.12, "time_constant_s": 0.2, "slew_radps2": 8.0}, {}),
    "deadband": ({"deadband_radps": 0.9, "delay_s": 0.1}, {"sizes": 3.0, "n": 32}),
    "two gains": (
        {"gain_ratio": 1.6, "difference_gain_ratio": 0.8, "delay_s": 0.2, "common_limit_radps": 5.0},
        {"n": 20},
    ),
    "saturated": ({"wheel_limit_radps": 4.0, "time_constant_s": 0.15}, {}),
    "held long": ({"delay_s": 0.2, "slew_radps2": 6.0}, {"hold": 5, "n": 60}),
    "swerve": ({"delay_s": 0.15, "gain_ratio": 0.9}, {"robot": AGRIMARO}),
}
FAST = ("nothing", "late, slow and limited", "two gains")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case not in FAST)) for case in HIDDEN]
)
def test_what_is_hidden_comes_back_and_nothing_else_and_is_stated_in_sentences(case):
    hidden, options = HIDDEN[case]
    found = powertrain_of(commanded_runs(hidden, **options), options.get("robot", HUSKY))
    assert {part.name for part in found.found} == set(hidden)
    for part in found.found:
        room = 0.0 if part.name.endswith("_s") else 0.01 * part.value  # so much of limits is left to the grid
        assert part.low - room <= hidden[part.name] <= part.high + room, part
        coarse = part.name == "delay_s" and not {"time_constant_s", "slew_radps2"} & set(hidden)
        grid_s = PERIOD_S if coarse else STEP_S * (part.name == "delay_s")
        assert part.value == pytest.approx(hidden[part.name], rel=0.05, abs=grid_s)
        assert part.gain_ratio > 0.0
    assert found.rms_after_radps < 1.3 * NOISE_RADPS
    assert (found.rms_before_radps > 3 * found.rms_after_radps) == bool(hidden)
    assert found.hold_s == pytest.approx(0.05 * options.get("hold", 1))
    assert found.is_scaled == (case == "two gains")
    if not hidden:
        assert "as they are commanded" in found.sentences[0]
        assert found.reduction == (0.0, 0.0, 0.0)
        return
    ratio, low, high = found.reduction
    assert 0.0 < low <= ratio <= high < 1.0
    assert ratio == pytest.approx(1 - (found.rms_after_radps / found.rms_before_radps) ** 2)
    if case == "late, slow and limited":
        late, slow, _, gained = found.sentences
        assert re.fullmatch(r"The wheels answer 0\.\d+ s late \(0\.\d+ to 0\.\d+\)\.", late)
        assert slow.startswith("They settle with a time constant of 0.")
        assert (
            f"off by {found.rms_after_radps:.3g} rad/s rms instead of {found.rms_before_radps:.3g}" in gained
        )
        assert f"less by {ratio:.1%} ({low:.1%} to {high:.1%})" in gained


def test_the_kernel_is_the_equations():
    commands = np.random.default_rng(3).uniform(-6.0, 6.0, (6, 2)).repeat(20, axis=0)
    p = np.array([0.13, 0.2, 12.0, 0.8, 1.3, 0.7, 4.0, 2.0, 5.0])
    fine = round(PERIOD_S / FINE_S)
    area = np.vstack([np.zeros((1, 2)), np.cumsum(commands.repeat(fine, axis=0) * FINE_S, axis=0)])[:-1]
    start = np.array([0.5, -0.5])
    expected = plain_response(commands[None], len(area), start[None], dict(zip(NAMES, p, strict=True)))[0]
    np.testing.assert_allclose(follow(area, start, p, FINE_S), expected, atol=1e-9)
    every = round(STEP_S / FINE_S)
    coarse = follow(np.ascontiguousarray(area[::every]), start, p, STEP_S)
    assert np.abs(coarse - expected[::every]).max() < 0.15


def test_what_the_commands_do_not_show_is_not_excited():
    rng, runs = np.random.default_rng(0), []
    for i in range(20):  # both sides alike, and never a change
        commands = np.full((120, 2), rng.uniform(-6.0, 6.0))
        runs.append(run_of(i, HUSKY, commands, commands + NOISE_RADPS * rng.standard_normal((120, 2))))
    found = powertrain_of(runs, HUSKY)
    status = {part.name: part.status for part in found.parts}
    for name in ("delay_s", "time_constant_s", "slew_radps2", "difference_gain_ratio"):
        assert status[name] is PartStatus.NOT_EXCITED, name
    assert status["gain_ratio"] is PartStatus.NOT_NEEDED
    last = found.sentences[-1]
    assert last.startswith("The commands would not have shown a delay, a time constant, a slew limit")
    assert " or " in last


def test_an_answer_is_the_same_for_a_seed_without_what_is_no_command_or_a_wheel_speed_with_a_fault():
    runs = commanded_runs({"delay_s": 0.2}, n=8)
    bare = [RunLog(run.run_id, "husky", {"wheels": run.streams["wheels"]}) for run in runs]
    assert powertrain_of(bare, HUSKY) is None
    few = powertrain_of([*bare[:5], *runs[5:]], HUSKY)
    assert few.as_json()["measured"] is False
    assert few.sentences == (
        "The wheel speeds are not compared with their commands: runs: 3 have commanded and measured wheel "
        "speeds; at least 5 are required.",
    )
    km_per_h, turned = (
        Change(FaultKind.UNIT, Column.WHEELS, 1 / 3.6),
        Change(FaultKind.SIGN, Column.GYRO, -1.0),
    )
    ids = ("run_0", "run_1", "run_2")
    left, without = (
        powertrain_of(some, HUSKY, [Fault(change, ids, "", "") for change in changes], seed=5)
        for some, changes in ((runs[3:], [turned]), (runs, [km_per_h]))
    )
    assert repr(left) == repr(without)


@pytest.mark.slow
def test_the_commands_of_the_measured_husky_are_no_wheel_speeds(measured):
    """Its log: 1.8 times as fast forward, 0.8 times in turning, at most 6.1 rad/s (terrain.logs.drive)."""
    robot = DriveRobot("husky", HUSKY.wheel_radius_m)
    found = powertrain_of(
        [read(repair=True) for read in find_runs(measured("drive_husky"), robot)[::3]], HUSKY
    )
    values = {part.name: part for part in found.found}
    for name, value, room in (
        *(("gain_ratio", 1.8, 0.1), ("difference_gain_ratio", 0.8, 0.1)),
        ("wheel_limit_radps", 6.1, 0.15),
    ):
        assert values[name].value == pytest.approx(value, abs=room)
    assert values["delay_s"].low > 0.2
    assert any(text.startswith("The commands are no wheel speeds") for text in found.sentences)
    assert found.hold_s == pytest.approx(0.1)
    assert found.rms_after_radps < 0.2 * found.rms_before_radps
