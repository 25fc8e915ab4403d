"""The catalogue of effects is consistent, and each shows where it says."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import terrain
from terrain.effects import (
    BOTH,
    CHANNELS,
    CURRENT,
    INDEX,
    LIBRARY,
    NUISANCES,
    PARAMETER,
    PARAMETERS,
    SWERVE,
    TILT_OFFSETS,
    Stage,
    effect_named,
    library_of,
    read_effects_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.kinematics.wheels import rolling_matrix
from terrain.robots import TrackedRobot, load_robot
from terrain.simulation.plants.planar import Ground, make_planar, replay, spread_numbers

HUSKY = load_robot("husky")
ROBOTS = {
    "skid_steer": HUSKY,
    "tracked": TrackedRobot("crawler", 0.165, 0.5708, 0.512, 50.0, parts=HUSKY.parts),
    "swerve": load_robot("agrimaro"),
    "omni": load_robot("robotino"),
    "mecanum": load_robot("omnirobot"),
    "bicycle": load_robot("adap2e"),
    "tricycle": load_robot("pallet_truck"),
}
#: About what sensors of these robots show of nothing, and what differs on a robot of 12 kg.
NOISE = dict(zip(CHANNELS, (0.01, 0.005, 0.005, 0.1, 1.0, 1.0, 0.02), strict=True))
SMALL_ROBOT = {"omni": {CURRENT: 0.15}, "mecanum": {CURRENT: 0.15}}

LEFT_OUT = {
    "omni": (
        *(
            "gyro_bias",
            "gyro_scale",
            "gyro_nonlinearity",
            "accel_bias",
            "imu_latency",
            "clock_offset",
            "clock_rate",
        ),
        *("wheel_dead_zone", "encoder_lag", "motor_constant", "motor_drift", "current_offset"),
    ),
    "bicycle": ("payload", "rolling_resistance", "viscous_drag", "slip_resistance", "current_offset"),
}
LEFT_OUT |= {"mecanum": LEFT_OUT["omni"], "tricycle": LEFT_OUT["bicycle"]}
"""Effects that act and are not looked for: on omni robots those of an IMU, which these logs do not have, and
of lags, currents and a dead zone that the friction of the rollers hides; on cars, whose currents are not logged, a
load, which looks like softer tyres, and resistances, which look like a smaller radius."""

#: Response over noise, over that of the clearest channel, from which on one may be named and has to be.
NOTICEABLE, CLEAR = 0.1, 0.2
#: Rollers of omni wheels that resist: without them it does not matter where the load is.
GROUND = Ground(roller_ratio=0.2)
DT = 0.02


def rich_drive(drive):
    """Return wheel speeds, steering, grade and roll of a drive that shows every effect."""
    t = DT * np.arange(1500)
    speed, turn = 0.5 * np.sin(0.9 * t) + 0.35 * np.sin(0.31 * t), 0.5 * np.sin(0.53 * t + 1.0)
    grade, roll = 0.08 * np.sin(0.23 * t), 0.06 * np.cos(0.29 * t)
    if ROBOTS[drive].skids:
        half = 0.5 * ROBOTS[drive].track_m * turn
        return np.column_stack([speed - half, speed + half]), np.zeros((t.size, 2)), grade, roll
    if drive in ("bicycle", "tricycle"):
        steer = np.column_stack([0.25 * np.sin(0.7 * t + 0.4), np.zeros(t.size)])
        return 3.0 * speed[:, None], steer, grade, roll
    if drive in ("omni", "mecanum"):
        robot, twist = ROBOTS[drive], np.column_stack([speed, 0.4 * np.cos(0.7 * t), turn])
        place = robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad
        wheels = twist @ rolling_matrix(*place).T
        return np.ascontiguousarray(wheels), np.zeros((t.size, len(robot.wheels))), grade, roll
    steer = np.column_stack([0.5 * np.sin(0.7 * t), -0.4 * np.sin(0.6 * t), 0.2 * np.sin(0.8 * t)])
    return np.column_stack([speed, 0.9 * speed, 1.1 * speed]), steer, grade, roll


@pytest.fixture(scope="module")
def responses():
    """By drive and effect, the response of each channel over its noise and over the clearest one's."""
    found = {}
    for drive, robot in ROBOTS.items():
        own = NOISE | SMALL_ROBOT.get(drive, {})
        noise = np.array([own[channel] for channel in CHANNELS])
        planar, inputs = make_planar(robot, GROUND), rich_drive(drive)
        neutral = replay(planar, vector_of({}), DT, *inputs)
        for effect in LIBRARY:
            power = np.zeros(len(CHANNELS))
            carriers = effect_named(effect.modifies).parameters if effect.modifies else ()
            carrier = {p.name: 0.5 * p.high for p in carriers}
            without = replay(planar, vector_of(carrier), DT, *inputs) if carrier else neutral
            for p in effect.parameters:
                shown = replay(planar, vector_of(carrier | {p.name: p.step}), DT, *inputs)
                power += (((shown - without) / noise)[50:-50] ** 2).mean(axis=0)
            found[drive, effect.name] = np.sqrt(power)
    return found


def test_names_are_unique_and_entries_are_whole():
    names = [(name, effect) for effect in LIBRARY for name in (effect.name, *effect.aliases)]
    parameters = [p.name for effect in LIBRARY for p in effect.parameters]
    assert len(dict(names)) == len(names)
    assert all(effect_named(name) is effect for name, effect in names)
    vector = vector_of({"payload_ratio": 0.5})
    assert vector.sum() == vector[INDEX["payload_ratio"]] == 0.5
    for values in ({"payload": 0.5}, {"payload_ratio": float("inf")}):
        with pytest.raises(ConfigError, match="a finite number of a known parameter"):
            vector_of(values)
    assert read_effects_of(["encoder_scale=0.02"], "swerve") == {"wheel_radius_ratio": 0.02}
    assert read_effects_of(["steering_play=0.01"], "swerve") == {"steering_backlash_rad": 0.01}
    assert len(set(parameters)) == len(parameters)
    assert set(PARAMETERS) == {*parameters, *NUISANCES}
    assert [INDEX[name] for name in PARAMETERS] == list(range(len(PARAMETERS)))
    ranks = [p.scatter_rank for p in (*PARAMETER.values(), *TILT_OFFSETS) if p.scatter_rank]
    assert sorted(ranks) == list(range(1, len(NUISANCES) + 1))
    assert set(NUISANCES) == set(spread_numbers("scatter"))
    for effect in LIBRARY:
        assert set(effect.drives) <= set(ROBOTS)
        assert set(effect.channels) <= set(CHANNELS)
        assert effect.needs
        assert effect.source
        assert (effect.stage is None) == (SWERVE not in effect.drives)
        robot = ROBOTS["swerve" if SWERVE in effect.drives else effect.drives[0]]
        for p in effect.parameters:
            assert p.low <= p.plausible[0] <= 0.0 < p.plausible[1] <= p.high
            assert p.plausible_source
            assert 0.0 < p.step < 0.1 * p.high
            assert p.unit in (
                "ratio",
                "rad",
                "s",
                "s2",
                "s2pm",
                "s2pm2",
                "m",
                "a",
                "mps",
                "radps",
                "mps2",
                "nspm",
            )
            assert p.homes or effect.stage is not Stage.DESCRIPTION
            for home in p.homes:  # a number of a description
                part = getattr(robot, home.section) if home.section else robot
                assert isinstance(getattr(part, home.field), float), p.name


ADDED = r'''
import terrain.files.names as names
from pathlib import Path
from tempfile import TemporaryDirectory

entry = """
gear_wear:
  source: a test
  parameters:
    gear_wear_ratio: {low: -0.1, high: 0.1, plausible: [0, 0.1], plausible_source: z, step: 0.001,
      one_sided: true, scatter_rank: 11, as_percent: true, is_error: true, deprecated: [worn_ratio],
      homes: {motors.efficiency_ratio: x (1 + e)}}
  drives: [swerve]
  channels: [current_a]
  needs: z
  sensed_only: true
  stage: description
  deprecated: [worn]
ticks:
  source: a test
  parameters:
    ticks_ratio: {low: -0.1, high: 0.1, step: 0.001,
      inverse: {streams: [wheels], columns: [motor_], combine: x (1 + e)}}
  drives: [swerve]
  channels: [speed_x_mps]
  needs: z
  sensed_only: true
  stage: sensors
  words: [sided, 100.0, "wheels that count {number} % too {side}", much, little]
"""
with TemporaryDirectory() as folder:
    library, own = names.data_folder("effects") / "library.yaml", names.data_folder
    Path(folder, "library.yaml").write_text(library.read_text() + entry)
    names.data_folder = lambda kind: Path(folder) if kind == "effects" else own(kind)
    import terrain.effects as effects

from dataclasses import replace
import numpy as np
from terrain.discrepancy.robot_terms import in_robot_terms, limit_text, quantity
from terrain.discrepancy import evidence, runs
from terrain.discrepancy.runs import Simulation
from terrain.discrepancy.verdict import Limit, Value
from terrain.extension import Correction, corrected
from terrain.robots import load_robot

robot, name = load_robot("agrimaro"), "gear_wear_ratio"
for table in (effects.BOUNDS, effects.STEPS, effects.NUISANCES, effects.SENSED_ONLY, effects.ONE_SIDED,
              effects.INDEX, runs.STEPS, runs.SENSED_ONLY, runs.ONE_SIDED,
              evidence.PRIOR_STD, effects.nuisances_of("swerve")):
    assert name in table
assert name not in effects.nuisances_of("skid_steer")
assert effects.read_effects_of(["worn=0.05"], "swerve") == {name: 0.05}
assert Simulation(robot, effects={name: 0.05}, scatter={name: 0.1}).library[-2].name == "gear_wear"
entry = {"value": 0.05, "unit": "ratio", "source": "test"}
assert effects.read_effects("here", {"schema": 1, "worn_ratio": entry}, "swerve")[0] == {name: 0.05}
extended = corrected(replace(robot, effects={name: 0.05}))
assert extended.motors.efficiency_ratio == robot.motors.efficiency_ratio * 1.05 and not extended.effects
assert name in effects.in_plant(effects.Stage.DESCRIPTION)
assert quantity(name, 0.05) == "5\N{NO-BREAK SPACE}%"
assert limit_text(Limit(name, 0.05, "ratio", "z"), False).startswith("A gear wear off by under 5")
ticking = replace(robot, effects={"ticks_ratio": 0.1})
samples = Correction(ticking)("wheels", ("motor_1_radps",), np.zeros(1), np.ones((1, 1)))[1]
assert samples.item() == 1.1 and not corrected(ticking).effects
value = Value("ticks_ratio", 0.1, "ratio", 0.09, 0.11)
assert in_robot_terms("ticks", [value], robot) == "wheels that count 10 % too much"
'''


def test_an_entry_of_the_catalogue_is_all_that_the_rest_of_the_project_needs_of_an_effect():
    """In a process of its own: the catalogue is read at import.  No kernel runs."""
    subprocess.run([sys.executable, "-c", ADDED], check=True, env=os.environ | {"NUMBA_DISABLE_JIT": "1"})


def test_no_other_module_lists_effects():
    """Three names in one literal are a list; the trials' causes that no library has are no effects.

    What logs identify of a robot may bear the names of effects (:data:`terrain.robots.IDENTIFIED`).
    """
    names = {*PARAMETER, *(name for effect in LIBRARY for name in (effect.name, *effect.aliases))}
    root = Path(terrain.__file__).parent.parent
    for path in sorted(
        p for room in ("terrain", "features", "pipelines") for p in (root / room).rglob("*.py")
    ):
        text = path.read_text(encoding="utf-8")
        if (
            path.name in ("effects.py", "robots.py")
            or len(names.intersection(re.findall(r"['\"](\w+)['\"]", text))) < 3
        ):
            continue
        for node in ast.walk(ast.parse(text)):
            parts = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", ())
            listed = {part.value for part in parts if isinstance(part, ast.Constant)} & names
            assert len(listed) < 3, f"{path.relative_to(root)}:{node.lineno} lists {sorted(listed)}"


def test_an_effect_changes_the_replay_of_the_robots_that_it_applies_to_and_of_no_others(responses):
    for (drive, name), response in responses.items():
        if effect_named(name) in library_of(drive):
            assert response.max() > 0.01, name  # over the noise, at a step that counts as small
        elif name not in LEFT_OUT.get(drive, ()):
            assert not response.any(), name


def test_an_effect_shows_in_the_channels_that_it_names_and_in_no_others(responses):
    """On omni wheels and cars, what acts on every robot shows most in one of them.

    There a resistance also turns the body, and drives it sideways.
    """
    for effect in LIBRARY:
        drives = [drive for drive in effect.drives if drive in BOTH]
        drives = drives or [drive for drive in effect.drives if drive not in ("mecanum", "tricycle")]
        share = np.max([responses[d, effect.name] / responses[d, effect.name].max() for d in drives], axis=0)
        clear, noticeable = (set(np.array(CHANNELS)[share > least]) for least in (CLEAR, NOTICEABLE))
        assert clear <= set(effect.channels) <= noticeable, effect.name
        for drive in {"omni", "bicycle"}.intersection(effect.drives):
            most = CHANNELS[int(np.argmax(responses[drive, effect.name]))]
            assert most in effect.channels, effect.name


def test_twins_are_mutual_and_differ_in_their_distinguishing_channel(responses):
    """One of the two shows in the channel that parts them, the other does not."""
    for effect in LIBRARY:
        for name, channel in effect.twins:
            twin = effect_named(name)
            assert (effect.name, channel) in twin.twins
            shared = set(effect.drives) & set(twin.drives) & set(BOTH)  # weight: no slip of omni wheels
            assert shared
            for drive in shared:
                c, both = CHANNELS.index(channel), (responses[drive, e.name] for e in (effect, twin))
                less, more = sorted(each[c] / each.max() for each in both)
                assert less < 1e-3 < NOTICEABLE < more


@pytest.mark.parametrize(
    ("text", "drive", "message"),
    [
        ("gravity=1", "swerve", "effect 'gravity' is unknown: use one of wheel_radius,"),
        ("steering_backlash=0.01", "skid_steer", "does not apply to a robot with the drive 'skid_steer'"),
        ("payload", "swerve", "payload=VALUE with payload_ratio is required"),
        ("payload=heavy", "swerve", "payload=VALUE with payload_ratio is required"),
        ("payload=0.1,0.2", "swerve", "payload=VALUE with payload_ratio is required"),
        ("lever_arm=0.1", "swerve", "lever_arm=VALUE with lever_x_m,lever_y_m is required"),
        ("payload=1.6", "swerve", "payload_ratio is 1.6, -0.5 to 1.5 is accepted"),
        ("payload=nan", "swerve", "payload_ratio is nan, -0.5 to 1.5 is accepted"),
        ("steering_backlash=-0.01", "swerve", "steering_backlash_rad is -0.01, 0 to 0.2 is accepted"),
    ],
)
def test_an_effect_that_cannot_be_is_refused_in_one_sentence(text, drive, message):
    with pytest.raises(ConfigError) as error:
        read_effects_of([text], drive)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
