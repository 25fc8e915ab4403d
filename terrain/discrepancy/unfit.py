"""Unfit runs, which are excluded before causes are searched.

A run is unfit for a fault of its own: a channel that is missing or frozen, a clock offset of its own, wheels
that turn under a body at rest, or another robot or terrain than its log states.  What all runs have in common
is no fault of a run: it is what the diagnosis searches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.clocks import MAX_LAG_S, MIN_LAG_S, Latencies, Shift, offsets_of, shifts_of
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.faults import LEAST, MOTION, G, H, Response, X, Y, gains_of, responses_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.verdict import Clock, Excluded
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

MARGIN_S = 0.6  #: Tolerance of the time at which a predicted change arrives

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


def unfit_runs(
    signals: Sequence[Signals],
    info: Evidence,
    shift: Shift | None = None,
    latencies: Latencies | None = None,
) -> tuple[Excluded, ...]:
    """Return the unfit runs, each with the first reason that is found.

    Clocks (``shift``) and latencies are measured unless they are known; short runs measure latencies only together.

    Raises
    ------
    DataError
        if most runs' clocks are further apart than is searched.
    """
    shift = shifts_of(info) if shift is None else shift
    responses = responses_of(info.rows, latencies, shift)
    has_clock = [bool(np.isfinite(lag_s).any()) for lag_s in shift.lag_s]
    stalled = stalled_runs(responses, has_clock, MAX_LAG_S + MARGIN_S - STRETCH_S)
    dead, late, frozen = _dead(signals, info, responses), _late(info, shift), _frozen(signals, info)
    reasons = frozen | stalled | late | dead  # the first of these counts last
    reasons |= odd_runs(responses, [i for i in range(len(signals)) if i not in reasons])
    reasons |= _unlike(info, [i for i in range(len(signals)) if i not in reasons])
    return tuple(Excluded(signals[i].run_id, reasons[i]) for i in sorted(reasons))


def clocks_of(info: Evidence, shift: Shift | None = None) -> tuple[Clock, ...]:
    """Return how far IMU and camera are behind the wheels at the middle of each run, NaN where unknown."""
    offset_s, std_s = offsets_of(shifts_of(info) if shift is None else shift)
    offset_s = offset_s + info.vector[INDEX["clock_offset_s"]]
    return tuple(
        Clock(run.run_id, float(offset), float(std))
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
            dead[CHANNELS.index(CURRENT)] = False  # it is compared only while the wheels are parallel
        for c in np.flatnonzero(dead):
            reasons[i] = f"its {CHANNELS[c]} is known in {known_ratio[i, c]:.0%} of its samples"
        known = np.isfinite(run.wheel_speed_mps).all(axis=1)
        if known.mean() < MIN_FINITE_RATIO:
            reasons[i] = f"its wheel speeds are known in {known.mean():.0%} of its samples"
            continue
        speed_mps = run.wheel_speed_mps[known]
        spread = speed_mps.std(axis=0)
        constant = spread.min() < STILL_MPS and spread.max() > VARIES_MPS
        if constant and _disagrees(responses[i], common):
            reasons[i] = f"its wheel {int(np.argmin(spread)) + 1} never turns faster or slower, the others do"
        elif np.abs(speed_mps).max() < STILL_MPS:
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

    def behind(offset_s: float) -> str:
        return f"{abs(offset_s):.2f} s {'behind' if offset_s >= 0 else 'ahead of'}"

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
            usual = behind(float(np.nanmedian(offset_s[others])))
            reasons[i] = (
                f"its IMU and camera are {behind(float(offset_s[i]))} its wheels, {usual} in the other runs"
            )
    return reasons


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
        for _ in range((len(left) - 1) // MIN_OTHERS):
            ratio, noise_ratio = common_fit_cost(info, left)
            worst = int(np.argmax(ratio))
            if not (ratio[worst] > UNLIKE_RATIO and noise_ratio[worst] > UNLIKE_NOISE_RATIO):
                break
            reasons[left.pop(worst)] = (
                f"it is unlike the other runs: in common with them it fits {ratio[worst]:.0f} times worse than "
                "they do among themselves"
            )
    return reasons


def common_fit_cost(info: Evidence, left: Sequence[int]) -> tuple[Array, Array]:
    """Return what a simulation in common costs each run, over what it costs the others, and in noise a row.

    The cost is that in minus twice the log-likelihood, over a fit of each run by itself.
    """
    prior = info.prior
    a, g, c = info.a[left], info.g[left], info.c[left]
    n = len(left)
    k = int((a.sum(axis=0).diagonal() > UNKNOWN_RATIO * prior.diagonal()).sum())

    def loss(a: Array, g: Array) -> Array:
        x = np.linalg.solve(a + prior, g[..., None])[..., 0]
        return np.asarray(-(x * g).sum(axis=-1))

    own = loss(a, g)
    n_rows = np.array([int((info.white[i][-1] != 0.0).sum()) for i in left])
    seen = n_rows > 0  # of a short run nothing may be left once filters have settled
    noise = float(np.median((c + own)[seen] / n_rows[seen])) if seen.any() else 1.0
    without = loss(a.sum(axis=0) - a, g.sum(axis=0) - g)
    cost = float(loss(a.sum(axis=0), g.sum(axis=0))) - own.sum()
    others = without - (own.sum() - own)
    alone = cost - others
    return alone / (others / max(n - 2, 1) + k * noise), alone / (noise * np.maximum(n_rows, 1))


# -- Runs against the common response of the others: those that stall, and those of another robot ----------
# The common response is a gain of each channel over the simulation's prediction, which may be wrong by any
# factor.  How far runs scatter about it is estimated from them.

FOLLOWS = 0.85
"""Correlation about zero of a channel with its prediction, from which a run shows the common response: a body
that sticks and comes free follows its wheels less."""

MIN_RUNS = 3  #: Least number of runs that show it

STALLED_RATIO, NOMINAL_RATIO = 0.25, 0.05
"""Ratio of the common response below which a body stalls, and of the prediction where none is known: slip
of the catalogue goes to 0.1 of what is predicted."""

STALLED_S, STRETCH_S, ALL_RATIO = 2.0, 1.0, 0.8
"""A run stalls that does so for the first in all, or for the third of the time that it should move, in
stretches of the second at the least, and far longer than the others."""

FLOOR = {G: 0.02, H: 0.02, X: 0.015}  #: What sensors measure of a body at rest (rad/s, m/s)

STRAIGHT_RADPS, MIN_STRAIGHT = 0.02, 10
"""Of rows in which no turn is predicted, and so many at the least, the median of the gyro is its bias."""

SIGMAS, FEW_RUNS, LEAST_OFF = 4.5, 8.0, 0.15
"""A run is of another robot or terrain if its gain is off by so many times the scatter of the runs and its
own error, times one plus the second over their number, since few runs measure their scatter badly: of normal
gains at most one set of 500 has such a run.  It is off by the third, too, in the logarithm: radii of one
robot differ by less."""

MIN_COMPARED = 6  #: Of fewer runs with a gain, one in a hundred sets has such a run

INNER, INNER_SIGMAS = 2 / 3, 0.967
"""Scatter comes from that ratio of the runs, the nearest to the median, and what it is of a normal law: the
rest may be of other robots."""

MIN_SCATTER = 0.02  #: Scatter of a robot's runs at the least, in the logarithm

MAX_ODD_RATIO = 1 / 3
"""More runs than that are no outliers: runs then differ in groups, which is for the diagnosis to say."""

ODD_CHANNELS = {G: "yaw rate", H: "heading rate", X: "speed"}
"""Channels by which runs are compared: gains of the others depend on what was driven."""

STALLS = {
    G: "its wheels turn it at {:.2f} rad/s by the other runs, its body turns at {:.2f} rad/s",
    H: "its wheels turn it at {:.2f} rad/s by the other runs, its heading changes at {:.2f} rad/s",
    X: "its wheels drive it at {:.2f} m/s by the other runs, its body moves at {:.2f} m/s",
}
"""What wheels make of a body in the common response, and what it does."""


def common_gains(responses: Sequence[Response]) -> Array:
    """Return the common response (channels,): the median gain of runs that follow; NaN for too few."""
    gain, correlation = (np.array(each) for each in zip(*map(gains_of, responses), strict=True))
    common = np.full(gain.shape[1], np.nan)
    for c in range(gain.shape[1]):
        shown = gain[(correlation[:, c] > FOLLOWS) & (gain[:, c] > 0), c]
        if shown.size >= MIN_RUNS:
            common[c] = float(np.median(shown))
    return common


def stalled_runs(responses: Sequence[Response], has_clock: Sequence[bool], extra_s: float) -> dict[int, str]:
    """Return runs whose wheels turn while the body hardly responds, far longer than in the others, and why.

    Stretches have to be longer by ``extra_s`` where the clock of a run is not known and the run does not follow the
    wheels on the clock of all: a clock of its own looks like a short stall.
    """
    if len(responses) < 2:
        return {}
    common = common_gains(responses)
    known = np.isfinite(common)
    least_ratio = np.where(known, STALLED_RATIO, NOMINAL_RATIO)
    stalls, time_s, asked_s = [], [], []
    for run, clock in zip(responses, has_clock, strict=True):
        follows = bool((gains_of(run)[1][list(MOTION)] > FOLLOWS).any())
        expected = run.predicted * np.where(known, common, 1.0)
        least_s = STRETCH_S + (0.0 if clock or follows else extra_s)
        stalled, asked = _stalled_rows(run, expected, least_ratio, least_s)
        stalls.append((expected, stalled))
        time_s.append(run.period_s * stalled.sum())
        asked_s.append(run.period_s * asked.sum())
    reasons = {}
    for i, run in enumerate(responses):
        least_s = min(STALLED_S, max(ALL_RATIO * asked_s[i], STRETCH_S))
        if time_s[i] < least_s + 3.0 * float(np.median(np.delete(time_s, i))):
            continue
        expected, stalled = stalls[i]
        words = []
        for c, text in STALLS.items():
            should, does = np.abs(expected[stalled, c]), np.abs(run.measured[stalled, c])
            seen = np.isfinite(does)
            if seen.any() and should[seen].mean() > LEAST[c]:
                words.append(text.format(should[seen].mean(), does[seen].mean()))
        words.append("its wheels turn, its body is at rest")
        reasons[i] = f"it is stalled for {time_s[i]:.1f} s in all: {words[0]}"
    return reasons


def _stalled_rows(run: Response, expected: Array, least_ratio: Array, least_s: float) -> tuple[Array, Array]:
    """Return where (m,) a body should move and does not, in stretches, and where it should."""
    n, seen = len(expected), run.measured.copy()
    straight = np.isfinite(seen[:, G]) & (np.abs(expected[:, G]) < STRAIGHT_RADPS)
    if straight.sum() >= MIN_STRAIGHT:
        seen[:, G] -= np.median(seen[straight, G])
    asked, rests, moves = np.zeros((3, n), dtype=bool)
    for c in MOTION:
        size = np.abs(seen[:, c])
        if c == X:  # the body may slide sideways
            size = np.hypot(size, np.where(np.isfinite(seen[:, Y]), seen[:, Y], 0.0))
        known = np.isfinite(size)
        still = size < least_ratio[c] * np.abs(expected[:, c]) + FLOOR[c]
        asked |= known & (np.abs(expected[:, c]) > LEAST[c])
        rests |= known & still
        moves |= known & ~still
    stalled = np.zeros(n, dtype=bool)
    for start, end in stretches(asked & rests & ~moves):
        stalled[start:end] = (end - start) * run.period_s >= least_s
    return stalled, asked


def odd_runs(responses: Sequence[Response], among: Sequence[int]) -> dict[int, str]:
    """Return runs, among those at some places, that respond to their wheels unlike the others of their terrain."""
    reasons: dict[int, str] = {}
    for terrain in dict.fromkeys(responses[i].terrain for i in among):
        places = [i for i in among if responses[i].terrain == terrain]
        for c, name in ODD_CHANNELS.items():
            for i, text in _outliers([responses[i] for i in places], c, name).items():
                reasons.setdefault(places[i], text)
    return reasons


def _outliers(responses: Sequence[Response], c: int, name: str) -> dict[int, str]:
    """Return the runs whose gain is an outlier of all runs', none if there are too many."""
    logs, error = np.full((2, len(responses)), np.nan)
    for i, run in enumerate(responses):
        gain, correlation = (each[c] for each in gains_of(run))
        if math.isfinite(gain) and gain > 0 and correlation > FOLLOWS:
            logs[i] = math.log(gain)
            seconds = np.isfinite(run.measured[:, c]).sum() * min(run.period_s, 1.0)
            error[i] = math.sqrt(max(1.0 / correlation**2 - 1.0, 0.0) / max(seconds, 1.0))
    known = np.isfinite(logs)
    if known.sum() < MIN_COMPARED:
        return {}
    off = logs - np.median(logs[known])
    inner = float(np.quantile(np.abs(off[known]), INNER, method="higher"))
    scatter = max(inner / INNER_SIGMAS, MIN_SCATTER)
    sigmas = SIGMAS * (1.0 + FEW_RUNS / known.sum())
    far = np.abs(off) > np.maximum(sigmas * np.hypot(scatter, error), LEAST_OFF)
    if far.sum() > MAX_ODD_RATIO * known.sum():
        return {}
    return {
        int(i): f"it is unlike the other runs: its {name} is {math.exp(off[i]):.2f} times what they "
        f"make of the same wheels, and they scatter by {scatter:.0%}"
        for i in np.flatnonzero(far)
    }


def stretches(where: Array) -> list[tuple[int, int]]:
    """Return starts and ends, not included, of the stretches in which something holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
