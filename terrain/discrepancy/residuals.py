"""Measured against simulated, and the sensitivity to each parameter of the simulation, low-pass filtered.

Measurement, prediction and sensitivities pass the **same** low-pass: the prediction contains
the noise of a differentiated encoder, which otherwise looks like latency or mass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.signals import Signals
from terrain.effects import CHANNELS, INDEX, ONE_SIDED, SENSED_ONLY, STEPS
from terrain.errors import DataError
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot
from terrain.simulation.plants.planar import Planar, corrected_inputs, move, replay, sense

#: Cut-off of the common low-pass at the full clock; commands of a wheeled robot change within 2 Hz.
CUTOFF_HZ = 2.5
INPUT_CUTOFFS = 2.4  #: Cut-off of the inputs of the simulation, over that of the common low-pass.
#: Cut-off of the wheel speeds that serve as instruments of the sensitivities, over that of the common low-pass: see
#: :func:`rows_of`.
INSTRUMENT_CUTOFF_RATIO = 0.6

SAME_CLOCK = 0.05  #: Ratio by which the runs' clocks may differ: one window serves all of them.
CLOCKS_PER_CUTOFF = 10.0  #: Rate of the replay's clock over the cut-off of the common low-pass.
#: Rows a second over the cut-off: the low-pass is down by 50 dB at half the rate of the rows.
ROWS_PER_CUTOFF = 2.5
TAPS_PER_CUTOFF = 2.4  #: Half length of the low-pass times its cut-off.
MIN_KNOWN = 0.75  #: Ratio of the low-pass's weight that has to be known for a row, where a channel has holes.
#: Start and end of a run left out, beside those of the low-pass: the replay starts in steady motion.
SETTLE_S = 0.5
#: A shorter run may have its one change of command at its start, which is kept if it is in steady motion.
SHORT_S = 10.0
#: Steady motion: for so long no wheel's speed and no steering changes by more than that.
STEADY_S, STEADY_MPS, STEADY_RAD = 0.25, 0.05, 0.02


class LowPass(NamedTuple):
    """A symmetric window, and the rate of its output."""

    taps: Array  #: on the clock of the replay
    every: int  #: samples of that clock a row
    rate_hz: float  #: of the rows, and of the window
    cutoff_hz: float
    #: samples of the signals' clock a sample of the replay's; 0 where that clock is too slow for a window of its own
    #: in between
    inputs_every: int
    #: cut-off of the wheel speeds that serve as instruments of the sensitivities, see :func:`rows_of`; infinite for
    #: those of the prediction
    instrument_cutoff_hz: float


class Rows(NamedTuple):
    """A low-pass filtered run, row by row."""

    run_id: str  #: of the run
    terrain: str
    time_s: Array  #: (m,) from the start of the run
    measured: Array  #: (m, channels)
    predicted: Array
    sensitivity: Array  #: (parameters, m, channels) change of the prediction per change of each parameter
    inputs: Array  #: (m, len(INPUTS) - 1 + wheels) inputs of the simulation, for probes of the residual

    @property
    def residual(self) -> Array:
        """Measured minus predicted (m, channels)."""
        return self.measured - self.predicted

    @property
    def period_s(self) -> float:
        """From row to row; 0 where there is none."""
        return float(np.median(np.diff(self.time_s))) if self.time_s.size > 1 else 0.0

    @property
    def pace_mps(self) -> Array:
        """Speed (m,) of the wheels, straight ahead or against each other; of omni wheels in any direction."""
        speed = np.hypot(self.inputs[:, 0], self.inputs[:, INPUTS.index("sideways_mps")])
        return np.maximum(speed, 0.5 * np.abs(self.inputs[:, 1]))


#: Mean wheel speed, right minus left (last minus first) wheel speed, mean steering, tilt, traction over weight, 0,
#: and how far the wheels have turned: a column for each of them.  Of an omni robot speed, turn and sideways are those
#: that its wheels would roll ahead, in place (twice the speed of a wheel) and to the left; of a car-like robot turn
#: is the difference of its rear wheels.
INPUTS: tuple[str, ...] = (
    *("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad"),
    *("force_ratio", "sideways_mps", "wheel_phase_rad"),
)


def low_pass_of(signals: Sequence[Signals]) -> LowPass:
    """Return the low-pass of runs on one clock, which the slowest logger sets.

    Raises
    ------
    DataError
        if the runs' clocks differ by more than a twentieth.
    """
    slow, fast = max(signals, key=attrgetter("dt_s")), min(signals, key=attrgetter("dt_s"))
    rate_hz = 1 / slow.dt_s
    if 1 / fast.dt_s > (1 + SAME_CLOCK) * rate_hz:
        raise DataError(
            f"runs: {slow.run_id} is on a clock of {rate_hz:.3g} Hz, {fast.run_id} on one of "
            f"{1 / fast.dt_s:.3g} Hz; clocks within {SAME_CLOCK:.0%} of each other are required"
        )
    cutoff_hz = min(CUTOFF_HZ, rate_hz / 5.0)
    near = 1 + SAME_CLOCK  # a logger of 49.9 Hz is one of 50
    inputs_every = int(near * rate_hz / (CLOCKS_PER_CUTOFF * cutoff_hz))
    clock_hz = rate_hz / max(inputs_every, 1)
    every = max(int(near * clock_hz / (ROWS_PER_CUTOFF * cutoff_hz)), 1)
    of_rows = every, clock_hz / every, cutoff_hz
    return LowPass(_window(cutoff_hz, clock_hz), *of_rows, inputs_every, INSTRUMENT_CUTOFF_RATIO * cutoff_hz)


def _window(cutoff_hz: float, rate_hz: float) -> Array:
    half = math.ceil(TAPS_PER_CUTOFF / cutoff_hz / 2 * rate_hz)
    k = np.arange(-half, half + 1)
    taps = np.sinc(2 * cutoff_hz / rate_hz * k) * np.hamming(k.size)
    return np.asarray(taps / taps.sum())


def rows_of(
    signals: Signals, planar: Planar, vector: Array, parameters: Sequence[str], low_pass: LowPass
) -> Rows:
    """Return a low-pass filtered run, and the sensitivities to the parameters named, at a vector of them.

    The prediction contains the noise of its input, the wheel speeds, and so does the residual, with the
    opposite sign.  A sensitivity along the same wheel speeds contains it too, and where a robot hardly
    changes its motion the noise is most of it: residual and sensitivity are correlated by their noise, and
    a spurious acceleration looks like an error of the mass.  Sensitivities are therefore computed along
    low-pass filtered wheel speeds, as instruments: the noise of a differentiated encoder grows with
    frequency, the commands do not.
    """
    dt, wheel_speed, steer, grade, roll, measured = prepare_inputs(signals, low_pass)
    n_rows = max((len(wheel_speed) - low_pass.taps.size) // low_pass.every + 1, 0)
    first = slice(0, math.ceil(STEADY_S / dt) + 1)
    change_mps, change_rad = (np.ptp(values[first], axis=0).max() for values in (wheel_speed, steer))
    steady = change_mps <= STEADY_MPS and change_rad <= STEADY_RAD
    skip = math.ceil(SETTLE_S * low_pass.rate_hz)
    start = 0 if len(wheel_speed) * dt < SHORT_S and steady else skip
    kept = slice(start, max(n_rows - skip, start))

    known = np.isfinite(measured)
    holes = known[:, :0] if known[:, known.any(axis=0)].all() else known
    window = low_pass.taps, low_pass.every
    instruments = wheel_speed
    if math.isfinite(low_pass.instrument_cutoff_hz):
        instruments = _decimated(wheel_speed, _window(low_pass.instrument_cutoff_hz, 1.0 / dt), 1)
    true_wheel_speed, true_grade, true_roll = corrected_inputs(planar, vector, dt, instruments, grade, roll)
    truth = move(planar, vector, dt, true_wheel_speed, steer, true_grade, true_roll)

    def shown(point: Array, speeds: Array, only_sensed: bool) -> Array:
        """Return the low-pass filtered prediction (rows, channels); the motion stays where only sensors change."""
        seen = sense(planar, point, dt, truth) if only_sensed else replay(planar, point, dt, speeds, *inputs)
        return np.asarray(decimate(seen, holes, *window))[kept]

    inputs = steer, grade, roll
    now = shown(vector, wheel_speed, False)
    change = np.empty((len(parameters), *now.shape))
    for j, name in enumerate(parameters):
        i, (ahead, back) = INDEX[name], np.tile(vector, (2, 1))
        ahead[i] += STEPS[name]
        if name not in ONE_SIDED or vector[i] >= STEPS[name]:
            back[i] -= STEPS[name]
        here, there = (shown(point, instruments, name in SENSED_ONLY) for point in (ahead, back))
        change[j] = (here - there) / (ahead[i] - back[i])
    speed, turn, sideways = _rolled(planar, instruments, steer)
    force = truth["force_n"] / (GRAVITY_MPS2 * planar.robot.mass_kg)
    driven = np.column_stack([speed, turn, steer.mean(axis=1), grade, roll, force, sideways])
    phase = np.cumsum(instruments, axis=0) * (dt / planar.robot.wheel_radius_m)
    at = low_pass.taps.size // 2 + low_pass.every * np.arange(n_rows)[kept]
    shown = decimate(np.ascontiguousarray(measured), holes, *window)[kept]
    driven = np.column_stack([decimate(driven, known[:, :0], *window)[kept], phase[at]])
    return Rows(signals.run_id, signals.terrain, at * dt, shown, now, change, driven)


def _rolled(planar: Planar, wheel_speed: Array, steer: Array) -> tuple[Array, Array, Array]:
    """Return speed, turn and sideways speed (n,) of wheels, as :data:`INPUTS` has them."""
    speed, robot = wheel_speed.mean(axis=1), planar.robot
    if robot.on_omni_wheels:
        rollers = planar.params[0]
        ahead, left, turn = rollers["to_rolled"] @ wheel_speed.T
        return ahead, 2.0 * rollers["wheel_distance_m"] * turn, left
    if isinstance(robot, BicycleRobot):
        return speed, speed * np.tan(steer[:, 0]) * (robot.track_m / robot.wheelbase_m), 0.0 * speed
    return speed, wheel_speed[:, -1] - wheel_speed[:, 0], np.zeros_like(speed)


def _decimated(values: Array, taps: Array, every: int) -> Array:
    """Return columns behind a window, of the same length where none is left out, held at both ends."""
    half = taps.size // 2
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.asarray(decimate(padded, np.zeros((0, 0), dtype=np.bool_), taps, every))


def prepare_inputs(signals: Signals, low_pass: LowPass) -> tuple[float, Array, Array, Array, Array, Array]:
    """Return the clock's period, wheel speeds, steering, grade, roll and measurements without holes.

    Holes of the inputs are bridged, and measurements there are dropped.  Both pass a window far above the
    low-pass: nonlinearities of the simulation, as friction about rest, turn noise of the wheels into a bias.
    """
    tilt = signals.grade_rad, signals.roll_rad
    columns = np.column_stack([signals.wheel_speed_mps, signals.steer_rad, *tilt])
    measured = np.array(signals.measured)
    holes = ~np.isfinite(columns).all(axis=1)
    if holes.any():
        at = np.arange(len(columns))
        for column in columns.T:
            known = np.isfinite(column)
            column[:] = np.interp(at, at[known], column[known]) if known.any() else 0.0
        measured[holes] = np.nan
    if low_pass.inputs_every > 0:
        taps = _window(INPUT_CUTOFFS * low_pass.cutoff_hz, 1 / signals.dt_s)
        both = _decimated(np.column_stack([columns, measured]), taps, low_pass.inputs_every)
        columns, measured = both[:, : columns.shape[1]], both[:, columns.shape[1] :]
    wheels = signals.wheel_speed_mps.shape[1]
    parts = np.split(columns, [wheels, 2 * wheels, 2 * wheels + 1], axis=1)
    wheel_speed, steer, grade, roll = (np.ascontiguousarray(part) for part in parts)
    return signals.dt_s * max(low_pass.inputs_every, 1), wheel_speed, steer, grade[:, 0], roll[:, 0], measured


@njit
def decimate(values: Array, known: Array, taps: Array, every: int) -> Array:
    """Return columns (m, c) of ``values`` (n, c) filtered by a window and decimated; a NaN spreads.

    Where ``known`` (n, c) is not empty, it is the window's mean over what is known of each: the same samples have to
    be left out of whatever is compared.  Where less than :data:`MIN_KNOWN` of the window's weight is known, it is the
    mean over all: NaN, if there is one among them.
    """
    n, c = values.shape
    m = max((n - taps.size) // every + 1, 0)
    out = np.zeros((m, c))
    whole = np.abs(taps).sum()
    for row in range(m):
        start = row * every
        for t in range(taps.size):
            for j in range(c):
                out[row, j] += taps[t] * values[start + t, j]
        for j in range(known.shape[1]):
            total, weight, there = 0.0, 0.0, 0.0
            for t in range(taps.size):
                if known[start + t, j]:
                    total += taps[t] * values[start + t, j]
                    weight += taps[t]
                    there += abs(taps[t])
            if there >= MIN_KNOWN * whole:
                out[row, j] = total / weight
    return out


def measured_channels(rows: Sequence[Any]) -> tuple[str, ...]:
    """Return the channels that any run, with what it measured, has, in the order of ``CHANNELS``."""
    return tuple(
        name for c, name in enumerate(CHANNELS) if any(np.isfinite(run.measured[:, c]).any() for run in rows)
    )
