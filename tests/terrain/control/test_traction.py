import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.control import traction
from terrain.control.slip_table import DRIVE_STATES
from terrain.control.traction import (
    BAD_TIME,
    BRAKING,
    NO_SLIP,
    OK,
    SETTINGS,
    STALE,
    STATE_SIZE,
    STATUS_NAMES,
    STEADY,
    TRACTION,
    UNCERTAIN,
    Ground,
    check_settings,
    forget_ground,
    initial_state,
    traction_step,
    with_driver,
)
from terrain.errors import ConfigError
from terrain.kinematics.swerve import forward, inverse
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
POSITIONS_M, RADIUS_M = ROBOT.wheel_positions_m, ROBOT.wheel_radius_m
DT_S = 0.02
NAN, INF = math.nan, math.inf
BAD_TIMES = (NAN, 0.0, -0.02, 0.6, INF, -INF)
DRIVEN, WANTED, BALANCE, FLOOR = 0, 1, 5, 6
GROUND = Ground(0.1)
SLICK = Ground(0.1, 0.15, 3.0)
"""Ground on which braking is controlled."""


def steps(
    state,
    wheel,
    *,
    ground_mps=0.0,
    accel=0.0,
    slip=0.0,
    std=0.0,
    stale_s=0.0,
    torque=0.0,
    dt_s=DT_S,
    aim=GROUND,
    using=SETTINGS,
):
    """One step, each row given whole or as one number for all wheels; (told, next state, said)."""
    rows = [np.array(np.broadcast_to(row, 3), float) for row in (wheel, ground_mps, accel, slip, std, torque)]
    given = [*rows[:5], stale_s, rows[5]]
    before = state.copy()
    told, after, said = traction_step(using, state, Ground(*map(float, aim)), RADIUS_M, *given, dt_s)
    assert np.array_equal(state, before, equal_nan=True)
    return told, after, said


def plain(using, m, aim, radius, wheel, ground, accel, slips, stds, stale, torque, dt):
    """The step of the module's docstring, wheel by wheel, on a dict; (told, driven, target, status)."""
    u = [w * radius for w in wheel]
    w = max(abs(x) for x in u)
    if sum(x * s for x, s in zip(u, m["share"], strict=True)) < 0:
        m["d"] = 0.0
    if w > 0:
        m["share"] = [x / w for x in u]
    way = [-1.0 if share < 0 else 1.0 for share in m["share"]]
    share = [abs(s) for s in m["share"]]
    known = [all(map(math.isfinite, row)) for row in zip(ground, accel, slips, stds, strict=True)]
    near = [i for i in range(3) if known[i] and share[i] >= 0.3]
    q, a = 0.0, 0.0
    if near:
        i = min(near, key=lambda i: way[i] * ground[i] / share[i])
        q, a = way[i] * ground[i] / share[i], way[i] * accel[i] / share[i]
    largest = 0.0
    for i in range(3):
        if known[i]:
            wheel_speed = abs(ground[i]) / max(1 - max(way[i] * slips[i], 0), 0.05)
            largest = max(
                largest, stds[i] * wheel_speed / max(wheel_speed, 1.5 * using.launch_mps, m["from"])
            )
    sure = not largest > using.std_max_ratio
    fresh = stale <= using.stale_max_s
    status = NO_SLIP if not all(known) else STALE if not fresh else UNCERTAIN if not sure else OK
    target = aim.traction_ratio
    if not math.isnan(m["balance"]):
        over = max(using.balance_margin_ratio, aim.margin_ratio)
        target = min(target, max(m["balance"], 0) + over)
    target = max(target, m["floor"])
    d = m["d"]
    if not 0 < dt <= 0.5:
        m["d"] = min(w, d + using.fade_mps2 * 0.02)
        return [m["d"] * s / radius for s in m["share"]], m["d"], aim.traction_ratio, BAD_TIME
    rising, sharply = w > d + 1e-9, m["w"] - w > 0.5 * dt
    braking = not rising and (sharply or (m["braking_s"] > 0 and d > w))
    m["w"], braking_s = w, 0.0
    if status != OK:
        new, m["held_s"] = min(w, d + using.fade_mps2 * dt), 0.0
    elif rising:
        led = q + using.lead_s * min(max(a, 0.0), using.lead_max_mps2)
        new = min(w, max(d, max(led, using.launch_mps) / (1 - min(target, 0.95))))
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
    if status == OK:
        learn(using, m, q, way, slips, w, target, dt, aim.margin_ratio)
    seen = [way[i] * torque[i] for i in range(3)]
    if new <= 0.1 or not all(map(math.isfinite, seen)):
        seen = [0.0] * 3
    keep = math.exp(-dt / using.droop_time_s)
    m["torque"] = [keep * t + (1 - keep) * s for t, s in zip(m["torque"], seen, strict=True)]
    told = []
    mean_slip = sum(way[i] * slips[i] for i in range(3) if known[i]) / 3
    grip = min(max(2 - abs(mean_slip) / traction._GRIP, 0), 1)
    for i in range(3):
        give = using.droop_radps_per_nm * (m["torque"][i] - sum(m["torque"]) / 3)
        most = grip * using.droop_max_ratio * share[i] * new / radius
        told.append(way[i] * (share[i] * new / radius - (min(max(give, -most), most) if status == OK else 0)))
    return told, new, target, status


def learn(using, m, q, way, slips, w, target, dt, margin):
    """What steady motion balances, and whether a robot that is held back gains speed."""
    m["slow"] += (q - m["slow"]) * min(dt / traction._SLOW_S, 1)
    gained = (q - m["slow"]) / traction._SLOW_S
    if m["held_s"] > traction._HELD_S and gained < using.gain_least_mps2:
        m["floor"] = min(target + using.floor_rate_ratio * dt, 0.95)
    if abs(m["d"] - m["reference"]) > traction._CONSTANT_MPS:
        m["reference"], m["constant_s"] = m["d"], 0.0
    m["constant_s"] += dt
    if m["constant_s"] > traction._CONSTANT_S and abs(gained) < traction._STEADY_MPS2 and q > 0.1:
        slip = sum(way[i] * slips[i] for i in range(3)) / 3
        if math.isnan(m["balance"]):
            m["balance"] = slip
        m["balance"] += (slip - m["balance"]) * min(dt / traction._BALANCE_S, 1)
        floor = min(max(m["balance"], 0) + max(using.balance_margin_ratio, margin), 0.95)
        m["floor"] = floor if m["d"] >= w else max(m["floor"], floor)


def remembered():
    names = ("d", "w", "reference", "constant_s", "slow", "balance", "floor", "held_s", "braking_s", "from")
    memory = dict.fromkeys(names, 0.0)
    return memory | {"balance": NAN, "torque": [0.0] * 3, "share": [0.0] * 3}


def in_order(m):
    """Its numbers as the state has them; shares as rad/s of a m/s."""
    return [*list(m.values())[:10], *m["torque"], *(share / RADIUS_M for share in m["share"])]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_any_drive_with_faults_is_that_of_the_plain_form(seed):
    rng = np.random.default_rng(seed)
    changes = {"launch_mps": float(rng.choice([0.01, 0.22])), "droop_time_s": 0.2, "fade_mps2": 1.07}
    using = with_driver(
        SETTINGS._replace(**changes), ROBOT
    )  # no step of a fade is a threshold's, to the digit
    aim = Ground(rng.uniform(0, 0.6), *(rng.choice([[0.0, 0.0, 0.0], [0.15, 3.0, 0.05]])))
    memory, state = remembered(), initial_state()
    desired, v, bits = rng.choice([-1, 1], 3) * rng.uniform(0.2, 5, 3), 0.0, rng.uniform(0, 0.1)
    push = rng.uniform(0, 1)
    for k in range(120):
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
        given = (*rows[:4], stale_s, rows[4], dt_s)
        told, state, said = traction_step(using, state, aim, RADIUS_M, wheel, *given)
        expected, driven, target, status = plain(using, memory, aim, RADIUS_M, wheel, *given)
        assert told == pytest.approx(expected, abs=1e-12), k
        assert [said[0], said[1], said[5]] == pytest.approx([driven, target, status], abs=1e-12), k
        assert state == pytest.approx(in_order(memory), nan_ok=True, abs=1e-12), k
        assert np.isfinite(told).all()


@given(
    driven=st.floats(0.1, 2.0),
    slip=st.floats(-0.2, 0.9),
    target=st.floats(0.0, 0.9),
    more=st.floats(0.01, 1.0),
)
def test_the_cap_is_the_normalised_p_controller_of_slip_on_the_chassis(driven, slip, target, more):
    state = initial_state()
    state[[DRIVEN, WANTED]] = driven
    using = SETTINGS._replace(launch_mps=1e-6)
    wheel = (driven + more) / RADIUS_M
    told, _, said = steps(state, wheel, ground_mps=driven * (1 - slip), slip=slip, aim=(target,), using=using)
    corrected = driven + (target - slip) * driven / (1 - target)
    assert said[0] == pytest.approx(min(driven + more, max(driven, corrected)), rel=1e-9)
    assert told == pytest.approx(np.full(3, said[0] / RADIUS_M))


twists = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda twist: max(map(abs, twist)) > 0.05)
numbers = st.floats(-2.0, 2.0)


@given(twist=twists, was=st.floats(0, 2), way=numbers, accel=numbers, slip=st.floats(-1, 1), torque=numbers)
def test_speed_never_falls_while_more_is_wanted_and_the_turning_centre_stays(
    twist, was, way, accel, slip, torque
):
    wheel, steer = inverse(POSITIONS_M, RADIUS_M, np.array(twist), np.zeros(3))
    state = initial_state()
    state[[DRIVEN, WANTED]] = was
    inputs = {"ground_mps": way * np.sign(wheel), "accel": accel, "slip": slip, "torque": torque * wheel}
    for std in (0.0, 1.0):
        even = SETTINGS._replace(droop_radps_per_nm=0.0)
        told, after, said = steps(state, wheel, **inputs, std=std, using=even)
        desired = float(np.abs(wheel).max()) * RADIUS_M
        assert min(was, desired) <= said[0] <= desired
        assert after[DRIVEN] == said[0]
        share = said[0] / desired
        assert told == pytest.approx(share * wheel, abs=1e-12)
        got, residual = forward(POSITIONS_M, RADIUS_M, told, steer)
        assert got == pytest.approx(share * np.array(twist), abs=1e-9)
        assert residual < 1e-9
        # backward is forward in a mirror
        turned = {name: -np.asarray(row) for name, row in inputs.items()}
        back, after_back, said_back = steps(state, -wheel, **turned, std=std, using=even)
        assert np.array_equal(back, -told)
        assert np.array_equal(said_back, said, equal_nan=True)
        assert np.array_equal(after_back[:-3], after[:-3], equal_nan=True)


def rolling(torque, n=2000, wheel=5.0, **changes):
    """Steady at what is required, for long; (told, state)."""
    state = initial_state()
    for _ in range(n):
        told, state, said = steps(state, wheel, ground_mps=0.99, slip=0.01, torque=torque, **changes)
    assert said[0] == 1.0
    return told, state


def test_wheels_give_way_to_torque_over_the_mean_and_to_nothing_else():
    assert np.array_equal(rolling(7.0)[0], np.full(3, 5.0))
    torque = np.array([12.0, 3.0, -6.0])
    told, _ = rolling(torque)
    assert told - 5.0 == pytest.approx(SETTINGS.droop_radps_per_nm * (torque.mean() - torque), rel=1e-6)
    assert told.sum() == pytest.approx(15.0)
    told, _ = rolling(10 * torque)  # 10 % of its speed at most
    assert told == pytest.approx([4.5, 5.0 + 0.0, 5.5])
    told, _ = rolling(torque, wheel=5.0, std=1.0)
    assert np.array_equal(told, np.full(3, 5.0))


def test_a_torque_that_is_not_known_is_not_taken_for_none():
    steady, state = rolling(np.array([10.0, 10.0, 10.0]))
    for _ in range(100):
        told, state, _ = steps(state, 5.0, ground_mps=0.99, slip=0.01, torque=[NAN, 10.0, 10.0])
    assert np.array_equal(told, steady)


FAULTS = [
    *[({name: value}, NO_SLIP) for name in ("ground_mps", "accel", "slip", "std") for value in (NAN, INF)],
    ({"ground_mps": [0.9, NAN, 0.9]}, NO_SLIP),
    ({"std": 0.03}, UNCERTAIN),
    *[({"stale_s": value}, STALE) for value in (3.01, INF, NAN)],
    *[({"dt_s": value}, BAD_TIME) for value in BAD_TIMES],
]


@pytest.mark.parametrize(("fault", "status"), FAULTS)
def test_without_what_it_needs_it_fades_to_what_is_wanted_and_learns_nothing(fault, status):
    _, state = rolling(torque=0.0)
    state[[DRIVEN, FLOOR, BALANCE]] = 0.3, 0.2, 0.1
    before = state.copy()
    sound = {"ground_mps": 0.25, "slip": 0.1, "torque": NAN}
    _, _, said = steps(state, 5.0, **sound)
    assert (said[0], said[5]) == (pytest.approx(0.25 / 0.8), OK)
    rise = SETTINGS.fade_mps2 * DT_S
    for k in range(100):
        told, state, said = steps(state, 5.0, **sound | fault)
        assert STATUS_NAMES[int(said[5])] == STATUS_NAMES[status]
        assert said[0] == pytest.approx(min(1.0, 0.3 + (k + 1) * rise))
        assert told == pytest.approx(np.full(3, said[0] / RADIUS_M))
        assert np.array_equal(state[[BALANCE, FLOOR]], before[[BALANCE, FLOOR]])
    told, _, said = steps(state, 0.0, **sound | fault)  # and stops at once
    assert not told.any()
    assert said[0] == 0.0


def test_balance_is_measured_where_motion_is_steady_and_gives_the_target_its_floor():
    state = initial_state()
    speeds = np.concatenate([np.arange(0, 1, 0.02), np.full(150, 1.0)])
    seen = []
    for k, speed in enumerate(speeds):
        slip = 0.4 if speed < 1 else 0.15 + 0.05 * math.exp(-(k - 50) / 10)
        gone = speed * (1 - slip)
        _, state, said = steps(state, speed / RADIUS_M, ground_mps=gone, slip=slip, aim=(0.9,))
        seen.append(said[2])
    assert np.isnan(seen[:80]).all()
    assert seen[-1] == pytest.approx(0.15, abs=1e-3)
    assert state[FLOOR] == pytest.approx(0.15 + SETTINGS.balance_margin_ratio, abs=1e-3)
    assert steps(state, 5.0, ground_mps=0.85, slip=0.15, aim=(0.05,))[2][1] == state[FLOOR]
    working = steps(state, 5.0, ground_mps=0.85, slip=0.15, aim=Ground(0.9, margin_ratio=0.05))[2][1]
    assert working == pytest.approx(0.2, abs=1e-3)  # no more than the balance and what the work takes
    forgotten = forget_ground(state)
    assert (math.isnan(forgotten[BALANCE]), forgotten[FLOOR]) == (True, 0.0)
    rest = [i for i in range(STATE_SIZE) if i not in (BALANCE, FLOOR)]
    assert np.array_equal(forgotten[rest], state[rest])


def test_the_floor_rises_where_a_robot_is_held_back_and_gains_no_speed_and_only_there():
    floors = {}
    for name, gain_mps2 in {"stuck": 0.0, "gaining": 0.6}.items():
        state, v = initial_state(), 0.3
        for _ in range(100):
            v += gain_mps2 * DT_S
            _, state, said = steps(state, 20.0, ground_mps=v, slip=0.1, aim=(0.1,))
        floors[name] = state[FLOOR]
        assert said[0] < 4.0
    assert floors["gaining"] == 0.0
    assert floors["stuck"] == pytest.approx(0.1 + SETTINGS.floor_rate_ratio * 1.6, abs=0.02)


def driven_along(target, duration_s=30.0, desired_mps=1.0, shear=0.1, limit=0.4, resistance=0.2):
    """Speed over ground (n,) of a point on wheels: ``v' = g (limit (1 - exp(-s / shear)) - resistance)``."""
    state, v, speeds = initial_state(), 0.0, []
    for k in range(round(duration_s / DT_S)):
        told = min(desired_mps, k * DT_S)
        d = state[DRIVEN]
        if target is not None:
            slip = (d - v) / max(d, v) if max(d, v) > 0.05 else 0.0
            _, state, said = steps(state, told / RADIUS_M, ground_mps=v, slip=slip, aim=(target,))
            told = said[0]
        for _ in range(40):
            slip = (told - v) / max(told, v) if max(told, v) > 1e-6 else 0.0
            thrust = math.copysign(limit * (1 - math.exp(-abs(slip) / shear)), slip)
            v = max(0.0, v + 9.81 * (thrust - resistance * min(v / 0.02, 1.0)) * DT_S / 40)
        speeds.append(v)
    return np.array(speeds)


def test_no_target_however_low_or_high_costs_the_robot_its_speed():
    free = driven_along(None)
    balance = 0.1 * math.log(2)
    assert free[-1] == pytest.approx(1 - balance, rel=1e-3)
    for target in (0.02, 0.05, 0.1, 0.25, 0.6):
        speed = driven_along(target)
        assert speed[-1] == pytest.approx(free[-1], rel=0.005)
        assert speed[250] > 0.8 * free[250], target


def braked(aim, wheel, v, slowing=3.0, using=SETTINGS):
    """Told (n, 3), driven and state after a command to stand, on ground that slows so much."""
    state = initial_state()
    ways = np.sign(wheel)
    _, state, _ = steps(state, wheel, ground_mps=v * ways, aim=aim, using=using)
    state[DRIVEN] = v
    rows = []
    while len(rows) < 100:
        told, state, said = steps(state, 0.0, ground_mps=v * ways, aim=aim, using=using)
        rows.append([*told, said[0], said[4], v])
        v = max(v - slowing * DT_S, 0.0)
    return np.array(rows), state


def test_braking_on_slick_ground_keeps_the_directions_and_its_slip_and_ends():
    wheel = np.array([5.0, -5.0, 4.0])
    loose, _ = braked(Ground(0.1), wheel, 1.0)
    assert not loose[:, :4].any()
    using = with_driver(SETTINGS, ROBOT)
    held, state = braked(SLICK, wheel, 1.0, using=using)
    told, driven, state_said, v = held[:, :3], held[:, 3], held[:, 4], held[:, 5]
    busy = driven > 0
    assert 5 < busy.sum() < 20
    assert told[busy] == pytest.approx(driven[busy, None] / 1.0 * wheel)
    assert (np.diff(driven) <= 1e-12).all()
    assert set(state_said[busy]) == {BRAKING}
    # the slip asked for, at the speed that the lead makes of the one seen
    time_s = np.arange(1, 101) * DT_S
    charge = using.charge_mps_per_mps2 * 3.0 * np.exp(-time_s / using.charge_time_s)
    expected = (v - 3.0 * np.minimum(time_s, using.brake_lead_s)) * (1 - 0.15) - charge
    assert driven[busy] == pytest.approx(expected[busy])
    assert (expected + charge)[busy].min() > 0.1  # slower, the wheels are told to stand
    assert not held[~busy][:, :4].any()
    assert state[DRIVEN] == 0.0


def test_gentle_slowing_and_speeding_up_are_no_braking():
    state = initial_state()
    said = []
    for speed in [*np.full(5, 1.0), *np.arange(1.0, 0.9, -0.008), *np.full(5, 1.1)]:
        _, state, row = steps(state, speed / RADIUS_M, ground_mps=0.95, aim=SLICK)
        said.append(row[4])
    assert said[0] == TRACTION
    assert BRAKING not in said
    assert said[6] == STEADY
    names = {TRACTION: "traction", BRAKING: "braking", STEADY: "steady"}
    assert tuple(names[code] for code in range(3)) == DRIVE_STATES


@pytest.mark.parametrize(
    ("name", "value", "desired"),
    [
        ("lead_s", -0.1, "from zero up"),
        ("launch_mps", 0.0, "above zero"),
        ("droop_time_s", 0, "above zero"),
        ("charge_time_s", NAN, "above zero"),
        ("std_max_ratio", INF, "from zero up"),
        ("fade_mps2", "fast", "from zero up"),
        ("fade_mps2", True, "from zero up"),
        ("stale_max_s", None, "from zero up"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_sentence(name, value, desired):
    with pytest.raises(ConfigError) as refused:
        check_settings(SETTINGS._replace(**{name: value}))
    assert str(refused.value) == f"traction: {name} is {value!r}, a number {desired} is required"


def test_whole_numbers_are_settings():
    using = check_settings(SETTINGS._replace(lead_s=0, stale_max_s=3))
    assert steps(initial_state(), 5.0, using=using)[2][5] == OK
