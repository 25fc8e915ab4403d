r"""Motion of a tracked robot: balance of forces with inertia, stepped implicitly.

.. math:: M (V^+ - V)/h + M\,(-w V_y,\; w V_x,\; 0) = F(V^+),

F being the forces of :mod:`~terrain.simulation.tracked.contact`.  They change with the slip over the belt's
speed, within a millimetre of travel, which no explicit step of a hundredth of a second follows; the implicit
one is solved by Newton's method with a numerical Jacobian, halved where the residual grows, and stands still
on a slope without inertia of its own.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.records import Array
from terrain.simulation.tracked.contact import (
    HALF,
    INERTIA,
    LENGTH,
    MASS,
    sinkage_of,
    track_forces,
    track_loads,
)
from terrain.simulation.tracked.given_slip import slipped_twist
from terrain.simulation.tracked.slope import tilt_at

STEP_S = 0.01
"""From step to step; no sensor is sampled faster."""

ITERATIONS, HALVINGS, TOLERANCE = 60, 40, 1e-8
"""Newton steps, halvings of each, and the residual over the weight at which the balance is reached."""

NUDGE = 1e-7
"""Change of a speed, in m/s, over which the Jacobian is taken."""

STATE_SIZE = 8
X, Y, YAW, VX, VY, W, HEAP, TRAVELLED = range(STATE_SIZE)
"""Places in the state: pose in the plane of the slope, twist, heap beside the inner track, distance."""


@njit(cache=True)
def twist_on_soil(
    contact: Array, state: Array, belt_mps: Array, grade_rad: float, roll_rad: float, dt_s: float
) -> Array:
    """Return the twist (3,) after a step on a soil.

    Parameters
    ----------
    contact : numbers of :func:`~terrain.simulation.tracked.contact.contact_array`
    state : (STATE_SIZE,) before the step
    belt_mps : (2,) speeds of the belts
    grade_rad, roll_rad : of the body
    dt_s : step
    """
    mass = np.array([contact[MASS], contact[MASS], contact[INERTIA]])
    size = np.array([contact[MASS], contact[MASS], contact[MASS] * contact[HALF]])
    before = state[VX : W + 1]
    twist, residual = before.copy(), np.empty(3)
    error = _residual(
        contact, belt_mps, twist, before, mass, size, grade_rad, roll_rad, state, dt_s, residual
    )
    jacobian, moved, changed = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(ITERATIONS):
        if error < TOLERANCE:
            break
        for j in range(3):
            moved[:] = twist
            moved[j] += NUDGE
            _residual(contact, belt_mps, moved, before, mass, size, grade_rad, roll_rad, state, dt_s, changed)
            for i in range(3):
                jacobian[i, j] = (changed[i] - residual[i]) / NUDGE
        newton = np.linalg.solve(jacobian, residual)
        part, improved = 1.0, False
        for _ in range(HALVINGS):
            for i in range(3):
                moved[i] = twist[i] - part * newton[i]
            tried = _residual(
                contact, belt_mps, moved, before, mass, size, grade_rad, roll_rad, state, dt_s, changed
            )
            if tried < error:
                improved = True
                break
            part *= 0.5
        if not improved:
            break
        twist[:], residual[:], error = moved, changed, tried
    return twist


@njit(cache=True)
def _residual(
    contact: Array,
    belt_mps: Array,
    twist: Array,
    before: Array,
    mass: Array,
    size: Array,
    grade_rad: float,
    roll_rad: float,
    state: Array,
    dt_s: float,
    out: Array,
) -> float:
    """Write what is missing to the balance, over the mass, and return its size in m/s^2."""
    track_forces(contact, belt_mps, twist, grade_rad, roll_rad, state[HEAP], out)
    turning = (-twist[2] * twist[1], twist[2] * twist[0], 0.0)
    total = 0.0
    for i in range(3):
        out[i] = (mass[i] * ((twist[i] - before[i]) / dt_s + turning[i]) - out[i]) / size[i]
        total += out[i] * out[i]
    return math.sqrt(total)


@njit(cache=True)
def advance(
    grounds: Array,
    given: Array,
    until_m: Array,
    half_track_m: float,
    slope: Array,
    state: Array,
    belt_mps: Array,
    dt_s: float,
) -> Array:
    """Return the state (STATE_SIZE,) a step later.

    Parameters
    ----------
    grounds : (k, CONTACT_SIZE) numbers of the robot on each ground; a mass of 0 where slip is given
    given : (k, 7) numbers of each :class:`~terrain.simulation.tracked.given_slip.GivenSlip`
    until_m : (k,) distance travelled at which each ground ends
    half_track_m : d
    slope : (2,) its angle and the heading of uphill
    state : (STATE_SIZE,)
    belt_mps : (2,) speeds of the belts at the end of the step
    dt_s : step
    """
    after = state.copy()
    which = ground_at(until_m, state[TRAVELLED])
    contact = grounds[which]
    grade, roll = tilt_at(slope[0], slope[1], state[YAW])
    if contact[MASS] > 0.0:
        after[VX : W + 1] = twist_on_soil(contact, state, belt_mps, grade, roll, dt_s)
        load = min(track_loads(contact, grade, roll)[:2])
        swept = sinkage_of(contact, load) * abs(after[W]) * contact[LENGTH] / 4.0
        left_behind = abs(after[VX]) / contact[LENGTH]
        after[HEAP] = (state[HEAP] + dt_s * swept) / (1.0 + dt_s * left_behind)
    else:
        after[VX], after[VY], after[W] = slipped_twist(
            given[which], half_track_m, belt_mps[0], belt_mps[1], grade, roll
        )
    turned = 0.5 * dt_s * (state[W] + after[W])
    middle = state[YAW] + 0.5 * turned
    x, y = 0.5 * (state[VX] + after[VX]), 0.5 * (state[VY] + after[VY])
    after[X] += dt_s * (x * math.cos(middle) - y * math.sin(middle))
    after[Y] += dt_s * (x * math.sin(middle) + y * math.cos(middle))
    after[YAW] += turned
    after[TRAVELLED] += dt_s * math.hypot(x, y)
    return after


@njit(cache=True)
def ground_at(until_m: Array, travelled_m: float) -> int:
    """Return which ground a robot is on; the last one goes on for ever."""
    for k in range(until_m.shape[0] - 1):
        if travelled_m < until_m[k]:
            return k
    return int(until_m.shape[0]) - 1


@njit(cache=True)
def drive(
    grounds: Array,
    given: Array,
    until_m: Array,
    half_track_m: float,
    slope: Array,
    start: Array,
    belt_mps: Array,
    dt_s: float,
) -> Array:
    """Return the states (n, STATE_SIZE) of a drive; arguments are those of :func:`advance`.

    Parameters
    ----------
    start : (STATE_SIZE,) at the first row
    belt_mps : (n, 2)
    """
    n = belt_mps.shape[0]
    out = np.empty((n, STATE_SIZE))
    out[0] = start
    for k in range(1, n):
        out[k] = advance(grounds, given, until_m, half_track_m, slope, out[k - 1], belt_mps[k], dt_s)
    return out
