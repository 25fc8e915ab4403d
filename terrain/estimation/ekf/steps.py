"""The compiled parts of the filter step: predict, innovation, condition on, put a covariance back."""

from __future__ import annotations

from typing import Any

from numba import njit

from terrain.records import REOPENED, USED, Array

LARGEST = 1e9
"""No state or measurement of a ground robot in SI units comes near: what does is taken for garbage."""

LONGEST_GAP_S = 3600.0
"""After a longer gap a position is no less certain than after this one: that is nowhere already."""
WIDEST = LARGEST**4

fast = njit(cache=True, error_model="numpy", forceinline=True)


@fast
def clear(m: Array) -> None:
    """Write zeros into a matrix."""
    for i in range(m.shape[0]):
        for j in range(m.shape[1]):
            m[i, j] = 0.0


@fast
def copy(p: Array, x: Array, p_to: Array, x_to: Array) -> None:
    """Copy a covariance and a state."""
    for i in range(x.size):
        x_to[i] = x[i]
        for j in range(x.size):
            p_to[i, j] = p[i, j]


@fast
def find_columns(m: Array, i: int, cols: Array) -> int:
    """Write the columns in which row i of m is not zero; return how many."""
    n = 0
    for j in range(m.shape[1]):
        if m[i, j] != 0.0:
            cols[i, n] = j
            n += 1
    return n


@fast
def predict(
    propagate: Any,
    params: Array,
    x: Array,
    p: Array,
    q: Array,
    dt: float,
    x_next: Array,
    f: Array,
    fp: Array,
    cols: Array,
    n_cols: Array,
) -> None:
    """x_next = f(x, dt), and P <- F P F' + Q dt, symmetric to the last bit."""
    d = x.size
    clear(f)
    propagate(x, dt, params, x_next, f)
    for i in range(d):
        n_cols[i] = find_columns(f, i, cols)
        for k in range(d):
            fp[i, k] = 0.0
        for c in range(n_cols[i]):
            j = cols[i, c]
            weight = f[i, j]
            for k in range(d):
                fp[i, k] += weight * p[j, k]
    for i in range(d):
        for k in range(i + 1):
            total = q[i, k] * dt
            for c in range(n_cols[k]):
                j = cols[k, c]
                total += fp[i, j] * f[k, j]
            p[i, k] = total
            p[k, i] = total


@fast
def anchor(p: Array, p0: Array, chosen: Array) -> None:
    """Put the covariance of the chosen states back to P0, or leave it where it is wider; uncorrelated."""
    for i in range(p.shape[0]):
        if chosen[i]:
            variance = min(max(p[i, i], p0[i, i]), LARGEST**2)
            for j in range(p.shape[0]):
                p[i, j] = 0.0
                p[j, i] = 0.0
            p[i, i] = variance


@fast
def blame(h: Array, order: Array, starts: Array, k: int, uses: Array, chosen: Array) -> None:
    """Mark the states that the rejection of sensor k is put down to.

    Those that it alone observes; without any, those that no sensor used before it in this row observes;
    without any, all that it observes.
    """
    for spared in range(3):
        n_chosen = 0
        for j in range(chosen.size):
            chosen[j] = False
            for c in range(starts[k], starts[k + 1]):
                chosen[j] |= h[order[c], j] != 0.0
            for other in range(starts.size - 1):
                used = uses[other] == USED or uses[other] == REOPENED
                if other != k and (spared == 0 or (spared == 1 and used)):
                    for c in range(starts[other], starts[other + 1]):
                        chosen[j] &= h[order[c], j] == 0.0
            n_chosen += chosen[j]
        if n_chosen > 0:
            return


@fast
def forget(x: Array, p: Array, x0: Array, p0: Array, is_position: Array, chosen: Array) -> None:
    """Go back to what nothing is known of, but for positions that are still of this world."""
    for i in range(x.size):
        chosen[i] = not is_position[i] or p[i, i] > LARGEST**2
        if not is_position[i]:
            x[i] = x0[i]
    anchor(p, p0, chosen)


@fast
def bridge(p: Array, kept: Array, is_position: Array) -> None:
    """Take back all of a covariance that grew over a gap but that of the positions."""
    for i in range(is_position.size):
        for j in range(is_position.size):
            if not (is_position[i] and is_position[j]):
                p[i, j] = kept[i, j]


@fast
def innovation(
    i: int, h: Array, cols: Array, n_cols: Array, nus: Array, dx: Array, p: Array, g: Array
) -> tuple[float, float]:
    """Write g = P h' of row i; return its innovation after what was conditioned on before, and h P h'."""
    nu, spread = nus[i], 0.0
    for j in range(dx.size):
        g[j] = 0.0
    for c in range(n_cols[i]):
        column = cols[i, c]
        weight = h[i, column]
        nu -= weight * dx[column]
        for j in range(dx.size):
            g[j] += weight * p[column, j]
    for c in range(n_cols[i]):
        spread += h[i, cols[i, c]] * g[cols[i, c]]
    return nu, spread


@fast
def condition_on(
    nu: float,
    spread: float,
    r: float,
    x: Array,
    dx: Array,
    p: Array,
    g: Array,
    gain: Array,
    left: Array,
    step: Array,
) -> bool:
    """Condition dx and P on one row; return False, and leave them, where that leads out of this world.

    K = g / s with s = h P h' + R.  `left` is what the Joseph form has beyond P - K g', R K - (g - K h g):
    nothing but rounding, which saves R where it is lost in s beside a large h P h'.
    """
    d = dx.size
    per_s = 1.0 / (spread + r)
    n_bad = 0
    for i in range(d):
        k = g[i] * per_s
        rest = r * k - (g[i] - k * spread)
        moved = dx[i] + k * nu
        variance = (p[i, i] - k * g[i]) + rest * k
        gain[i], left[i], step[i] = k, rest, moved
        n_bad += not ((abs(x[i] + moved) <= LARGEST) & (variance > 0.0) & (variance <= WIDEST))
    if n_bad > 0:
        return False
    for i in range(d):
        dx[i] = step[i]
    for i in range(d):
        k, rest = gain[i], left[i]
        for j in range(d):
            p[i, j] = (p[i, j] - k * g[j]) + rest * gain[j]
    return True
