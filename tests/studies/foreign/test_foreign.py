"""The foreign simulator obeys laws of mechanics, its sensors measure what they should, and effects show in logs."""

import doctest
import math
from importlib.util import find_spec

import numpy as np
import pytest

from studies import foreign
from studies.foreign import physics, scenes, scoring, sensors, trial, worlds
from studies.foreign.physics import EVERY, G_MPS2, SAMPLE_S, Body, Motion, integrate
from studies.foreign.scenes import Scene
from studies.foreign.sensors import Motor, Sensing
from studies.foreign.trial import Answer, ForeignTrial, Outcome, outcome_of
from studies.foreign.worlds import WORLDS, driven_by, effects_of, runs_of
from terrain.effects import LIBRARY, library_of
from terrain.errors import ConfigError
from terrain.robots import load_robot

SKID = WORLDS["plain", "skid"]().body


def moved(body: Body, circumferential_mps, slope=(0.0, 0.0), steer=0.0, yaw=0.0) -> Motion:
    """Drive one body by wheel speeds (n, wheels) every half step."""
    rate = np.asarray(circumferential_mps)[:, None] / body.radius_m
    angles = np.broadcast_to(np.asarray(steer, dtype=float), rate.shape)
    return integrate(body, rate, angles, np.array([slope]), np.ones(1), np.array([yaw]))


def ramp(to, seconds: float = 1.0):
    """Return wheel speeds that reach their values within 0.5 s."""
    time_s = np.arange(2 * EVERY * round(seconds / SAMPLE_S) + 1) * physics.STEP_S / 2
    return np.minimum(time_s / 0.5, 1.0)[:, None] * np.asarray(to)


def test_modules_do_as_their_examples():
    for module in (trial, scoring, worlds, physics, sensors):
        assert doctest.testmod(module).failed == 0


def test_in_steady_motion_the_wheels_pull_what_slope_and_ground_resist():
    slope = 0.05
    motion = moved(SKID, ramp([0.6] * 4, 2.0), slope=(slope, 0.0))
    weight = SKID.mass_kg * G_MPS2
    np.testing.assert_allclose(motion.pull_n[-1].sum(), weight * (slope + SKID.drag_ratio), rtol=2e-3)
    np.testing.assert_allclose(motion.load_n[-1].sum(), weight, rtol=1e-9)
    assert motion.load_n[-1, 0, 2:].sum() > motion.load_n[-1, 0, :2].sum()  # uphill the rear carries more
    np.testing.assert_allclose(motion.accel_x_mps2[-1], G_MPS2 * slope, rtol=2e-3)


def test_a_body_gains_the_energy_that_contacts_and_slope_give_it():
    body = SKID._replace(drag_ratio=0.0)
    motion = moved(body, ramp([0.3, 0.9, 0.3, 0.9]), slope=(0.03, 0.02))
    v, w = np.hypot(motion.speed_x_mps, motion.speed_y_mps)[:, 0], motion.yaw_rate_radps[:, 0]
    energy = 0.5 * body.mass_kg * v**2 + 0.5 * body.inertia_kgm2 * w**2
    rise = np.cumsum(motion.slope_x * motion.speed_x_mps + motion.slope_y * motion.speed_y_mps)[-1] * SAMPLE_S
    circumferential_mps = ramp([0.3, 0.9, 0.3, 0.9])[:: 2 * EVERY]
    driven_j = (motion.pull_n[:, 0] * circumferential_mps).sum() * SAMPLE_S
    held_j = energy[-1] + body.mass_kg * G_MPS2 * rise
    assert 0.0 < held_j < driven_j  # the rest is lost in slip


def test_left_and_right_are_mirror_images():
    left = moved(SKID, ramp([0.2, 0.8, 0.2, 0.8]), slope=(0.03, 0.04), yaw=0.3)
    right = moved(SKID, ramp([0.8, 0.2, 0.8, 0.2]), slope=(0.03, -0.04), yaw=-0.3)
    np.testing.assert_allclose(right.speed_x_mps, left.speed_x_mps, atol=1e-9)
    np.testing.assert_allclose(right.yaw_rate_radps, -left.yaw_rate_radps, atol=1e-9)
    np.testing.assert_allclose(right.speed_y_mps, -left.speed_y_mps, atol=1e-9)


def test_a_skid_steer_robot_turns_less_than_its_track_says():
    motion = moved(SKID, ramp([-0.5, 0.5, -0.5, 0.5]))
    track_m = 2 * SKID.wheels_m[0, 1]
    assert 1.3 < 1.0 / track_m / motion.yaw_rate_radps[-1, 0] < 2.5  # Mandow et al. 2007


def test_a_slow_car_drives_its_circle():
    car = WORLDS["plain", "car"]()
    length_m, half_m, turn = car.body.wheels_m[0, 0], car.body.wheels_m[0, 1], 0.2
    steer = [
        math.atan2(length_m * turn, 1 - half_m * turn),
        math.atan2(length_m * turn, 1 + half_m * turn),
        0,
        0,
    ]
    motion = moved(car.body, ramp([0.5] * 4, 2.0), steer=steer)
    np.testing.assert_allclose(motion.yaw_rate_radps[-1], 0.5 * turn, rtol=0.02)


def test_sensors_measure_what_moves():
    n = 400
    w, v = np.full((n, 1), 0.5), np.full((n, 1), 0.8)
    still = np.zeros((n, 1))
    time_s = np.arange(n) * SAMPLE_S
    motion = Motion(
        time_s, v, still, w, w.cumsum(axis=0) * SAMPLE_S, *[still] * 4, *[np.zeros((n, 1, 4))] * 2
    )
    rng = np.random.default_rng(0)
    seen = sensors.lidar_of(motion, Sensing((0.4, 0.1), lidar_yaw_rad=0.2), rng)[0].values
    mounted = np.array([[math.cos(0.2), math.sin(0.2)], [-math.sin(0.2), math.cos(0.2)]]) @ [0.8 - 0.05, 0.2]
    np.testing.assert_allclose(np.median(seen, axis=0), [*mounted, 0.5], atol=0.01)
    gyro = sensors.imu_of(motion, Sensing(gyro_ratio=1.1), rng)[0].channel("gyro_z_radps")
    np.testing.assert_allclose(gyro.mean(), 0.55, atol=0.01)
    angle = 3.0 * time_s[:, None]
    np.testing.assert_allclose(sensors.counted(angle, Sensing())[1:].mean(), 3.0, rtol=1e-3)
    lossy = sensors.counted(angle, Sensing(lost_ratio=0.5, lost_from_radps=2.0))
    np.testing.assert_allclose(lossy[1:].mean(), 2.5, rtol=1e-3)
    ramped = np.repeat(time_s[:, None], 1, axis=1)
    np.testing.assert_allclose(sensors.delayed(ramped, 0.123)[50:, 0], time_s[50:] - 0.123)


def test_a_motor_draws_torque_over_its_constant_and_weakens_as_it_warms():
    pull, rate = np.full((6000, 1, 1), 50.0), np.full((6000, 1, 1), 4.0)
    motor = Motor(nm_per_a=2.0, friction_nm=1.0, inertia_kgm2=0.1)
    torque = sensors.torque_of(pull, rate, np.array([0.2]), motor)
    current = sensors.currents_of(torque, motor)[:, 0, 0]
    np.testing.assert_allclose(current[0], (50.0 * 0.2 + 1.0) / 2.0, rtol=1e-6)
    assert 1.0 < current[-1] / current[0] < 1.05
    weak = sensors.currents_of(torque, motor._replace(weak_ratio=0.2))
    np.testing.assert_allclose(weak[0, 0, 0], current[0] / 0.8, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("place", [p for p in WORLDS if p[0] == "plain" or find_spec("mujoco")], ids="_".join)
def test_every_effect_shows_in_the_logs_of_its_world(place):
    world = WORLDS[place]()
    driven = driven_by(world, 2, np.random.default_rng(3), 4.0)

    def values(shown):
        runs = runs_of(shown, driven, np.random.SeedSequence(5))
        return {name: stream.values for name, stream in runs[0].streams.items()}

    plain = values(world)
    for effect in effects_of(*place):
        changed = values(effect.hide(world, effect.most))
        apart = [name for name in plain if not np.array_equal(plain[name], changed[name], equal_nan=True)]
        assert apart, effect.name
        assert all(np.isfinite(each).all() for each in changed.values()), effect.name


def test_names_of_answers_are_those_of_the_catalogue_or_of_what_it_lacks():
    for place in WORLDS:
        drive = load_robot(WORLDS[place]().robot).drive
        names = {each.name for each in library_of(drive)}
        inside = [bool({*effect.right} & names) for effect in effects_of(*place)]
        assert sum(inside) >= 5
    plain = {effect.name: {*effect.right} for place in WORLDS for effect in effects_of("plain", place[1])}
    catalogue = {effect.name for effect in LIBRARY}
    inside = [bool(right & catalogue) for right in plain.values()]
    assert sum(inside) >= 10
    assert len(inside) - sum(inside) >= 9


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [
        (Answer(causes=("motor_constant",)), Outcome.NEAREST),
        (Answer(causes=("payload", "scrub")), Outcome.COMPANY),
        (Answer(causes=("scrub",), candidates=("payload",)), Outcome.WRONG),
        (Answer(sets=(("payload", "scrub"),)), Outcome.SET),
        (Answer(sets=(("scrub", "lever_arm"),)), Outcome.WRONG),
        (Answer(causes=("payload",), faults=("the gyro is in deg/s",)), Outcome.COMPANY),
        (Answer(refusal="too few runs"), Outcome.WRONG),
        (Answer(causes=("payload",), named={"payload_ratio": (0.35, 0.2, 0.5)}), Outcome.RIGHT),
        (Answer(causes=("payload",), named={"payload_ratio": (0.45, 0.44, 0.46)}), Outcome.RIGHT),  # 12 % off
        (Answer(causes=("payload",), named={"payload_ratio": (0.7, 0.6, 0.8)}), Outcome.VALUE),
        (Answer(causes=("payload",)), Outcome.VALUE),
        (Answer(causes=("payload", "scrub"), named={"payload_ratio": (0.4, 0.3, 0.5)}), Outcome.COMPANY),
        (Answer(candidates=("scrub",)), Outcome.OTHER),
        (Answer(candidates=("scrub", "motor_constant")), Outcome.CANDIDATE),
        (Answer(candidates=("payload",), unexplained=("speed_x_mps",)), Outcome.UNEXPLAINED),
        (Answer(unexplained=("current_a by speed",)), Outcome.SILENT),  # known before anything was hidden
        (Answer(unexplained=("current_a by force",)), Outcome.UNEXPLAINED),
        (Answer(unexplained=("speed_x_mps",)), Outcome.UNEXPLAINED),
        (Answer(), Outcome.SILENT),
    ],
)
def test_an_answer_is_worth_what_the_physics_says(answer, outcome):
    known, hidden = ("current_a by speed",), {"payload_ratio": 0.4}
    assert outcome_of(answer, ("payload",), ("motor_constant",), known, hidden) is outcome


def test_values_that_right_names_have_are_of_the_catalogue_and_follow_the_size():
    for place in WORLDS:
        world = WORLDS[place]()
        drive = load_robot(world.robot).drive
        names = {each.name: {p.name for p in each.parameters} for each in library_of(drive)}
        for effect in effects_of(*place):
            if effect.name == "wheels_apart" and world.name == "skid":
                continue  # of the motion
            values = effect.values(world, 0.02)
            of_right = {name for right in effect.right for name in names.get(right, ())}
            assert not of_right or {*values} & of_right or effect.name in ("sticky_rollers", "balls_rub")
            assert all(
                np.sign(value) == -np.sign(effect.values(world, -0.02)[name])
                for name, value in values.items()
            )


@pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed (pip install mujoco)")
@pytest.mark.parametrize("kind", ["skid", "car", "omni"])
def test_a_scene_drives_as_its_wheels_turn(kind):
    world = WORLDS["mujoco", kind]()
    driven = driven_by(world, 1, np.random.default_rng(0), 2.5)
    level = driven._replace(slope=np.zeros((1, 2)))
    recorded = scenes.moved(kind, world.body, Scene(), world.motor, level)
    rate = np.gradient(recorded.turned_rad[:, 0], SAMPLE_S, axis=0) * world.body.radius_m[0]
    turns = np.full((1, rate.shape[1]), 1.0 / rate.shape[1])
    if kind == "omni":
        x, y = world.body.wheels_m.T
        plane = np.arctan2(y, x) + np.pi / 2
        turns = np.linalg.pinv(np.column_stack([np.cos(plane), np.sin(plane), np.hypot(x, y)]))
    motion = recorded.motion
    np.testing.assert_allclose(motion.speed_x_mps[:, 0], (rate @ turns.T)[:, 0], atol=0.12)
    assert np.abs(motion.speed_x_mps).max() > 0.1
    heavier = scenes.moved(
        kind, world.body._replace(mass_kg=2 * world.body.mass_kg), Scene(), world.motor, level
    )
    assert not np.array_equal(heavier.motion.speed_x_mps, motion.speed_x_mps)


def test_rows_that_cannot_run_are_refused(monkeypatch):
    with pytest.raises(ConfigError, match="some of plain_skid,"):
        foreign.Settings(rows="plain_boat")
    monkeypatch.setattr(foreign, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="need the package mujoco"):
        foreign.run(foreign.Settings(rows="mujoco_skid"))


def test_the_report_counts_what_was_answered():
    def of(effect, outcome, answer, row="plain_skid"):
        fields = {"row": row, "number": 0, "engine": row.partition("_")[0], "world": "skid", "effect": effect}
        about = {"size": 0.1, "over_limit": 6.0 if effect else 0.0, "inside": True, "right": ("payload",)}
        return ForeignTrial(
            **fields,
            **about,
            hidden={},
            nearest=(),
            known=("current_a",),
            answer=answer,
            outcome=outcome,
            seconds=1.0,
        )

    right = of("payload", Outcome.RIGHT, Answer(causes=("payload",)))
    wrong = of("payload", Outcome.WRONG, Answer(causes=("scrub",), named={"scrub_ratio": (0.2, 0.1, 0.3)}))
    trials = (
        *(right, right, right, wrong, of("payload", Outcome.SILENT, Answer())),
        *(of("", Outcome.SILENT, Answer()), of("", Outcome.WRONG, Answer(causes=("scrub",)))),
        *(
            of("payload", Outcome.OTHER, Answer(candidates=("scrub",))),
            of("payload", Outcome.VALUE, Answer()),
        ),
        of("", Outcome.UNEXPLAINED, Answer(unexplained=("current_a",))),
    )
    table = scoring.table_of(trials)
    assert table["plain: wrong or with false company"][:2] == (2, 7)
    assert table["plain: right, nearest, in a set or unexplained"][:2] == (3, 7)
    assert table["plain: silent at 5 times the limit"][:2] == (1, 7)
    assert table["nothing hidden: anything stated"][:2] == (2, 3)
    assert table["nothing hidden: beyond what calibration leaves"][:2] == (1, 3)
    result = foreign.ForeignResult(
        n=7, seed=0, rows=("plain_skid",), table=table, seconds=(1.0, 1.0), trials=trials
    )
    assert "scrub_ratio 0.2" in str(foreign.report(result))
