"""How small an effect could be and still be seen: detection limits by the Cramer-Rao bound of the drives.

The *limit* of an effect is the amplitude that a test at the size corrected for the library would find nine
times in ten, with everything that varies from run to run left free.  It comes from sensitivities of the true
motion and from spectra of the simulated noise, not from anything that the diagnosis computes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from studies.blind_trials.drives import STEP_HZ, Drives
from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.search import RIVAL_LOSS
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    INDEX,
    LIBRARY,
    ONE_SIDED,
    SENSED_ONLY,
    SPEED_X,
    SPEED_Y,
    STEPS,
    TURNING_CURRENT,
    Effect,
    library_of,
    nuisances_of,
    parameters_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.kinematics.wheels import velocity_matrix
from terrain.records import Array, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot
from terrain.simulation.plants.planar import (
    CAMERA_HZ,
    IMU_HZ,
    WHEELS_HZ,
    Ground,
    Planar,
    activity,
    current_noise_a,
    make_planar,
    move,
    sense,
    spread_numbers,
    with_silent_parts,
)
from terrain.simulation.run import simulate

TEST_SIZE = 0.02  #: Size of the test over the whole library, to which limits refer
POWER = 0.9  #: Rate at which an effect at its limit is detected

CONFUSABLE = 0.99
"""Two effects whose sensitivities correlate more than that, nuisances taken out, are of one class: a
collinearity index of 10."""
TURNING_MPS = 0.05  #: Slower wheels do not count as turning
UNSEEN = 1e-9
"""Information in a parameter's unit below which drives show nothing of it: its standard deviation, 3e4, is
far beyond every bound."""
WHEEL_SPEED, GRADE, ROLL = "wheel_speed_mps", "grade_rad", "roll_rad"
"""What a replay is fed with, beside the channels that are compared."""


class Sensing(NamedTuple):
    """What the logs of a trial hold, all that the planar simulation measures by default."""

    channels: tuple[str, ...] = ()  #: that are logged; without any those of the planar simulation
    cutoff_hz: float = 0.4 * STEP_HZ  #: above which the log holds nothing
    scatter: Mapping[str, float] | None = None  #: of the runs; that of the package by default
    tilt: bool = True  #: whether a tilt is logged; without one the simulation takes the ground as level


class Limits(NamedTuple):
    """Information (k, k) of the drives of a trial on parameters, of all runs, nuisances free."""

    names: tuple[str, ...]
    information: Array

    def part(self, one: Effect, other: Effect) -> Array:
        """Return the information between the parameters of two effects, which may be the same."""
        rows, columns = ([self.names.index(p.name) for p in effect.parameters] for effect in (one, other))
        return self.information[np.ix_(rows, columns)]

    def of(self, effect: Effect, direction: Array | None = None) -> float:
        """Return the smallest detectable amplitude, along a direction (p,) or the first parameter."""
        own = self.part(effect, effect)
        along = np.eye(len(own))[0] if direction is None else direction
        size = float(along @ own @ along)
        desired = norm.isf(TEST_SIZE / 2 / self.library_size) + norm.ppf(POWER)
        return float(desired / math.sqrt(size)) if size > 0 else math.inf

    @property
    def library_size(self) -> int:
        """How many effects are tested."""
        return sum(all(p.name in self.names for p in effect.parameters) for effect in LIBRARY)

    def free(self, *names: str) -> Limits:
        """Return the information on all other parameters while some are not known."""
        out = [self.names.index(name) for name in names]
        left = [i for i in range(len(self.names)) if i not in out]
        cross = self.information[np.ix_(left, out)]
        inner = self.information[np.ix_(out, out)]
        rest = self.information[np.ix_(left, left)] - cross @ np.linalg.solve(inner, cross.T)
        return Limits(tuple(self.names[i] for i in left), rest)

    def alike(self, one: Effect, other: Effect) -> bool:
        """Return whether two effects are of one confusable class."""
        own, its, cross = self.part(one, one), self.part(other, other), self.part(one, other)
        unseen = [bool(np.diag(information).min() <= UNSEEN) for information in (own, its)]
        if any(unseen):
            return all(unseen)
        # the largest cosine between a change of the one and a change of the other
        return _largest_cosine(np.linalg.solve(own, cross) @ np.linalg.solve(its, cross.T)) > CONFUSABLE

    def in_place_of(self, effect: Effect, values: Mapping[str, float], other: Effect) -> bool:
        """Return whether another effect explains values of one so well that an answer has to state both.

        So it is where minus twice the log-likelihood of its best fit is worse by less than ``RIVAL_LOSS``.
        """
        hidden = np.array([values[p.name] for p in effect.parameters])
        cross, its = self.part(other, effect) @ hidden, self.part(other, other)
        if np.diag(its).min() <= UNSEEN:
            return False
        own = hidden @ self.part(effect, effect) @ hidden
        return bool(own - cross @ np.linalg.solve(its, cross) < RIVAL_LOSS)

    def spanned(self, pair: tuple[Effect, Effect], other: Effect) -> bool:
        """Return whether two effects together look like another, which then takes the place of one of them.

        Equal latencies of IMU and camera are a clock offset: logs determine two of the three.
        """
        own = np.block([[self.part(row, column) for column in pair] for row in pair])
        its, cross = self.part(other, other), np.vstack([self.part(effect, other) for effect in pair])
        if min(np.diag(its).min(), np.diag(own).min()) <= UNSEEN:
            return False
        inverse = np.linalg.pinv(own, hermitian=True, rcond=1e-9)
        return _largest_cosine(np.linalg.solve(its, cross.T @ inverse @ cross)) > CONFUSABLE


def _largest_cosine(shared: Array) -> float:
    return math.sqrt(max(float(np.linalg.eigvals(shared).real.max()), 0.0))


def limits_of(robot: Robot, drives: Drives, sensing: Sensing | None = None) -> Limits:
    """Return the information of drives on each effect, by the Cramer-Rao bound.

    Examples
    --------
    >>> from studies.blind_trials.drives import rich_drives
    >>> from terrain.effects import effect_named
    >>> from terrain.robots import load_robot
    >>> drives = rich_drives(np.random.default_rng(0), 3, 20.0)
    >>> limits_of(load_robot("husky"), drives).of(effect_named("wheel_radius")) < 0.03
    True
    """
    sensing = sensing or Sensing()
    if not robot.describes("motors") and not sensing.channels:
        sensing = sensing._replace(channels=(GYRO, SPEED_X, SPEED_Y, ACCEL))  # no currents are logged
    robot = with_silent_parts(robot)
    planar, noise = make_planar(robot, Ground()), spread_numbers("noise")
    channels = sensing.channels or (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT)
    if robot.skids and not sensing.channels:
        channels = (*channels, TURNING_CURRENT)
    scatter = sensing.scatter or spread_numbers("scatter")
    n_names, nuisances = len(parameters_of(robot.drive)), nuisances_of(robot.drive)
    names = tuple(dict.fromkeys((*parameters_of(robot.drive), *nuisances)))
    free = [names.index(name) for name in nuisances]
    prior = np.diag(1.0 / np.array([scatter[names[i]] for i in free]) ** 2)
    total = np.zeros((n_names, n_names))
    for twist, hills in zip(drives.twists, drives.hills, strict=True):
        truth = simulate(robot, twist, Ground(), 0, conditions=hills).streams["truth"]
        # from the start of the log, of a length that its Fourier transform is quick with
        even = slice(2 * round(drives.lead_s * STEP_HZ), len(truth) // 100 * 100, 2)
        truth = Stream(truth.time_s[even], truth.values[even], truth.channels)
        rate_hz, n = truth.rate_hz, len(truth)
        wheel_speed, steer = (
            np.ascontiguousarray(np.column_stack([truth.channel(name.format(w)) for w in robot.wheels]))
            for name in ("wheel_{}_radps", "steer_{}_rad")
        )
        wheel_speed *= robot.wheel_radius_m
        grade, roll = (
            sensing.tilt * sign * truth.channel(f"{axis}_rad")
            for axis, sign in (("pitch", -1.0), ("roll", 1.0))
        )
        measured = np.ones((n, len(CHANNELS)))
        # the sum of currents measures traction only where wheels are parallel
        measured[np.abs(np.exp(1j * steer).mean(axis=1)) < 0.95, CHANNELS.index(CURRENT)] = 0.0
        frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
        used = frequency_hz < sensing.cutoff_hz
        f = frequency_hz[used]
        # the mean speed of the wheels while they turn; the least that counts if they do not
        speed = np.abs(wheel_speed).mean(axis=1)
        turning = speed[speed > TURNING_MPS]
        pace_mps = float(turning.mean()) if turning.size else TURNING_MPS
        plain = move(planar, vector_of({}), 1 / rate_hz, wheel_speed, steer, grade, roll, np.zeros((0, 3)))
        changes = []
        for name in names:
            step, both = STEPS[name], []
            for sign in (1.0, 0.0) if name in ONE_SIDED else (1.0, -1.0):
                p, moved = vector_of({name: sign * step}), plain
                if name not in SENSED_ONLY:
                    # a replay of measured wheels and tilt, linear in lag and offsets
                    lag = p[INDEX["encoder_lag_s"]]
                    speeds = (
                        wheel_speed + lag * np.gradient(wheel_speed, 1 / rate_hz, axis=0)
                        if lag
                        else wheel_speed
                    )
                    tilt = grade - p[INDEX["pitch_offset_rad"]], roll - p[INDEX["roll_offset_rad"]]
                    moved = move(planar, p, 1 / rate_hz, speeds, steer, *tilt, np.zeros((0, 3)))
                both.append(np.asarray(sense(planar.body, p, 1 / rate_hz, moved)))
            changes.append((both[0] - both[1]) / (step if name in ONE_SIDED else 2 * step) * measured)
        gram = np.zeros((len(names), len(names)))
        for channel in channels:
            waves = np.fft.rfft([change[:, CHANNELS.index(channel)] for change in changes])[:, used] / rate_hz
            density = _density(noise, robot, planar, channel, f, pace_mps)
            weighed = waves * (np.where(f > 0, 4.0, 2.0) / density * rate_hz / n)
            gram += np.real(weighed @ waves.conj().T)
        left = gram - gram[:, free] @ np.linalg.inv(gram[np.ix_(free, free)] + prior) @ gram[free]
        total += left[:n_names, :n_names]
    return Limits(names[:n_names], total)


def _density(
    noise: Mapping[str, float], robot: Robot, planar: Planar, channel: str, f: Array, pace_mps: float
) -> Array:
    """Return the one-sided spectrum of measured minus replayed: noise of channel and wheels."""
    own = noise_psd(noise, robot, planar, channel, f, pace_mps)
    wheel_speed = noise_psd(noise, robot, planar, WHEEL_SPEED, f, pace_mps)
    lag_s = robot.completed.sensors.encoder_time_constant_s
    wheel_speed = wheel_speed * (1.0 + (2 * math.pi * f * lag_s) ** 2)  # the lag is undone
    body, n = planar.body[0], 1 if isinstance(robot, BicycleRobot) else len(robot.wheels)
    mean, rate = wheel_speed / n, (2 * math.pi * f) ** 2
    if channel in (GYRO, HEADING):
        turn = (
            2.0 / robot.track_m**2
            if robot.skids
            else np.sum(np.linalg.pinv(velocity_matrix(robot.wheel_positions_m))[2] ** 2) / 2
        )
        return own + wheel_speed * turn
    if channel == SPEED_X:
        return own + mean
    if channel == ACCEL:
        return own + mean * rate
    if channel == CURRENT:
        return own + mean * rate * (body["mass_kg"] * body["radius_m"] / body["nm_per_a"]) ** 2
    return own


def confusable_class(limits: Limits, effect: Effect, drive: str) -> set[str]:
    """Return the name of an effect, and of all that no log of these drives distinguishes from it."""
    return {other.name for other in library_of(drive) if other is effect or limits.alike(effect, other)}


# -- Spectra of the noise in each channel of a log of the planar simulation --------------------------------
# Spectra are one-sided: their integral from 0 to the Nyquist frequency is the variance.  Steps of an encoder
# count as white noise of its position, which they are once speeds change.


def coloured_psd(frequency_hz: Array, std: float, tau_s: float, rate_hz: float) -> Array:
    """Return the one-sided density of :func:`coloured` noise at a rate, unit^2/Hz.

    Examples
    --------
    >>> f = np.arange(0.005, 25.0, 0.01)
    >>> round(float(coloured_psd(f, 0.3, 0.2, 50.0).sum() * 0.01), 4)
    0.09
    """
    keep = math.exp(-1.0 / (rate_hz * tau_s))
    turned = 1.0 - 2.0 * keep * np.cos(2.0 * math.pi * np.asarray(frequency_hz) / rate_hz) + keep**2
    return np.asarray(2.0 * std**2 / rate_hz * (1.0 - keep**2) / turned)


def white_psd(frequency_hz: Array, std: float, rate_hz: float) -> Array:
    """Return the one-sided density of white noise at a rate, unit^2/Hz."""
    return np.full(np.shape(frequency_hz), 2.0 * std**2 / rate_hz)


def lag_gain(frequency_hz: Array, time_constant_s: float, rate_hz: float) -> Array:
    """Return the squared gain of a low-pass that takes its samples as joined by straight lines."""
    if time_constant_s == 0.0:
        return np.ones(np.shape(frequency_hz))
    keep = math.exp(-1.0 / (rate_hz * time_constant_s))
    slope = time_constant_s * rate_hz * (1.0 - keep)
    now, before = 1.0 - slope, slope - keep  # weights of this sample and the one before
    back = np.exp(-2j * math.pi * np.asarray(frequency_hz) / rate_hz)
    return np.asarray(np.abs((now + before * back) / (1.0 - keep * back)) ** 2)


def noise_psd(
    noise: Mapping[str, float],
    robot: Robot,
    planar: Planar,
    channel: str,
    frequency_hz: Array,
    speed_mps: float,
) -> Array:
    """Return the one-sided density of the noise in a channel of a log at a steady speed, unit^2/Hz.

    Noise of the terrain counts in each channel in which it shows.  Noise of the wheels shows in a log of the
    wheels alone; a replay that takes a log of the wheels carries it into every channel, which the caller
    adds.

    Parameters
    ----------
    channel : one of ``effects.CHANNELS``, or ``wheel_speed_mps`` (of one wheel), ``grade_rad`` or ``roll_rad``
    frequency_hz : from 0 to the logger's Nyquist frequency: 25 Hz, of the IMU's channels 50 Hz
    speed_mps : of the wheels

    Raises
    ------
    ConfigError
        for another channel, or a robot without motors, camera or sensors.
    """
    f, pace_mps, body = np.asarray(frequency_hz, dtype=np.float64), abs(speed_mps), planar.body[0]
    moving = float(activity(speed_mps, noise))

    def shaking(name: str, unit: str, rate_hz: float) -> Array:
        """Return the density of what is drawn while the robot moves."""
        return coloured_psd(f, noise[f"{name}_{unit}"] * moving, noise[f"{name}_s"], rate_hz)

    def along(f: Array) -> Array:
        """Return the density of the speed ahead, at the IMU's rate."""
        slip_ratio = body["soft_ratio"][0]
        lag = pace_mps * slip_ratio / GRAVITY_MPS2
        terrain = coloured_psd(f, noise["along_ratio"] * pace_mps, noise["along_s"], IMU_HZ)
        if not isinstance(robot, SwerveRobot):
            return terrain * lag_gain(f, lag, IMU_HZ)
        w = 2.0 * math.pi * f  # a contact with a relaxation length swings
        sprung = w**2 * robot.completed.body.relaxation_length_m * slip_ratio / GRAVITY_MPS2
        return np.asarray(terrain / ((1.0 - sprung) ** 2 + (w * lag) ** 2))

    def along_rate(f: Array) -> Array:
        """Return the density of its rate by differences as the simulation takes them, at the IMU's rate."""
        angle = 2.0 * math.pi * f / IMU_HZ
        return along(f) * ((8.0 * np.sin(angle) - np.sin(2.0 * angle)) / 6.0 * IMU_HZ) ** 2

    def folded(density: Callable[[Array], Array]) -> Array:
        """Return the density of every second sample of a signal at the IMU's rate."""
        return density(f) + density(IMU_HZ / 2.0 - f)

    if channel == GYRO:
        drawn = shaking("yaw", "radps", IMU_HZ) + shaking("gyro", "radps", IMU_HZ)
        return drawn + white_psd(f, robot.sensors.gyro_std_radps, IMU_HZ)
    if channel == HEADING:
        angle = white_psd(f, noise["heading_rad"], CAMERA_HZ)
        rate = angle * (np.sin(2.0 * math.pi * f / CAMERA_HZ) * CAMERA_HZ) ** 2
        return np.asarray(rate + shaking("yaw", "radps", CAMERA_HZ))
    if channel in (SPEED_X, SPEED_Y):
        seen = shaking("camera", "mps", CAMERA_HZ) + white_psd(f, robot.camera.speed_std_mps, CAMERA_HZ)
        turning = shaking("yaw", "radps", CAMERA_HZ)
        if channel == SPEED_X:
            return seen + folded(along) + turning * body["lever_y_m"] ** 2
        sideways = coloured_psd(f, noise["across_ratio"] * pace_mps, noise["across_s"], CAMERA_HZ)
        return seen + sideways + turning * body["lever_x_m"] ** 2
    if channel == ACCEL:
        drawn = shaking("accel", "mps2", IMU_HZ) + along_rate(f)
        return drawn + white_psd(f, robot.sensors.accel_std_mps2, IMU_HZ)
    if channel in (CURRENT, TURNING_CURRENT):
        drawn = coloured_psd(f, current_noise_a(noise, robot) * moving, noise["current_s"], WHEELS_HZ)
        drawn = drawn + white_psd(f, robot.sensors.current_std_a * math.sqrt(len(robot.wheels)), WHEELS_HZ)
        amps_per_accel = body["mass_kg"] * body["radius_m"] / body["nm_per_a"]
        return drawn if channel == TURNING_CURRENT else drawn + amps_per_accel**2 * folded(along_rate)
    if channel == WHEEL_SPEED:
        motors, sensors = robot.motors, robot.sensors
        turns = sensors.hall_steps_ratio * motors.reduction_ratio
        step_m = 2.0 * math.pi * robot.wheel_radius_m / turns if turns > 0.0 else 0.0
        std_m = math.hypot(noise["encoder_m"] * moving, step_m / math.sqrt(12.0))
        rate = white_psd(f, std_m, WHEELS_HZ) * (2.0 * np.sin(math.pi * f / WHEELS_HZ) * WHEELS_HZ) ** 2
        rate = rate * lag_gain(f, sensors.encoder_time_constant_s, WHEELS_HZ)
        white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
        return np.asarray(rate + white_psd(f, white_mps, WHEELS_HZ))
    if channel in (GRADE, ROLL):
        return white_psd(f, noise["tilt_rad"], IMU_HZ)
    raise ConfigError(f"noise of channel {channel!r} is not known")
