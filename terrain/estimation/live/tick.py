"""One tick of a live estimator, compiled as one: queues, rows, noise, filter, health, slip, and memory.

Each part is a kernel of its own module; here they follow each other without the interpreter, which takes
longer to hand over their arrays than they take to compute.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, njit, types
from numba.experimental import structref

from terrain.entry_point import entry_point
from terrain.estimation.ekf.arrays import FILTER_ARRAYS, FilterArrays, Memory
from terrain.estimation.ekf.kernel import AGE, OBSERVE, PROPAGATE, follows, run
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.filters.swerve_noise import SCHEDULE_ARRAYS, ScheduleArrays, schedule_tick
from terrain.estimation.live.history import KeptMemory
from terrain.estimation.live.monitor import HEALTH_ARRAYS, HealthArrays, judge_tick
from terrain.estimation.live.rows import ROW_ARRAYS, RowArrays, rows_at
from terrain.estimation.wheel_slip import STALE_AFTER_S, instant_slip, wheel_speed_scatter_mps
from terrain.records import Array
from terrain.robots import Robot

_V, _M, _I = float64[::1], float64[:, ::1], int64[::1]


class TickPlaces(NamedTuple):
    """Where a tick takes its numbers from, and what it computes slip with.

    Parameters
    ----------
    motors, currents : (3,) columns of the wheels' sample, of currents -1 for none
    motion : (5,) speeds, yaw rate and accelerations among the states
    rows, gnss : places of the filter's rows among all, and of the positions' among the filter's
    ends : where each part of :class:`TickOutput` begins, and the last ends
    slip_states : as of :func:`~terrain.estimation.wheel_slip.instant_slip`
    positions_m : (3, 2) of the wheels
    wheel_speed_variance : of a measured wheel speed
    reduction_ratio, radius_m : of motors and wheels
    """

    motors: Array
    currents: Array
    motion: Array
    rows: Array
    gnss: Array
    ends: Array
    slip_states: Array
    positions_m: Array
    wheel_speed_variance: float
    reduction_ratio: float
    radius_m: float


class TickOutput(NamedTuple):
    """What a tick writes, as views of one array; as of ``LiveEstimate``."""

    mean: Array
    std: Array
    slip_ratio: Array
    slip_std: Array
    rows: Array
    motor_radps: Array
    current_a: Array
    wheel_speed_mps: Array
    motion_and_age: Array


@structref.register
class _TickMemoryType(types.StructRef):
    """Type of :class:`TickMemory`."""


class TickMemory(structref.StructRefProxy):
    """All that a tick moves, handed over to compiled code once: each array anew takes longer than a tick.

    Parameters
    ----------
    propagate, observe : of the filter
    places, rows, noise, resident, judged, kept : groups of arrays
    """


_FIELDS = ("propagate", "observe", "places", "rows", "noise", "resident", "judged", "kept")
structref.define_boxing(_TickMemoryType, TickMemory)
structref.define_attributes(_TickMemoryType)


def slip_places(robot: Robot, states: tuple[str, ...]) -> tuple[Array, Array, float]:
    """Return ``slip_states``, ``positions_m`` and ``wheel_speed_variance`` of :class:`TickPlaces`."""
    named = (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        *(f"steer_{i}_rad" for i in robot.wheels),
        *(f"slip_speed_{i}_mps" for i in robot.wheels),
    )
    places = np.array([states.index(state) if state in states else -1 for state in named])
    return places, np.array(robot.wheel_positions_m), wheel_speed_scatter_mps(robot) ** 2


_TYPES = (
    types.FunctionType(PROPAGATE),
    types.FunctionType(OBSERVE),
    types.NamedTuple((*[_I] * 7, _M, float64, float64, float64), TickPlaces),
    ROW_ARRAYS,
    SCHEDULE_ARRAYS,
    FILTER_ARRAYS,
    HEALTH_ARRAYS,
    types.NamedTuple(tuple(types.UniTuple(kind, 3) for kind in (_V, _M, _I, int64[:, ::1])), KeptMemory),
)
_MEMORY = _TickMemoryType(tuple(zip(_FIELDS, _TYPES, strict=True)))


@njit(_MEMORY(*_TYPES), cache=True)
def tick_memory(
    propagate: Any,
    observe: Any,
    places: TickPlaces,
    rows: RowArrays,
    noise: ScheduleArrays,
    resident: FilterArrays,
    judged: HealthArrays,
    kept: KeptMemory,
) -> TickMemory:
    """Return a :class:`TickMemory`."""
    memory: TickMemory = structref.new(_MEMORY)
    memory.propagate, memory.observe = propagate, observe
    memory.places, memory.rows, memory.noise = places, rows, noise
    memory.resident, memory.judged, memory.kept = resident, judged, kept
    return memory


@njit(cache=True, error_model="numpy")
def _write(wheels: Array, places: TickPlaces, rows: RowArrays, memory: Memory, written: Array) -> None:
    """Write state, slip and what was measured, as :class:`TickOutput`."""
    e, x, p = places.ends, memory.x, memory.p
    out = TickOutput(
        written[e[0] : e[1]],
        written[e[1] : e[2]],
        written[e[2] : e[3]],
        written[e[3] : e[4]],
        written[e[4] : e[5]],
        written[e[5] : e[6]],
        written[e[6] : e[7]],
        written[e[7] : e[8]],
        written[e[8] : e[9]],
    )
    for i in range(out.mean.size):
        out.mean[i], out.std[i] = x[i], math.sqrt(p[i, i])
    for i in range(out.rows.size):
        out.rows[i] = rows.z[i]
    measured, slip = np.empty(3), np.empty((2, 3))
    for i in range(3):
        out.motor_radps[i] = rows.motor_radps[i]
        out.current_a[i] = wheels[places.currents[i]] if places.currents[i] >= 0 else np.nan
        out.wheel_speed_mps[i] = rows.motor_radps[i] / places.reduction_ratio * places.radius_m
        measured[i] = rows.z[i] * places.radius_m
    age_s = memory.clock[AGE]
    for i in range(5):
        out.motion_and_age[i] = x[places.motion[i]]
    out.motion_and_age[5] = age_s
    slip[:] = np.nan
    if not math.isinf(age_s) and (age_s <= STALE_AFTER_S or places.slip_states[-1] >= 0):
        instant_slip(
            x,
            p,
            places.positions_m,
            places.slip_states,
            measured,
            places.wheel_speed_variance,
            slip,
        )
    for i in range(3):
        known = not rows.unmeasured[i]
        out.slip_ratio[i] = slip[0, i] if known else np.nan
        out.slip_std[i] = slip[1, i] if known else np.nan


@njit(
    int64(_MEMORY, float64, types.Array(float64, 1, "A", readonly=True), int64, _V),
    cache=True,
    error_model="numpy",
)
def tick(memory: TickMemory, time_s: float, wheels: Array, slot: int, written: Array) -> int:
    """Take a sample of the wheels and all that is due by it; return 0 where its stamp is not taken.

    Else 1, or -1 where the clock was set back; the output is written, and the memory kept in ``slot``.
    """
    places, rows, noise = memory.places, memory.rows, memory.noise
    resident, kept = memory.resident, memory.kept
    sample, moved = resident.samples, resident.memory
    sample.stamps[0] = time_s
    taken: int = follows(time_s, moved.clock, resident.noise.max_gap_s)
    if taken == 0:
        run(resident, memory.propagate, memory.observe)  # for it to count, and to remember a leap
        return taken
    z = rows.z
    for i in range(3):
        rows.motor_radps[i] = wheels[places.motors[i]]
    rows_at(time_s, taken < 0, rows)
    for i in range(places.gnss.size):
        noise.variance[places.gnss[i]] = rows.gnss_variance[i]
    sample.variances[0, :] = noise.variance
    if noise.slips.size:
        schedule_tick(z, noise, sample.variances[0], sample.walks[0], sample.inputs[0])
    for i in range(places.rows.size):
        sample.values[0, i] = z[places.rows[i]]
    run(resident, memory.propagate, memory.observe)
    judge_tick(time_s, wheels, rows.motor_radps, z, moved.x, resident.columns.use[0], memory.judged)
    for k in range(3):
        kept.kept_floats[k][slot, :] = kept.floats[k]
        kept.kept_counts[k][slot, :] = kept.counts[k]
    _write(wheels, places, rows, moved, written)
    return taken


def bound_tick(resident: ResidentFilter, *arrays: Any) -> Callable[..., int]:
    """Return :func:`tick` for a filter and for the groups of arrays of :class:`TickMemory`.

    The result takes a stamp, a sample of the wheels, a slot and an array for the output.
    """
    return partial(entry_point(tick), tick_memory(*resident.functions, *arrays))


def output_ends(n_states: int, n_rows: int) -> Array:
    """Return ``ends`` of :class:`TickPlaces`."""
    return np.cumsum((0, n_states, n_states, 3, 3, n_rows, 3, 3, 3, 6))
