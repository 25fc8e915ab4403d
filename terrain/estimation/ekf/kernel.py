"""The loop behind every filter: predict, judge, condition on, one row of measurements after the other.

Loops are written out and divisions unchecked: at these sizes the assignment of a slice costs as much as a
measurement.  The plain form is in the tests.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float64, int64, njit, types, void

from terrain.angles import wrapped
from terrain.estimation.ekf.arrays import FILTER_ARRAYS, FilterArrays
from terrain.estimation.ekf.steps import (
    LARGEST,
    LONGEST_GAP_S,
    WIDEST,
    anchor,
    blame,
    bridge,
    clear,
    condition_on,
    copy,
    fast,
    find_columns,
    forget,
    innovation,
    predict,
)
from terrain.records import ABSENT, GATED, REOPENED, USED, Array

_VECTOR, _MATRIX = float64[::1], float64[:, ::1]

PROPAGATE = void(_VECTOR, float64, _VECTOR, _VECTOR, _MATRIX)
"""Signature of ``propagate(x, dt, params, x_next, F)``."""

OBSERVE = void(_VECTOR, _VECTOR, _VECTOR, _MATRIX)
"""Signature of ``observe(x, params, z_hat, H)``."""

TIME, PENDING, AGE, LIKELIHOOD = range(4)
"""What is in the vector ``clock``: last stamp, stamp of a leap that is not believed yet, time since the speed
over ground was measured, log likelihood."""

HELD_S = 2.0
"""A sensor that the model holds is not reopened before this time."""

PER_ROW = ("time did not advance", "clock jump", "state numerical")
PER_SENSOR = ("gated", "not finite", "numerical")
"""What is counted: the former once, then the latter for each sensor."""

_NOT_ADVANCED, _JUMPED, _LOST = range(3)
_GATED, _NOT_FINITE, _NUMERICAL = range(3)
_N_PER_ROW, _N_PER_SENSOR = len(PER_ROW), len(PER_SENSOR)
_SKIP, _START, _STEP, _LEAP = range(4)  # what the clock says of a row
_UNSOUND = -1  # a use that is never reported


@njit(int64(float64, _VECTOR, float64), cache=True, error_model="numpy")
def follows(time_s: float, clock: Array, max_gap_s: float) -> int:
    """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken.

    A leap is believed where the stamp follows one that leapt before.
    """
    if not math.isfinite(time_s):
        return 0
    step_s = time_s - clock[TIME]
    if abs(step_s) > max_gap_s:
        since_leap_s = time_s - clock[PENDING]
        believed = since_leap_s > 0.0 and since_leap_s <= max_gap_s
        return (1 if step_s > 0.0 else -1) if believed else 0
    return 0 if step_s <= 0.0 else 1


@fast
def _read_stamp(time_s: float, clock: Array, max_gap_s: float, counts: Array) -> tuple[int, float]:
    """Say what the clock does, and move it."""
    dt = time_s - clock[TIME]
    leaps = abs(dt) > max_gap_s  # not the first, whose dt is NaN
    if follows(time_s, clock, max_gap_s) == 0:
        if leaps and np.isfinite(time_s):
            counts[_JUMPED] += 1
            clock[PENDING] = time_s
        else:
            counts[_NOT_ADVANCED] += 1
        return _SKIP, dt
    kind = _LEAP if leaps else (_START if np.isnan(dt) else _STEP)
    clock[TIME], clock[PENDING] = time_s, np.nan
    return kind, dt


@njit(
    void(FILTER_ARRAYS, types.FunctionType(PROPAGATE), types.FunctionType(OBSERVE)),
    cache=True,
    error_model="numpy",
)
def run(arrays: FilterArrays, propagate: Any, observe: Any) -> None:
    """Filter samples one by one: move the memory, and write the columns."""
    params, order, starts, is_reference, is_held, is_angle_row, is_angle_state, is_position, x0 = arrays.model
    p0, q, thresholds, reopen_after_s, max_gap_s = arrays.noise
    stamps, values, variances, walks, inputs = arrays.samples
    x, p, clock, rejected_s, counts = arrays.memory
    mean, cov, nis_out, dof_out, use_out, age_out, taken = arrays.columns
    d, m, n_sensors = x.size, order.size, starts.size - 1
    f, fp, f_cols, n_f_cols = (
        np.zeros((d, d)),
        np.zeros((d, d)),
        np.zeros((d, d), np.int64),
        np.zeros(d, np.int64),
    )
    h, h_cols, n_h_cols = np.zeros((m, d)), np.zeros((m, d), np.int64), np.zeros(m, np.int64)
    z_hat, nus, rows = np.zeros(m), np.zeros(m), np.zeros(m, np.int64)
    x_next, x_before, p_before, chosen = np.zeros(d), np.zeros(d), np.zeros((d, d)), np.zeros(d, np.bool_)
    dx, dx_before = np.zeros(d), np.zeros(d)
    g, gain, left, step = np.zeros(d), np.zeros(d), np.zeros(d), np.zeros(d)
    uses, squares, dofs = np.zeros(n_sensors, np.int64), np.zeros(n_sensors), np.zeros(n_sensors, np.int64)
    keep = mean.shape[0] > 0
    first_input = params.size - inputs.shape[1]

    for n in range(stamps.size):
        kind, dt = _read_stamp(stamps[n], clock, max_gap_s, counts)
        taken[n] = kind != _SKIP
        for k in range(n_sensors):
            uses[k], squares[k], dofs[k] = ABSENT, np.nan, 0

        if kind == _STEP:
            copy(p, x, p_before, x_before)
            at = n if inputs.shape[0] > 1 else 0
            for i in range(inputs.shape[1]):
                params[first_input + i] = inputs[at, i]
            predict(propagate, params, x, p, q, dt, x_next, f, fp, f_cols, n_f_cols)
            at = n if walks.shape[0] > 1 else 0
            n_bad = 0
            for i in range(d):
                p[i, i] += walks[at, i] * dt
                n_bad += not ((abs(x_next[i]) <= LARGEST) & (p[i, i] > 0.0) & (p[i, i] <= WIDEST))
                x[i] = x_next[i]
            if n_bad > 0:
                copy(p_before, x_before, p, x)
                forget(x, p, x0, p0, is_position, chosen)
                counts[_LOST] += 1
            clock[AGE] += dt
            for k in range(n_sensors):
                if rejected_s[k] >= 0.0:
                    rejected_s[k] += dt
        elif kind == _LEAP:
            gap_s = min(abs(dt), LONGEST_GAP_S)
            anchor(p, p0, ~is_position)
            copy(p, x, p_before, x_before)
            predict(propagate, params, x, p, q, gap_s, x_next, f, fp, f_cols, n_f_cols)
            bridge(p, p_before, is_position)
            clock[AGE] = clock[AGE] + dt if dt > 0.0 else np.inf  # set back: the age is unknown
            rejected_s[:] = -1.0

        if taken[n]:
            clear(h)
            observe(x, params, z_hat, h)
            dx[:] = 0.0
            at = n if variances.shape[0] > 1 else 0
            for k in range(n_sensors):
                n_rows = 0
                for c in range(starts[k], starts[k + 1]):
                    i = order[c]
                    z = values[n, i]
                    if np.isnan(z):
                        continue
                    if not (abs(z) <= LARGEST and variances[at, i] > 0.0 and variances[at, i] < np.inf):
                        counts[_N_PER_ROW + _N_PER_SENSOR * k + _NOT_FINITE] += 1
                        continue
                    nus[i] = wrapped(z - z_hat[i]) if is_angle_row[i] else z - z_hat[i]
                    n_h_cols[i] = find_columns(h, i, h_cols)
                    rows[n_rows] = i
                    n_rows += 1
                if n_rows == 0:
                    continue
                if n_rows > 1:  # one row alone is judged before anything changes
                    copy(p, dx, p_before, dx_before)
                use, threshold, square, likelihood = USED, thresholds[n_rows], np.nan, 0.0
                for attempt in range(2):
                    total, likelihood, sound, definite = 0.0, 0.0, True, True
                    for c in range(n_rows):
                        i = rows[c]
                        r = variances[at, i]
                        nu, spread = innovation(i, h, h_cols, n_h_cols, nus, dx, p, g)
                        s = spread + r
                        definite &= s > 0.5 * r
                        total += nu * nu / s
                        likelihood -= 0.5 * (math.log(2.0 * math.pi * s) + nu * nu / s)
                        if definite and (c < n_rows - 1 or total <= threshold):
                            sound &= condition_on(nu, spread, r, x, dx, p, g, gain, left, step)
                    if attempt == 0:
                        square = total
                    if total <= threshold and sound and definite:
                        break
                    if n_rows > 1 or attempt == 1:
                        copy(p_before, dx_before, p, dx)
                    if not definite:  # rounding has made P no covariance: go on without its correlations
                        chosen[:] = True
                        anchor(p, p0, chosen)
                    if total <= threshold or attempt == 1 or not definite:
                        use = _UNSOUND
                        break
                    rejected_s[k] = max(rejected_s[k], 0.0)
                    if rejected_s[k] < (max(reopen_after_s, HELD_S) if is_held[k] else reopen_after_s):
                        use = GATED
                        break
                    use, threshold = REOPENED, np.inf
                    copy(p, dx, p_before, dx_before)
                    blame(h, order, starts, k, uses, chosen)
                    anchor(p, p0, chosen)
                    worst = 0.0
                    for c in range(n_rows):
                        nu, spread = innovation(rows[c], h, h_cols, n_h_cols, nus, dx, p, g)
                        worst = max(worst, nu * nu / (spread + variances[at, rows[c]]))
                    if worst > thresholds[1]:  # more than the initial variance explains
                        for j in range(d):
                            if chosen[j]:
                                p[j, j] = min(worst * p[j, j], LARGEST**2)
                if use == _UNSOUND:
                    counts[_N_PER_ROW + _N_PER_SENSOR * k + _NUMERICAL] += 1
                    uses[k] = GATED
                    continue
                uses[k], squares[k], dofs[k] = use, square, n_rows
                if use == GATED:
                    counts[_N_PER_ROW + _N_PER_SENSOR * k + _GATED] += 1
                    continue
                rejected_s[k] = 0.0 if use == REOPENED else -1.0
                clock[LIKELIHOOD] += likelihood
                if is_reference[k]:
                    clock[AGE] = 0.0
            for i in range(d):
                x[i] += dx[i]
                if is_angle_state[i]:
                    x[i] = wrapped(x[i])
                for j in range(i):
                    p[j, i] = p[i, j]

        if keep:
            age_out[n] = clock[AGE]
            for k in range(n_sensors):
                nis_out[n, k], dof_out[n, k], use_out[n, k] = squares[k], dofs[k], uses[k]
            for i in range(d):
                mean[n, i] = x[i]
                for j in range(d):
                    cov[n, i, j] = p[i, j]
