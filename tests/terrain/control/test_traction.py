import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.control import traction
from terrain.control.traction import (
    SETTINGS,
    TractionState,
    TractionStatus,
    TractionTarget,
    WheelMotion,
    settings_of,
    traction_step,
)
from terrain.kinematics.commands import wheel_command_step
from terrain.kinematics.wheels import no_slip_twist
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
POSITIONS_M, RADIUS_M = ROBOT.wheel_positions_m, ROBOT.wheel_radius_m
DT_S = 0.02
NAN, INF = math.nan, math.inf
BAD_TIMES = (NAN, 0.0, -0.02, 0.6, INF, -INF)
TARGET = TractionTarget(0.1)
"""Terrain on which braking is controlled."""


def steps(state, wheel, *, ground_mps=0.0, accel=0.0, slip=0.0, std=0.0, torque=0.0, using=SETTINGS):
    """One step, each row given whole or as one number for all wheels; (command, next state, report)."""
    rows = [np.array(np.broadcast_to(row, 3), float) for row in (wheel, ground_mps, accel, slip, std, torque)]
    return traction_step(
        using, state, TARGET, RADIUS_M, rows[0], WheelMotion(*rows[1:], rows[0], NAN, 0.0), DT_S
    )


def plain(using, m, aim, radius, wheel, ground, accel, slips, stds, stale, torque, dt):
    """The step of the module's docstring, wheel by wheel, on a dict; (command, driven, target, status)."""
    u = [w * radius for w in wheel]
    w = max(abs(x) for x in u)
    if sum(x * s for x, s in zip(u, m["share"], strict=True)) < 0:
        m["d"] = 0.0
    if w > 0:
        m["share"] = [x / w for x in u]
    direction = [-1.0 if share < 0 else 1.0 for share in m["share"]]
    share = [abs(s) for s in m["share"]]
    known = [all(map(math.isfinite, row)) for row in zip(ground, accel, slips, stds, strict=True)]
    near = [i for i in range(3) if known[i] and share[i] >= 0.3]
    along = [(direction[i] * ground[i] / share[i], direction[i] * accel[i] / share[i]) for i in near]
    q, a = min(along, key=lambda one: one[0], default=(0.0, 0.0))
    largest, slowest = 0.0, max(1.5 * using.launch_mps, m["from"])
    for i in filter(known.__getitem__, range(3)):
        wheel_speed = abs(ground[i]) / max(1 - max(direction[i] * slips[i], 0), 0.05)
        largest = max(largest, stds[i] * wheel_speed / max(wheel_speed, slowest))
    certain = not largest > using.std_max_ratio
    fresh = stale <= using.stale_max_s
    checks = {TractionStatus.NO_SLIP: all(known), TractionStatus.STALE: fresh}
    falls = aim.braking_mps2 == 0 and m["lagged"] - w > traction._FALLEN_MPS
    checks |= {TractionStatus.UNCERTAIN: certain and not falls}
    status = next((status for status, passed in checks.items() if not passed), TractionStatus.OK)
    target = aim.traction_ratio
    if not math.isnan(m["balance"]):
        over = max(using.balance_margin_ratio, aim.margin_ratio)
        target = min(target, max(m["balance"], 0) + over)
    target = max(target, m["floor"])
    d = m["d"]
    if not 0 < dt <= 0.5:
        m["d"] = min(w, d + using.fade_mps2 * 0.02)
        return [m["d"] * s / radius for s in m["share"]], m["d"], aim.traction_ratio, TractionStatus.BAD_TIME
    part = min(dt / using.smooth_s, 1) if using.smooth_s and not math.isnan(m["q"]) else 1
    smooth = q if part == 1 else (m["q"] + a * dt) * (1 - part) + q * part
    m["a"] = a if part == 1 else m["a"] * (1 - part) + a * part
    if status != TractionStatus.OK:
        m["a"], smooth = a, NAN
    m["q"] = smooth
    rising, sharply = w > d + 1e-9, m["w"] - w > 0.5 * dt
    braking = not rising and (sharply or (m["braking_s"] > 0 and d > w))
    m["w"], braking_s = w, 0.0
    if status != TractionStatus.OK:
        new, m["held_s"] = min(w, max(d + using.fade_mps2 * dt, using.step_mps)), 0.0
    elif rising:
        led = smooth + using.lead_s * min(max(m["a"], 0.0), using.lead_max_mps2)
        cap = max(led, using.launch_mps) / (1 - min(target, 0.95))
        rise = using.rise_mps2 if smooth > using.launch_mps else using.fade_mps2
        new = min(w, max(d, min(cap, max(d + rise * dt, using.step_mps))))
        m["held_s"] = m["held_s"] + dt if new < w else 0.0
    else:
        new, m["held_s"] = w, 0.0
        if braking and aim.braking_mps2 > 0:
            t = m["braking_s"] + dt
            least = (q - aim.braking_mps2 * min(t, using.brake_lead_s)) * (1 - aim.braking_ratio)
            if least > max(w, traction._BRAKE_END_MPS):
                spent = using.charge_mps_per_mps2 * aim.braking_mps2 * math.exp(-t / using.charge_time_s)
                new, braking_s = max(w, min(d, least - spent)), t
    m["from"] = max(m["from"], d) if braking_s > 0 else 0.0
    m["d"], m["braking_s"] = new, braking_s
    m["lagged"] += (new - m["lagged"]) * min(dt / traction._LAG_S, 1)
    if status == TractionStatus.OK:
        learn(using, m, q, direction, slips, w, target, dt, aim.margin_ratio)
    seen = [direction[i] * torque[i] for i in range(3)]
    if new <= 0.1 or not all(map(math.isfinite, seen)):
        seen = [0.0] * 3
    keep = math.exp(-dt / using.droop_time_s)
    m["torque"] = [keep * t + (1 - keep) * s for t, s in zip(m["torque"], seen, strict=True)]
    command = []
    mean_slip = sum(direction[i] * slips[i] for i in range(3) if known[i]) / 3
    grip = min(max(2 - abs(mean_slip) / traction._GRIP, 0), 1)
    for i in range(3):
        give = using.droop_radps_per_nm * (m["torque"][i] - sum(m["torque"]) / 3)
        most = grip * using.droop_max_ratio * share[i] * new / radius
        droop = min(max(give, -most), most) if status == TractionStatus.OK else 0
        command.append(direction[i] * (share[i] * new / radius - droop))
    return command, new, target, status


def learn(using, m, q, direction, slips, w, target, dt, margin):
    """What steady motion balances, and whether a robot that is held back gains speed."""
    m["slow"] += (q - m["slow"]) * min(dt / traction._SLOW_S, 1)
    gained = (q - m["slow"]) / traction._SLOW_S
    if m["held_s"] > traction._HELD_S and gained < using.gain_least_mps2:
        m["floor"] = min(target + using.floor_rate_ratio * dt, 0.95)
    if abs(m["d"] - m["reference"]) > traction._CONSTANT_MPS:
        m["reference"], m["constant_s"] = m["d"], 0.0
    m["constant_s"] += dt
    if m["constant_s"] > traction._CONSTANT_S and abs(gained) < traction._STEADY_MPS2 and q > 0.1:
        slip = sum(direction[i] * slips[i] for i in range(3)) / 3
        if math.isnan(m["balance"]):
            m["balance"] = slip
        m["balance"] += (slip - m["balance"]) * min(dt / traction._BALANCE_S, 1)
        floor = min(max(m["balance"], 0) + max(using.balance_margin_ratio, margin), 0.95)
        m["floor"] = floor if m["d"] >= w else max(m["floor"], floor)


def remembered():
    names = (
        "d",
        "w",
        "lagged",
        "reference",
        "constant_s",
        "q",
        "a",
        "slow",
        "balance",
        "floor",
        "held_s",
        "braking_s",
        "from",
    )
    memory = dict.fromkeys(names, 0.0)
    return memory | {"balance": NAN, "q": NAN, "torque": [0.0] * 3, "share": [0.0] * 3}


def in_order(m):
    """Its numbers as the state has them; shares as rad/s of a m/s."""
    return [*list(m.values())[:13], *m["torque"], *(share / RADIUS_M for share in m["share"])]


def numbers_of(state):
    *scalars, torques, rates = state
    return np.array([*scalars, *torques, *rates])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_any_drive_with_faults_equals_the_reference_implementation(seed):
    rng = np.random.default_rng(seed)
    changes = {"launch_mps": float(rng.choice([0.01, 0.22])), "droop_time_s": 0.2, "fade_mps2": 1.07}
    changes |= {"smooth_s": rng.choice([0.0, 0.2]), "rise_mps2": rng.choice([1.03, INF])}
    changes |= {"step_mps": rng.choice([0.0, 0.1])}
    using = settings_of(ROBOT)._replace(**changes)  # no step of a fade is a threshold's
    aim = TractionTarget(rng.uniform(0, 0.6), *(rng.choice([[0.0, 0.0, 0.0], [0.15, 3.0, 0.05]])))
    memory, state = remembered(), TractionState()
    desired, v, bits = rng.choice([-1, 1], 3) * rng.uniform(0.2, 5, 3), 0.0, rng.uniform(0, 0.1)
    push = rng.uniform(0, 1)
    for k in range(100):
        if rng.random() < 0.03:  # a new command: stop, another speed, another turn
            desired = rng.choice([0.0, 0.3, 1.0, -1.0]) * rng.choice([-1, 1], 3) * rng.uniform(0.2, 5, 3)
        level = min(1, k / 40)
        wheel = desired * level
        v += (min(max(memory["d"] - v, -0.06), 0.06 * push)) * rng.uniform(0, 1)
        rows = [np.sign(wheel) * v * np.abs(wheel) / max(np.abs(wheel).max(), 0.1), rng.normal(0, 0.4, 3)]
        rows = [rows[0] + bits * rng.standard_normal(3), rows[1], np.clip(rng.normal(0, 0.3, 3), -1, 1)]
        rows += [rng.uniform(0, 0.022, 3), rng.normal(0, 10, 3)]
        stale_s, dt_s = 0.0, DT_S
        if rng.random() < 0.1:
            rows[rng.integers(5)][rng.integers(3)] = rng.choice([NAN, INF, 0.0])
            stale_s = rng.choice([NAN, INF, 3.01, 2.9])
        if rng.random() < 0.05:
            dt_s = rng.choice(BAD_TIMES)
        wheels = WheelMotion(*rows, wheel, NAN, stale_s)
        command, state, report = traction_step(using, state, aim, RADIUS_M, wheel, wheels, dt_s)
        given = (*rows[:4], stale_s, rows[4], dt_s)
        expected, driven, target, status = plain(using, memory, aim, RADIUS_M, wheel, *given)
        assert command == pytest.approx(expected, abs=1e-12), k
        decided = [report.driven_mps, report.aimed_ratio, report.status]
        assert decided == pytest.approx([driven, target, status], abs=1e-12), k
        assert numbers_of(state) == pytest.approx(in_order(memory), nan_ok=True, abs=1e-12), k
        assert np.isfinite(command).all()


twists = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda twist: max(map(abs, twist)) > 0.05)
numbers = st.floats(-2.0, 2.0)


@given(
    twist=twists, was=st.floats(0, 2), direction=numbers, accel=numbers, slip=st.floats(-1, 1), torque=numbers
)
def test_speed_never_falls_while_more_is_desired_and_the_turning_centre_stays(
    twist, was, direction, accel, slip, torque
):
    wheel, steer = wheel_command_step(
        np.array(POSITIONS_M), RADIUS_M, 1e9, 1e9, 1.0, np.array(twist, float), np.zeros(3)
    )[1:]
    state = TractionState(driven_mps=was, desired_mps=was)
    inputs = {"ground_mps": direction * np.sign(wheel), "accel": accel, "slip": slip}
    inputs["torque"] = torque * wheel
    for std in (0.0, 1.0):
        even = SETTINGS._replace(droop_radps_per_nm=0.0)
        command, after, report = steps(state, wheel, **inputs, std=std, using=even)
        desired = float(np.abs(wheel).max()) * RADIUS_M
        assert min(was, desired) <= report.driven_mps <= desired
        assert after.driven_mps == report.driven_mps
        share = report.driven_mps / desired
        assert command == pytest.approx(share * wheel, abs=1e-12)
        got, residual = no_slip_twist(POSITIONS_M, steer, RADIUS_M * np.asarray(command))
        assert got == pytest.approx(share * np.array(twist), abs=1e-9)
        assert residual < 1e-9
        # backward is forward in a mirror
        turned = {name: -np.asarray(row) for name, row in inputs.items()}
        back, after_back, report_back = steps(state, -wheel, **turned, std=std, using=even)
        assert np.array_equal(back, -command)
        assert np.array_equal(report_back, report, equal_nan=True)
        assert np.array_equal(numbers_of(after_back)[:-3], numbers_of(after)[:-3], equal_nan=True)


def test_no_slip_is_believed_before_the_estimate_can_show_a_braking():
    wheel, moves = np.full(3, 1.0 / RADIUS_M), {"ground_mps": 1.0}
    _, state, report = steps(TractionState(1.0, 1.0, 1.0), wheel, **moves)
    statuses = [report.status]
    for _ in range(20):
        _, state, report = steps(state, np.zeros(3), **moves)
        statuses.append(report.status)
    assert statuses[0] == statuses[-1] == TractionStatus.OK
    assert set(statuses[1:8]) == {TractionStatus.UNCERTAIN}
    slower = np.arange(1.0, 0.0, -1.0 * DT_S)  # braking as usual
    for speed in slower:
        _, state, report = steps(state, np.full(3, speed / RADIUS_M), ground_mps=speed)
        assert report.status == TractionStatus.OK


def test_a_fix_that_moves_the_speed_in_a_step_moves_the_command_within_its_time():
    """A receiver's speed at 10 Hz that is off by 8 cm/s at once: the command rises no faster than half as steeply."""
    using = settings_of(load_robot("husky"))
    found = []
    for smooth_s in (0.0, using.smooth_s):
        state, driven = TractionState(), []
        for k in range(100):
            speed = 0.35 + 0.08 * (k >= 50)
            _, state, report = steps(
                state, 5.0, ground_mps=speed, using=using._replace(smooth_s=smooth_s, rise_mps2=INF)
            )
            driven.append(report.driven_mps)
        found.append(np.diff(driven[48:70]))
    assert max(found[1]) < 0.5 * max(found[0])
    assert sum(found[1]) > 0.8 * sum(found[0])  # it gets there
