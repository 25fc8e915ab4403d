"""Unfit runs, which are excluded before causes are searched.

A run is unfit for a fault of its own: a channel that is missing or frozen, a clock offset of its own, wheels
that turn under a body at rest, or another robot or terrain than its log states.  What all runs have in common
is no fault of a run: it is what the diagnosis searches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from terrain.discrepancy.clocks import MAX_LAG_S, MIN_LAG_S, Shift, offsets_of, shifts_of
from terrain.discrepancy.evidence import PRIOR_STD, Evidence
from terrain.discrepancy.health.common import (
    FOLLOWS,
    STRETCH_S,
    common_gains,
    odd_runs,
    stalled_runs,
    stretches,
)
from terrain.discrepancy.health.response import MOTION, Response, gains_of, responses_of
from terrain.discrepancy.health.runs import Clock, Excluded
from terrain.discrepancy.latencies import Latencies
from terrain.discrepancy.signals import Signals
from terrain.effects import CHANNELS, CURRENT, INDEX, SPEED_X, SPEED_Y
from terrain.records import Array

CLOCK_S, CLOCK_SIGMAS, CLOCK_SCATTER_S = 0.12, 6.0, 0.01
"""A clock is a run's own if it is off by the first, and by so many times its error and the scatter of the
others, which is the third at the least."""

STILL_MPS, VARIES_MPS, MOVING_MPS = 0.002, 0.05, 0.2
"""Spread of a wheel speed that never changes, of one that does, and a speed at which no wheel rests."""

OFF_RATIO = 1.5
"""Of the gain of a run over that of the others, which one dead wheel of two makes 2 or 0: a wheel that never
changes is dead only beyond that, or where the body does not follow the wheels at all."""

MIN_FINITE_RATIO, USUAL_FINITE_RATIO = 0.3, 0.7
"""A channel is dead in a run that has some of it but less than the first, the others over the second."""

FROZEN_S, CLIPPED_S, CLIPPED_RATIO = 2.0, 1.0, 0.03
"""A channel is frozen if it is constant for the first at a time, and clipped if it is at its extreme for the
second in all and the third of a run, while the prediction varies."""

MARGIN_S = 0.6
"""Tolerance of the time at which a predicted change arrives."""

FROZEN_RANGE, CLIPPED_SPREAD = 0.5, 0.1
"""Of what is expected meanwhile: range and spread over its spread in the run."""

FAR_END = 0.5
"""The end of a range is so far out at the least, over the largest size: idle currents rest at the other."""

MIN_OTHERS = 3
"""Least number of other runs of its terrain that a run is compared with: of three runs two may be wrong."""

UNKNOWN_RATIO = 1e-6
"""Information over that of the prior, below which a parameter is not counted: fitting it costs nothing."""

UNLIKE_RATIO, UNLIKE_NOISE_RATIO = 12.0, 0.2
"""A run is an outlier if a simulation in common with the others costs it so many times what one in common
costs them among themselves, and so many variances of the noise a row.  Of 15 000 simulated runs without a
fault, whatever was hidden in all runs of a set, one passed both."""

_SPEEDS = [CHANNELS.index(SPEED_X), CHANNELS.index(SPEED_Y)]
_CURRENT = CHANNELS.index(CURRENT)


def unfit_runs(
    signals: Sequence[Signals],
    info: Evidence,
    shift: Shift | None = None,
    latencies: Latencies | None = None,
) -> tuple[Excluded, ...]:
    """Return the unfit runs, each with the first reason that is found.

    Parameters
    ----------
    signals : of all runs
    info : of these runs around the simulation as it is given, in the same order
    shift : of these runs, where it is known already
    latencies : of these runs, where they are known; short runs measure them only together

    Raises
    ------
    DataError
        if most runs' clocks are further apart than is searched.
    """
    shift = shifts_of(info) if shift is None else shift
    responses = responses_of(info.rows, latencies, shift)
    has_clock = [bool(np.isfinite(lag_s).any()) for lag_s in shift.lag_s]
    stalled = stalled_runs(responses, has_clock, MAX_LAG_S + MARGIN_S - STRETCH_S)
    reasons: dict[int, str] = {}
    for found in (_dead(signals, info, responses), _late(info, shift), stalled, _frozen(signals, info)):
        reasons = found | reasons
    for odd in (partial(odd_runs, responses), partial(_unlike, info)):
        reasons |= odd([i for i in range(len(signals)) if i not in reasons])
    return tuple(Excluded(signals[i].run_id, reasons[i]) for i in sorted(reasons))


def clocks_of(info: Evidence, shift: Shift | None = None) -> tuple[Clock, ...]:
    """Return how far IMU and camera are behind the wheels at the middle of each run, NaN where unknown."""
    offset_s, std_s = offsets_of(shifts_of(info) if shift is None else shift)
    built_in = info.vector[INDEX["clock_offset_s"]]
    return tuple(
        Clock(run.run_id, float(offset + built_in), float(std))
        for run, offset, std in zip(info.rows, offset_s, std_s, strict=True)
    )


def _dead(signals: Sequence[Signals], info: Evidence, responses: Sequence[Response]) -> dict[int, str]:
    """Return runs with a wheel or a channel of which hardly anything is there."""
    reasons: dict[int, str] = {}
    common = common_gains(responses)
    known_ratio = np.array([np.isfinite(run.measured).mean(axis=0) for run in signals])
    usual = np.median(known_ratio, axis=0)
    for i, run in enumerate(signals):
        dead = (known_ratio[i] > 0) & (known_ratio[i] < MIN_FINITE_RATIO) & (usual > USUAL_FINITE_RATIO)
        if run.steer_rad.any():
            dead[_CURRENT] = False  # it is compared only while the wheels are parallel
        for c in np.flatnonzero(dead):
            reasons[i] = f"its {CHANNELS[c]} is known in {known_ratio[i, c]:.0%} of its samples"
        known = np.isfinite(run.wheel_speed_mps).all(axis=1)
        if known.mean() < MIN_FINITE_RATIO:
            reasons[i] = f"its wheel speeds are known in {known.mean():.0%} of its samples"
            continue
        spread = run.wheel_speed_mps[known].std(axis=0)
        constant = spread.min() < STILL_MPS and spread.max() > VARIES_MPS
        if constant and _disagrees(responses[i], common):
            reasons[i] = f"its wheel {int(np.argmin(spread)) + 1} never turns faster or slower, the others do"
        elif np.abs(run.wheel_speed_mps[known]).max() < STILL_MPS:
            shown = info.rows[i].measured[:, _SPEEDS]
            if shown.size and np.nanmax(np.hypot(*np.nan_to_num(shown).T)) > MOVING_MPS:
                reasons[i] = "its wheels are at rest, its camera moves"
    return reasons


def _disagrees(response: Response, common: Array) -> bool:
    """Return whether the body does not move as the wheels make it move in the other runs.

    A wheel that is driven at a steady speed beside others that change is no dead one: the body follows them.
    """
    gain, correlation = gains_of(response)
    asked = [c for c in MOTION if correlation[c] != 0.0]
    off = np.abs(np.log(np.abs(gain[asked] / common[asked])))  # NaN, which is not over, where none is known
    return bool((correlation[asked] < FOLLOWS).any() or (off > math.log(OFF_RATIO)).any())


def _late(info: Evidence, shift: Shift) -> dict[int, str]:
    """Return runs with a clock of their own: all channels that measure it are off, and by the same lag."""
    offset_s = offsets_of(shift)[0] + info.vector[INDEX["clock_offset_s"]]
    reasons: dict[int, str] = {}
    for i in range(len(offset_s)):
        if shift.lost[i]:
            reasons[i] = f"its IMU and camera are not {MIN_LAG_S:g} to {MAX_LAG_S:g} s behind its wheels"
        others = np.arange(len(offset_s)) != i
        off, error = [], []
        for c in np.flatnonzero(np.isfinite(shift.lag_s[i])):
            lag_s = shift.lag_s[others & np.isfinite(shift.lag_s[:, c]), c]
            if lag_s.size < 2:
                continue
            middle_s = float(np.median(lag_s))
            scatter_s = max(1.48 * float(np.median(np.abs(lag_s - middle_s))), CLOCK_SCATTER_S)
            off.append(float(shift.lag_s[i, c]) - middle_s)
            error.append(math.hypot(float(shift.std_s[i, c]), scatter_s))
        own = all(abs(a) > max(CLOCK_S, CLOCK_SIGMAS * b) for a, b in zip(off, error, strict=True))
        if off and own and max(off) - min(off) < CLOCK_S + CLOCK_SIGMAS * max(error):
            own_s, usual_s = float(offset_s[i]), float(np.nanmedian(offset_s[others]))
            reasons[i] = (
                f"its IMU and camera are {_behind(own_s)} its wheels, {_behind(usual_s)} in the other runs"
            )
    return reasons


def _behind(offset_s: float) -> str:
    return f"{abs(offset_s):.2f} s {'behind' if offset_s >= 0 else 'ahead of'}"


def _frozen(signals: Sequence[Signals], info: Evidence) -> dict[int, str]:
    """Return runs with a channel that is constant, or clipped, while the prediction varies."""
    reasons: dict[int, str] = {}
    for i, (run, rows) in enumerate(zip(signals, info.rows, strict=True)):
        for c in np.flatnonzero(np.isfinite(run.measured).any(axis=0)):
            values, expected = run.measured[:, c], rows.predicted[:, c]
            spread = float(np.std(expected))
            if not spread > 0:
                continue
            for a, b in stretches(values[1:] == values[:-1]):
                start_s, end_s = a * run.dt_s, b * run.dt_s
                inside = (rows.time_s > start_s + MARGIN_S) & (rows.time_s < end_s - MARGIN_S)
                if end_s - start_s > FROZEN_S and np.ptp(expected[inside]) > FROZEN_RANGE * spread:
                    reasons[i] = (
                        f"its {CHANNELS[c]} is frozen for {end_s - start_s:.1f} s while it should change"
                    )
            for end in (np.nanmax(values), np.nanmin(values)):
                there = np.flatnonzero(values == end)
                if len(there) < max(CLIPPED_S / run.dt_s, CLIPPED_RATIO * len(values)):
                    continue
                if abs(end) < FAR_END * np.nanmax(np.abs(values)):  # a value at rest is no end of a range
                    continue
                if np.std(np.interp(there * run.dt_s, rows.time_s, expected)) > CLIPPED_SPREAD * spread:
                    reasons[i] = (
                        f"its {CHANNELS[c]} is clipped at {end:.3g} for {len(there) * run.dt_s:.1f} s"
                    )
    return reasons


def _unlike(info: Evidence, among: Sequence[int]) -> dict[int, str]:
    """Return runs that no simulation in common with those of the same terrain fits."""
    reasons: dict[int, str] = {}
    for terrain in dict.fromkeys(info.rows[i].terrain for i in among):
        left = [i for i in among if info.rows[i].terrain == terrain]
        most = (len(left) - 1) // MIN_OTHERS
        while most > 0 and (odd := _least_alike(info, left)) is not None:
            reasons[odd[0]] = odd[1]
            left.remove(odd[0])
            most -= 1
    return reasons


def _least_alike(info: Evidence, left: Sequence[int]) -> tuple[int, str] | None:
    """Return the run that is least consistent with the others, and why, if it is an outlier."""
    ratio, noise_ratio = common_fit_cost(info, left)
    worst = int(np.argmax(ratio))
    if ratio[worst] > UNLIKE_RATIO and noise_ratio[worst] > UNLIKE_NOISE_RATIO:
        return left[worst], (
            f"it is unlike the other runs: in common with them it fits {ratio[worst]:.0f} times worse than "
            "they do among themselves"
        )
    return None


def common_fit_cost(info: Evidence, left: Sequence[int]) -> tuple[Array, Array]:
    """Return what a simulation in common costs each run, over what it costs the others, and in noise a row.

    The cost is that in minus twice the log-likelihood, over a fit of each run by itself.
    """
    prior = np.diag(1.0 / np.array([PRIOR_STD.get(name, 1e-6) for name in info.parameters]) ** 2)
    a, g, c = info.a[left], info.g[left], info.c[left]
    n = len(left)
    k = int((a.sum(axis=0).diagonal() > UNKNOWN_RATIO * prior.diagonal()).sum())

    def loss(a: Array, g: Array) -> Array:
        x = np.linalg.solve(a + prior, g[..., None])[..., 0]
        return np.asarray(-(x * g).sum(axis=-1))

    own = loss(a, g)
    n_rows = np.array([int((info.white_residual[i] != 0.0).sum()) for i in left])
    seen = n_rows > 0  # of a short run nothing may be left once filters have settled
    noise = float(np.median((c + own)[seen] / n_rows[seen])) if seen.any() else 1.0
    without = loss(a.sum(axis=0) - a, g.sum(axis=0) - g)
    cost = float(loss(a.sum(axis=0), g.sum(axis=0))) - own.sum()
    others = without - (own.sum() - own)
    alone = cost - others
    return alone / (others / max(n - 2, 1) + k * noise), alone / (noise * np.maximum(n_rows, 1))
