"""The compiled chain, sample by sample, gives the numbers of its plain form: whole signals, one by one."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from terrain.angles import unwrapped, wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation import feed
from terrain.estimation.feed import clean_streams, measurement_table
from terrain.kinematics.camera import body_motion
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults
from terrain.simulation.sensors import Gnss

ROBOT = load_robot("agrimaro")
ODD = ROBOT.with_parts(
    sensors=replace(
        ROBOT.sensors,
        gyro_bias_z_radps=0.01,
        accel_bias_x_mps2=0.1,
        accel_scale_y_ratio=0.97,
        imu_latency_s=0.02,
        gyro_bandwidth_hz=8.0,
        accel_bandwidth_hz=2.0,
    ),
    steering=replace(ROBOT.steering, zero_1_rad=3.0, zero_2_rad=-2.0, zero_3_rad=0.5),
    camera=replace(ROBOT.camera, time_constant_s=0.02, lever_x_m=0.1, latency_s=0.03),
)


def plain_jumps(time_s, value, least, per_second, fate=feed.PASSING):
    """Mark samples that are further from the last one kept than a robot gets, for at most feed.BELIEVED_S."""
    if fate != feed.PASSING:
        return plain_sums(time_s, value, least, per_second, fate) != 0.0
    jumps = np.zeros(value.size, dtype=bool)
    last, last_s, since_s = np.nan, np.nan, np.nan
    for k in np.flatnonzero(np.isfinite(value)):
        if abs(value[k] - last) > least + per_second * (time_s[k] - last_s):
            since_s = time_s[k] if np.isnan(since_s) else since_s
            if time_s[k] - since_s < feed.BELIEVED_S:
                jumps[k] = True
                continue
        last, last_s, since_s = value[k], time_s[k], np.nan
    return jumps


def plain_sums(time_s, value, least, per_second, fate, period_s=None):
    """Sum the jumps of a row whose jumps last: from sample to sample; zero again within half of the least.

    A jump from the first sample after a gap is that one's fault.
    """
    known = np.flatnonzero(np.isfinite(value))
    gap_s = feed.GAP_PERIODS * (np.median(np.diff(time_s)) if period_s is None else period_s)
    sums, total, followed = np.zeros(value.size), 0.0, False
    for before, k in pairwise(known):
        step_s, change = time_s[k] - time_s[before], value[k] - value[before]
        if fate == feed.LATCHED and step_s > gap_s:
            total, followed = 0.0, False
            continue
        if followed and abs(change) > least + per_second * step_s:
            total = total + change if abs(total + change) > 0.5 * least else 0.0
        followed, sums[k] = True, total
    return sums


def plain_counts(value):
    """Count how often each value has repeated itself; one that is unknown does not count."""
    counts, count, last = np.zeros(value.size), 0, np.nan
    for k in range(value.size):
        if np.isfinite(value[k]):
            count, last = (count + 1 if abs(value[k] - last) <= feed.SAME else 0), value[k]
        counts[k] = count
    return counts


def plain_frozen(value, most, moving):
    """Mark values that have repeated themselves ``most`` times, or four times their longest run in motion."""
    frozen, counts = np.zeros(value.size, dtype=bool), plain_counts(value)
    longest, began, before = 0, False, 0
    for k in np.flatnonzero(np.isfinite(value)):
        if counts[k] == 0:
            longest = max(longest, before) if moving[k] and began else longest
            began = moving[k]
        before, frozen[k] = counts[k], moving[k] and counts[k] >= max(most, 4 * longest)
    return frozen


def plain_moving(clock, wheel_speed_mps):
    """Return the low-passed wheel speeds (n, 3) behind each tick, and a function from instants to motion."""
    once, twice = np.full((2, clock.size, 3), np.nan)
    for n in range(clock.size):
        step_s = clock[n] - clock[n - 1] if n else np.nan
        for i in range(3):
            speed = wheel_speed_mps[n, i]
            before = once[n - 1, i] if n else np.nan
            if np.isnan(before):
                once[n, i] = twice[n, i] = speed
            elif np.isnan(speed):
                once[n, i], twice[n, i] = before, twice[n - 1, i]
            else:
                keep = np.exp(-step_s / feed.CHANGE_S)
                twice[n, i] = before + (twice[n - 1, i] - before) * keep
                once[n, i] = speed + (before - speed) * keep

    def moving(came_s):
        last = np.searchsorted(clock + feed.TICK_S, came_s) - 1  # the tick that was done when a sample came
        return np.array(
            [n >= 0 and bool((np.abs(once[n]) > feed.MOVING_MPS).any()) for n in last], dtype=bool
        )

    return once, twice, moving


def plain_slips(table, speeds, robot):
    """Return the slip (n, 3) of each wheel by the camera; NaN where it is slow or not measured."""
    turn, camera = table["gyro_z_radps"], robot.camera
    x = table["camera_speed_x_mps"] + turn * camera.lever_y_m
    y = table["camera_speed_y_mps"] - turn * camera.lever_x_m
    steer = np.column_stack([table[f"steer_{i}_rad"] for i in (1, 2, 3)])
    x_m, y_m = robot.wheel_positions_m.T
    along = (x[:, None] - turn[:, None] * y_m) * np.cos(steer) + (y[:, None] + turn[:, None] * x_m) * np.sin(
        steer
    )
    fastest = np.maximum(np.abs(speeds), np.abs(along))
    return np.where(fastest > feed.SHOWN_MPS, (speeds - along) / fastest, np.nan)


def plain_derived(clock, table, once, twice, imu_s, accel_z, robot):
    """Return the rows that follow from others, tick by tick."""
    n = clock.size
    rows = {row: np.full(n, np.nan) for row in feed.DERIVED_ROWS}
    square = np.full(imu_s.size, np.nan)
    for k in np.flatnonzero(np.isfinite(accel_z)):
        before = np.flatnonzero(np.isfinite(square[:k]))
        keep = np.exp(-(imu_s[k] - imu_s[before[-1]]) / feed.VIBRATION_S) if before.size else 0.0
        square[k] = accel_z[k] ** 2 + ((square[before[-1]] - accel_z[k] ** 2) * keep if before.size else 0.0)
    speeds = np.column_stack([table[f"wheel_{i}_radps"] for i in (1, 2, 3)]) * robot.wheel_radius_m
    slips, ground = plain_slips(table, speeds, robot), feed.GROUND_SLIP_RATIO**2
    still_since, seen_s, changes = np.nan, np.nan, np.full((n, 3), np.nan)
    for k in range(n):
        for i in range(3):
            slow, slower = (once[k - 1, i], twice[k - 1, i]) if k else (np.nan, np.nan)
            rise = slow - slower
            change = slower * np.sign(rise) * max(abs(rise) - feed.WAVERING_MPS, 0.0) / feed.CHANGE_S
            rows[f"wheel_{i + 1}_growth_per_s"][k] = change / (slower**2 + feed.CRAWL_MPS**2)
            ahead = max(abs(speeds[k, i] - slow) - feed.RIPPLE_MPS, 0.0) if slow == slow else np.nan
            changes[k, i] = (abs(speeds[k, i]) + feed.CRAWL_MPS) * ahead / feed.CHANGE_S
            rows[f"wheel_{i + 1}_change_m2ps3"][k] = changes[k, i]
        seen_s = clock[k] if np.isfinite(table["camera_speed_x_mps"][k]) else seen_s
        rows["camera_age_s"][k] = clock[k] - seen_s
        if not clock[k] - seen_s <= feed.UNSEEN_AFTER_S:
            for i in range(3):
                left = changes[: k + 1, i] * np.exp(-(clock[k] - clock[: k + 1]) / feed.HELD_S)
                rows[f"wheel_{i + 1}_change_m2ps3"][k] = (
                    np.nanmax(left) if np.isfinite(left).any() else np.nan
                )
        if k:
            for ratio in slips[k][np.isfinite(slips[k])]:
                keep = np.exp(-(clock[k] - clock[k - 1]) / (3 * feed.GROUND_S))
                ground = ratio**2 + (ground - ratio**2) * keep
        rows["ground_slip_ratio"][k] = np.sqrt(ground)
        still = k > 0 and (np.abs(twice[k - 1]) <= feed.REST_WHEEL_MPS).all()
        still &= (np.abs(speeds[k]) <= feed.MOVING_MPS).all() and abs(
            table["gyro_z_radps"][k]
        ) <= feed.REST_TURN_RADPS
        for axis in "xy":
            still &= abs(table[f"accel_{axis}_mps2"][k]) <= feed.REST_ACCEL_MPS2
            still &= not abs(table[f"camera_speed_{axis}_mps"][k]) > feed.REST_SEEN_MPS
        still_since = (still_since if still_since == still_since else clock[k]) if still else np.nan
        if clock[k] - still_since >= feed.REST_AFTER_S:
            for row in feed.DERIVED_ROWS[-3:]:
                rows[row][k] = 0.0
    return rows, square


def plain_low_pass(time_s, value, tau_s, gap_s):
    """Return the low-passed value, and whether it has forgotten where it started after the last gap."""
    out, begun_s, settled = np.array(value), -np.inf, np.ones(value.size, bool)
    gap_s = max(gap_s, feed.BRIDGED_LAGS * tau_s)
    for k in range(1, value.size):
        step_s = time_s[k] - time_s[k - 1]
        if step_s > gap_s:
            begun_s = time_s[k]
        elif tau_s > 0:
            lead = tau_s * (value[k] - value[k - 1]) / step_s
            out[k] = value[k] - lead + np.exp(-step_s / tau_s) * (out[k - 1] - value[k - 1] + lead)
        settled[k] = time_s[k] >= begun_s + feed.SETTLED_LAGS * tau_s
    return out, settled


def plain_held(clock, time_s, period_s):
    """Return which sample each tick takes: the last at or before it, or -1 where that is too old."""
    tick_s = np.median(np.diff(clock))
    held = np.searchsorted(time_s, clock + feed.TICK_S, side="right") - 1
    taken = held >= 0
    age_s = clock[taken] - time_s[held[taken]]
    taken[taken] = age_s <= feed.MAX_AGE_PERIODS * max(period_s, tick_s) + feed.TICK_S
    if period_s > feed.MAX_AGE_PERIODS * tick_s:
        taken[1:] &= held[1:] != held[:-1]
    return np.where(taken, held, -1)


def plain_on_clock(clock, time_s, came_s, signal, tau_s):
    known, period_s = np.isfinite(signal), np.median(np.diff(time_s))
    held = plain_held(clock, came_s[known], period_s)
    taken, out = held[held >= 0], np.full(clock.size, np.nan)
    low_passed, settled = plain_low_pass(time_s[known], signal[known], tau_s, feed.GAP_PERIODS * period_s)
    behind = np.where(settled, low_passed - signal[known], np.nan)
    decay = np.exp((time_s[known][taken] - clock[held >= 0]) / tau_s) if tau_s > 0 else 1.0
    out[held >= 0] = signal[known][taken] + behind[taken] * decay
    return out


def plain_imu(imu, robot):
    sensors = robot.sensors
    force_x = (imu.channel("accel_x_mps2") - sensors.accel_bias_x_mps2) / sensors.accel_scale_x_ratio
    force_y = (imu.channel("accel_y_mps2") - sensors.accel_bias_y_mps2) / sensors.accel_scale_y_ratio
    roll, pitch = imu.channel("roll_rad"), imu.channel("pitch_rad")
    return {
        "accel_x_mps2": force_x + GRAVITY_MPS2 * np.sin(pitch),
        "accel_y_mps2": force_y - GRAVITY_MPS2 * np.sin(roll) * np.cos(pitch),
        "gyro_z_radps": imu.channel("gyro_z_radps") - sensors.gyro_bias_z_radps,
        "imu_yaw_rad": unwrapped(imu.channel("yaw_rad")),
    }


def plain_steering(steering, robot):
    zeros_rad = [getattr(robot.steering, f"zero_{i}_rad") for i in (1, 2, 3)]
    return {f"steer_{i + 1}_rad": unwrapped(a) for i, a in enumerate(wrapped(steering.values - zeros_rad).T)}


def plain_camera(odometry, robot):
    seen = body_motion(odometry, robot.camera)
    return dict(zip(feed.CAMERA_ROWS, (*seen.speed_mps.T, seen.yaw_rate_radps, seen.yaw_rad), strict=True))


def plain_gnss(gnss, causal):
    """Positions from the first (fixed) one, speeds, and the variances of both; NaN together."""
    values = np.array(gnss.values[:, :4])
    values[np.isnan(values[:, :2]).any(axis=1), :2] = np.nan
    fixed, known = gnss.channel("fix_ratio") >= 0.5, np.isfinite(values[:, 0])
    values[:, :2] -= values[(known & fixed if (known & fixed).any() and not causal else known).argmax(), :2]
    std = gnss.channel("std_position_m")
    std = np.where(std > 0, std, np.where(fixed, feed.FIX_STD_M, feed.FLOAT_STD_M))
    variance = np.column_stack([std, std, *[np.full(std.size, feed.GNSS_SPEED_STD_MPS)] * 2]) ** 2
    variance[np.isnan(values)] = np.nan
    return dict(zip(feed.GNSS_ROWS, values.T, strict=True)), dict(
        zip(feed.GNSS_ROWS, variance.T, strict=True)
    )


def plain_yaw(table, clock, wheel_speed_mps, initial_yaw_rad, causal):
    """Count the yaw rows from the start, and keep the camera's on the turn that the IMU is on."""
    moving = (np.abs(wheel_speed_mps) > feed.STANDING_SPEED_MPS).any(axis=1) | (
        clock > clock[0] + feed.STANDING_S
    )
    standing = ~np.logical_or.accumulate(moving)
    for row in ("imu_yaw_rad", "camera_yaw_rad"):
        known = np.isfinite(table[row])
        first = known & standing if (known & standing).any() else np.arange(clock.size) == known.argmax()
        mean = table[row][first].mean()
        if causal:
            mean = np.cumsum(np.where(first, table[row], 0.0)) / np.maximum(np.cumsum(first), 1)
        table[row] = table[row] - mean + initial_yaw_rad
    imu, camera = table["imu_yaw_rad"], table["camera_yaw_rad"]
    both, start = np.isfinite(imu) & np.isfinite(camera), int(np.isfinite(camera).argmax())
    if both[start] and clock[start] > clock[0] + feed.LATE_S:
        camera = camera + imu[start] - initial_yaw_rad
    table["camera_yaw_rad"] = camera + 2 * np.pi * np.round(np.where(both, imu - camera, 0.0) / (2 * np.pi))


def plain_table(run, robot, causal, initial_yaw_rad):
    """Return rows (n, 30), variances (n, 4) and counts of jumps of a swerve robot's run."""
    streams, lag_s = clean_streams(run, robot)[0], robot.sensors.encoder_time_constant_s
    wheels = streams["wheels"]
    clock, rates = wheels.time_s, wheels.values / robot.motors.reduction_ratio
    rates = np.where(np.abs(rates) > feed.MAX_RATE_FACTOR * robot.motors.speed_max_radps, np.nan, rates)
    rows = feed.ROWS
    rates = plain_wheels(clock, wheels.values, rates, robot)
    once, twice, moving = plain_moving(clock, rates * robot.wheel_radius_m)
    table, jumps = dict(zip(rows, rates.T, strict=False)), {}
    imu_s, accel_z = np.zeros(0), np.zeros(0)
    gyro_s, accel_s = (max(lag_s - own_s, 0.0) for own_s in robot.sensors.imu_time_constants_s)
    low_pass_s = {"gyro_z_radps": gyro_s, "accel_x_mps2": accel_s, "accel_y_mps2": accel_s}
    camera_lag_s = max(lag_s - robot.camera.time_constant_s, 0.0)
    gnss_variance = dict.fromkeys(feed.GNSS_ROWS, np.full(clock.size, np.nan))
    for name, latency_s, tau_s in (
        ("imu", robot.sensors.imu_latency_s, lag_s),
        ("steering", 0.0, lag_s),
        ("odometry", robot.camera.latency_s, camera_lag_s),
        ("gnss", feed.GNSS_LATENCY_S, lag_s),
    ):
        if name not in streams:
            continue
        stream = streams[name]
        if name == "odometry":
            sees = ~(stream.channel("confidence_ratio") < feed.MIN_CONFIDENCE_RATIO)
            stream = Stream(stream.time_s[sees], stream.values[sees], stream.channels)
        time_s = stream.time_s - latency_s
        came_s = stream.time_s if causal else time_s
        if name == "gnss":
            signals, variance = plain_gnss(stream, causal)
            gnss_variance = {
                row: plain_on_clock(clock, time_s, came_s, v, 0.0) for row, v in variance.items()
            }
        else:
            stream = plain_lives(name, stream, moving(came_s))
            convert = {"imu": plain_imu, "steering": plain_steering, "odometry": plain_camera}[name]
            signals = convert(stream, robot)
        if name == "imu":
            imu_s, accel_z = time_s, plain_vertical(stream, time_s, robot, signals)
        if name == "odometry":
            for row in feed.CAMERA_ROWS[:2]:
                frozen = plain_frozen(signals[row], feed.REPEATED[feed.FIRST_SPEED], moving(came_s))
                signals[row] = np.where(frozen, np.nan, signals[row])
            yaw = signals["camera_yaw_rad"]
            sums = plain_sums(time_s, yaw, *feed.SIGNALS["camera_yaw_rad"][1:])
            signals["camera_yaw_rad"] = np.where(np.isnan(yaw), np.nan, yaw - sums)
        found = {
            row: plain_jumps(
                time_s, v, *((np.inf, np.inf) if row == "camera_yaw_rad" else feed.SIGNALS[row][1:])
            )
            for row, v in signals.items()
        }
        jumps[name] = int(np.any(list(found.values()), axis=0).sum())
        for row, signal in signals.items():
            signal = np.where(found[row], np.nan, signal)
            table[row] = plain_on_clock(clock, time_s, came_s, signal, low_pass_s.get(row, tau_s))
    table = {row: table.get(row, np.full(clock.size, np.nan)) for row in rows}
    derived, square = plain_derived(clock, table, once, twice, imu_s, accel_z, robot)
    came_s = imu_s + (robot.sensors.imu_latency_s if causal else 0.0)
    known = np.isfinite(square)
    last = np.searchsorted(came_s[known], clock + feed.TICK_S, side="right") - 1
    derived["vibration_mps2"] = np.where(last >= 0, np.sqrt(square[known][np.maximum(last, 0)]), np.nan)
    table |= derived
    wheel_speed_mps = np.column_stack([table[row] for row in rows[:3]]) * robot.wheel_radius_m
    plain_yaw(table, clock, wheel_speed_mps, initial_yaw_rad, causal)
    return np.column_stack(list(table.values())), np.column_stack(list(gnss_variance.values())), jumps


def plain_wheels(clock, motor_radps, rates, robot):
    """Leave out the rate of a motor that repeats itself while another's changes."""
    moving, rates = np.zeros(clock.size, dtype=bool), np.array(rates)
    for _ in range(3):  # motion follows from the rates that are left, and is known one tick later
        counts = np.column_stack([plain_counts(column) for column in motor_radps.T])
        lively = (counts <= 2).any(axis=1)
        frozen = [plain_frozen(v, feed.REPEATED[feed.FIRST_WHEEL + 0], moving) for v in motor_radps.T]
        kept = np.where(np.column_stack(frozen) & lively[:, None], np.nan, rates)
        once, _, _ = plain_moving(clock, kept * robot.wheel_radius_m)
        moving = np.append(False, (np.abs(once[:-1]) > feed.MOVING_MPS).any(axis=1))
    return kept


def plain_lives(name, stream, moving):
    """Leave out the channels of an IMU or a camera that repeat themselves in motion."""
    most = {"imu": feed.REPEATED, "odometry": feed.REPEATED[feed.FIRST_CAMERA :]}.get(name)
    if most is None:
        return stream
    values = np.array(stream.values)
    for c in range(values.shape[1]):
        values[plain_frozen(values[:, c], most[c], moving), c] = np.nan
    return Stream(stream.time_s, values, stream.channels)


def plain_vertical(imu, time_s, robot, signals):
    """Return the vertical acceleration without gravity; where the attitude jumped, nothing by it is known."""
    sensors, roll, pitch = robot.sensors, imu.channel("roll_rad"), imu.channel("pitch_rad")
    jumped = np.zeros(len(roll), dtype=bool)
    for angle in (roll, pitch):
        sums = plain_sums(time_s, angle, 0.05, 3.0, feed.LATCHED, 0.02)
        jumped |= np.isfinite(angle) & (sums != 0.0)
    for row in ("accel_x_mps2", "accel_y_mps2"):
        signals[row] = np.where(jumped, np.nan, signals[row])
    force = (imu.channel("accel_z_mps2") - sensors.accel_bias_z_mps2) / sensors.accel_scale_z_ratio
    level = GRAVITY_MPS2 * np.cos(roll) * np.cos(pitch)
    return np.where(jumped, np.nan, force - level)


def with_faults(run, rng):
    """Return the run with missing values, spikes, stuck sensors, and stamps that go back."""
    streams = dict(run.streams)
    for name in ("wheels", "imu", "odometry", "steering"):
        time_s, values = streams[name].time_s.copy(), streams[name].values.copy()
        n = len(time_s)
        values[rng.integers(0, n, 20), rng.integers(0, values.shape[1], 20)] = np.nan
        values[rng.integers(0, n, 5)] += 1e3
        values[n // 3 : n // 3 + 40] = values[n // 3]
        time_s[n // 2 : n // 2 + 5] -= 0.5
        streams[name] = Stream(time_s, values, streams[name].channels)
    return replace(run, streams=streams)


def drive(kind):
    if kind == "late and lost camera":
        faults = Faults(camera_lost_s=((0.0, 1.5), (5.0, 7.0)), by_chance=False)
        return simulate_run(ROBOT, "grass", "straight", 5, duration_s=10.0, faults=faults)
    run = simulate_run(ROBOT, "clay", "arc", 4, duration_s=12.0, gnss=Gnss())
    return with_faults(run, np.random.default_rng(0)) if kind == "faults" else run


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize(
    ("kind", "robot"),
    [("sound", ROBOT), ("faults", ODD), ("late and lost camera", ODD), ("late and lost camera", ROBOT)],
)
def test_the_chain_gives_the_numbers_of_its_plain_form(kind, causal, robot):
    run = drive(kind)
    table = measurement_table(run, robot, causal=causal, initial_yaw_rad=0.7)
    z, gnss_variance, jumps = plain_table(run, robot, causal, 0.7)
    np.testing.assert_allclose(table.z, z, rtol=0, atol=1e-10)
    np.testing.assert_allclose(table.gnss_variance, gnss_variance, rtol=1e-12)
    assert {name: table.dropped.get(f"{name}: jump", 0) for name in jumps} == jumps
    assert (sum(jumps.values()) > 0) == (kind == "faults")
