"""Unfit runs: those with a fault of their own, which are excluded before causes are searched.

It is a channel that is missing or frozen, a clock offset of its own, wheels that turn under a body at rest, or another
robot or terrain than its log states.  What all runs have in common is no fault of a run: it is what the diagnosis
searches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.clocks import MAX_LAG_S, MIN_LAG_S, Shift, offsets_of, shifts_of
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.health.agreement import (
    AMPS,
    MOTION,
    Agreement,
    X,
    Y,
    agreement_of,
    medians,
    on_own_clocks,
)
from terrain.discrepancy.health.response import FOLLOWS, STRETCH_S, common_gains, odd_runs, stalled_runs
from terrain.discrepancy.health.samples import MARGIN_S, lost_samples
from terrain.discrepancy.runs import UNLIKE, Excluded, Rows, Signals
from terrain.effects import CHANNELS, INDEX
from terrain.records import Array

#: A clock is a run's own if it is off by the first, and by so many times its error and the scatter of the others, which
#: is the third at the least.
CLOCK_S, CLOCK_SIGMAS, CLOCK_SCATTER_S = 0.12, 6.0, 0.01
#: Spread of a wheel speed that never changes, of one that does, and a speed at which no wheel rests.
STILL_MPS, VARIES_MPS, MOVING_MPS = 0.002, 0.05, 0.2
#: Of the gain of a run over that of the others, which one dead wheel of two makes 2 or 0: a wheel that never changes is
#: dead only beyond that, or where the body does not follow the wheels at all.
OFF_RATIO = 1.5
#: A channel is dead in a run that has some of it but less than the first, the others over the second.
MIN_FINITE_RATIO, USUAL_FINITE_RATIO = 0.3, 0.7


class Clock(NamedTuple):
    """Delay of the IMU's and the camera's logger behind the wheels' in a run, and its standard deviation."""

    run_id: str
    offset_s: float
    std_s: float


def unfit_runs(
    signals: Sequence[Signals], info: Evidence, shift: Shift | None = None
) -> tuple[Excluded, ...]:
    """Return the unfit runs, each with the first reason that is found; clocks are measured unless they are known.

    Raises
    ------
    DataError
        if most runs' clocks are further apart than is searched.
    """
    shift = shifts_of(info) if shift is None else shift
    runs = on_own_clocks(info.rows, shift)
    follows, every = agreement_of(runs), range(len(runs))
    has_clock = [bool(known.any()) for known in np.isfinite(shift.lag_s)]
    reasons = _lost(signals, info.rows)
    reasons |= stalled_runs(signals, runs, follows, has_clock, MAX_LAG_S + MARGIN_S - STRETCH_S)
    reasons |= _late(info, shift) | _dead(signals, runs, follows)  # the last of these counts
    reasons |= odd_runs(runs, follows, [i for i in every if i not in reasons])
    reasons |= _unlike(info, [i for i in every if i not in reasons])
    return tuple(Excluded(signals[i].run_id, reasons[i]) for i in sorted(reasons))


def clocks_of(info: Evidence, shift: Shift) -> tuple[Clock, ...]:
    """Return how far IMU and camera are behind the wheels at the middle of each run, NaN where unknown."""
    offset_s, std_s = offsets_of(shift)
    offset_s += info.vector[INDEX["clock_offset_s"]]
    return tuple(map(Clock, (run.run_id for run in info.rows), offset_s.tolist(), std_s.tolist()))


def _lost(signals: Sequence[Signals], rows: Sequence[Rows]) -> dict[int, str]:
    """Return runs with a channel that is constant, or clipped, while the prediction varies."""
    reasons: dict[int, str] = {}
    for i, (run, beside) in enumerate(zip(signals, rows, strict=True)):
        for lost in lost_samples(run, beside):
            how = f"is clipped at {lost.value:.3g}" if lost.is_clipped else "is frozen"
            reasons[i] = f"its {CHANNELS[lost.channel]} {how} for {lost.seconds:.1f} s while it should change"
    return reasons


def _late(info: Evidence, shift: Shift) -> dict[int, str]:
    """Return runs with a clock of their own: all channels that measure it are off, and by the same lag."""
    offset_s = offsets_of(shift)[0] + info.vector[INDEX["clock_offset_s"]]
    reasons: dict[int, str] = {}
    for i, lag_s in enumerate(shift.lag_s):
        if shift.lost[i]:
            reasons[i] = f"its IMU and camera are not {MIN_LAG_S:g} to {MAX_LAG_S:g} s behind its wheels"
        others = np.delete(shift.lag_s, i, axis=0)
        middle_s = medians(others)
        scatter_s = np.fmax(1.48 * medians(np.abs(others - middle_s)), CLOCK_SCATTER_S)
        known = np.isfinite(lag_s) & (np.isfinite(others).sum(axis=0) >= 2)
        off, error = (lag_s - middle_s)[known], np.hypot(shift.std_s[i], scatter_s)[known]
        own = known.any() and (np.abs(off) > np.maximum(CLOCK_S, CLOCK_SIGMAS * error)).all()
        if own and np.ptp(off) < CLOCK_S + CLOCK_SIGMAS * error.max():
            behind, usual = (
                f"{abs(at_s):.2f} s {'behind' if at_s >= 0 else 'ahead of'}"
                for at_s in (offset_s[i], np.nanmedian(np.delete(offset_s, i)))
            )
            reasons[i] = f"its IMU and camera are {behind} its wheels, {usual} in the other runs"
    return reasons


def _dead(signals: Sequence[Signals], runs: Sequence[Rows], follows: Agreement) -> dict[int, str]:
    """Return runs with a wheel or a channel of which hardly anything is there.

    A wheel that is driven at a steady speed beside others that change is no dead one: the body follows them, as the
    wheels make it move in the other runs.
    """
    reasons: dict[int, str] = {}
    known_ratio = np.array([np.isfinite(run.measured).mean(axis=0) for run in signals])
    usual, common = np.median(known_ratio, axis=0), common_gains(follows)
    for i, run in enumerate(signals):
        dead = (known_ratio[i] > 0) & (known_ratio[i] < MIN_FINITE_RATIO) & (usual > USUAL_FINITE_RATIO)
        dead[AMPS] &= not run.steer_rad.any()  # it is compared only while the wheels are parallel
        for c in np.flatnonzero(dead):
            reasons[i] = f"its {CHANNELS[c]} is known in {known_ratio[i, c]:.0%} of its samples"
        known = np.isfinite(run.wheel_speed_mps).all(axis=1)
        if known.mean() < MIN_FINITE_RATIO:
            reasons[i] = f"its wheel speeds are known in {known.mean():.0%} of its samples"
            continue
        speed_mps = run.wheel_speed_mps[known]
        spread = speed_mps.std(axis=0)
        asked = [c for c in MOTION if follows.correlation[i, c] != 0.0]
        off = np.abs(
            np.log(np.abs(follows.gain[i, asked] / common[asked]))
        )  # NaN, which is not over, if unknown
        disagrees = (follows.correlation[i, asked] < FOLLOWS).any() or (off > math.log(OFF_RATIO)).any()
        if spread.min() < STILL_MPS and spread.max() > VARIES_MPS and disagrees:
            reasons[i] = f"its wheel {int(np.argmin(spread)) + 1} never turns faster or slower, the others do"
        elif np.abs(speed_mps).max() < STILL_MPS:
            shown = np.nan_to_num(runs[i].measured[:, [X, Y]])
            if np.hypot(*shown.T).max(initial=0.0) > MOVING_MPS:
                reasons[i] = "its wheels are at rest, its camera moves"
    return reasons


#: Least number of other runs of its terrain that a run is compared with: of three runs two may be wrong.
MIN_OTHERS = 3
#: Information over that of the prior, below which a parameter is not counted: fitting it costs nothing.
UNKNOWN_RATIO = 1e-6
#: A run is an outlier if a simulation in common with the others costs it so many times what one in common costs them
#: among themselves, and so many variances of the noise a row.  Of 15 000 simulated runs without a fault, whatever was
#: hidden in all runs of a set, one passed both.
UNLIKE_RATIO, UNLIKE_NOISE_RATIO = 12.0, 0.2


def _unlike(info: Evidence, among: Sequence[int]) -> dict[int, str]:
    """Return runs that no simulation in common with those of the same terrain fits.

    What a simulation in common costs a run is that in minus twice the log-likelihood, over a fit of each run by itself.
    """
    reasons: dict[int, str] = {}

    def loss(a: Array, g: Array) -> Array:
        x = np.linalg.solve(a + info.prior, g[..., None])[..., 0]
        return np.asarray(-(x * g).sum(axis=-1))

    for terrain in dict.fromkeys(info.rows[i].terrain for i in among):
        left = [i for i in among if info.rows[i].terrain == terrain]
        for _ in range((len(left) - 1) // MIN_OTHERS):
            a, g, n = info.a[left], info.g[left], len(left)
            k = int((a.sum(axis=0).diagonal() > UNKNOWN_RATIO * info.prior.diagonal()).sum())
            own = loss(a, g)
            n_rows = np.array([int((info.white[i][-1] != 0.0).sum()) for i in left])
            seen = n_rows > 0  # of a short run nothing may be left once filters have settled
            noise = float(np.median((info.c[left] + own)[seen] / n_rows[seen])) if seen.any() else 1.0
            others = loss(a.sum(axis=0) - a, g.sum(axis=0) - g) - (own.sum() - own)
            alone = float(loss(a.sum(axis=0), g.sum(axis=0))) - own.sum() - others
            ratio = alone / (others / max(n - 2, 1) + k * noise)
            worst = int(np.argmax(ratio))
            noise_ratio = alone[worst] / (noise * max(n_rows[worst], 1))
            if not (ratio[worst] > UNLIKE_RATIO and noise_ratio > UNLIKE_NOISE_RATIO):
                break
            reasons[left.pop(worst)] = (
                f"{UNLIKE} runs: in common with them it fits {ratio[worst]:.0f} times worse than "
                "they do among themselves"
            )
    return reasons
