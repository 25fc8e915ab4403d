"""Whether causes earn their names: judged on runs that they were not fitted to, beside the black-box learner.

Runs are held out of the diagnosis where there are enough, whole sessions where several are named.  Where none is held
out, parts of the runs are left out of the fit in turn: the causes are those found in all of them, their values those
that the other runs give.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from terrain.bootstrap import LEVEL
from terrain.discrepancy.compared import CHANNEL_WORDS, ComparedRun, beside_extended, compare_runs
from terrain.discrepancy.evidence import (
    Evidence,
    evidence_at,
    marginal_parts,
    move_point,
    pooled_variance,
)
from terrain.discrepancy.gain import (
    HALF,
    NONE,
    THIRDS,
    Gain,
    Interval,
    gain_of,
    gains_of,
    of_clusters,
    removed_by,
    squares_of,
    weights_of,
)
from terrain.discrepancy.health.unfit import unfit_runs
from terrain.discrepancy.learner import predicted_residuals
from terrain.discrepancy.runs import Excluded, LowPass, Signals, Simulation, low_pass_of
from terrain.discrepancy.search import CauseFit, names_of
from terrain.effects import BOUNDS, CHANNELS, Effect
from terrain.errors import DataError
from terrain.records import Array, RunLog

MIN_RUNS = 3  #: Least number of runs of a diagnosis: with fewer none is left to validate a fit
MIN_JUDGED = 3  #: Least number of runs among which an unfit one can be found

MAX_FOLDS = 5  #: Where no run is held out: parts of the runs that are left out in turn

ACTS = 0.5
"""A cause is judged in the channels that it changes, over their noise, by at least that ratio of the largest change."""

SHARE = 0.25
"""It is stated beside a channel of which it makes at least that part of the change by all causes, root mean square."""

WORSE, OUTWEIGHS = 0.02, 10.0
"""Part of the square of a channel by which a cause makes it worse, or better at all; and how many times that, over the
noise, it has to remove from the others all the same: a channel that is wrong by itself, as currents of a turning
resistance that is not known, hardly speaks against a track that takes the error of three others."""


def units_of(runs: Sequence[RunLog] | Sequence[Signals] | Sequence[ComparedRun]) -> list[str]:
    """Return by run what is held out as a whole: its session where two or more are named, else the run."""
    sessions = {run.session for run in runs} - {""}
    return [run.session if len(sessions) > 1 and run.session else run.run_id for run in runs]


def fit_to_judge(
    simulation: Simulation, runs: Sequence[Signals]
) -> tuple[tuple[Signals, ...], tuple[Excluded, ...]]:
    """Return the runs that are fit to be judged on, and those that are not.

    Raises
    ------
    DataError
        if there is no run, or none is fit.
    """
    signals = tuple(runs)
    if not signals:
        raise DataError("gain: there is no run that was not used in the diagnosis")
    if len(signals) < MIN_JUDGED:
        return signals, ()
    about = simulation, simulation.vector, names_of(simulation.library), low_pass_of(signals)
    excluded = unfit_runs(signals, evidence_at(signals, *about))
    gone = [run.run_id for run in excluded]
    signals = tuple([run for run in signals if run.run_id not in gone])
    if not signals:
        raise DataError(f"gain: none of {len(runs)} runs is fit to be compared ({excluded[0].reason})")
    return signals, tuple(excluded)


class HeldOut(NamedTuple):
    """Runs on which causes are judged, beside the simulation, and what the black-box learner predicts of them."""

    how: str  #: in which sense they are held out, in words
    simulation: Simulation
    low_pass: LowPass
    signals: tuple[Signals, ...]
    plain: tuple[ComparedRun, ...]
    learned: tuple[Array, ...]  #: (m, channels) of each run
    fold: tuple[int, ...]  #: by run the part of the runs without which its extension is fitted
    #: by part the places of its runs in the fit; empty where they are in none
    left_out: tuple[tuple[int, ...], ...]
    noise: Mapping[str, float]
    seed: int
    excluded: tuple[Excluded, ...] = ()

    @property
    def in_turn(self) -> bool:
        """Whether the runs are those behind the diagnosis, left out in turn."""
        return any(self.left_out)

    def beside(self, values: Sequence[Mapping[str, float]]) -> tuple[ComparedRun, ...]:
        """Return the runs beside the simulation extended by values of parameters, of each part its own."""
        extended = [self.simulation.with_effects(own) for own in values]
        runs = zip(self.plain, self.signals, self.fold, strict=True)
        return tuple(beside_extended(run, own, extended[k], self.low_pass) for run, own, k in runs)

    def evidence(self, fit: CauseFit) -> Evidence:
        """Return the evidence of the runs about a fit, by its noise and scatter."""
        point = move_point(self.simulation.vector, fit.names, fit.change)
        about = self.simulation, point, fit.names, self.low_pass, fit.info.noise, fit.info.scatter
        return evidence_at(self.signals, *about).counted_from(self.simulation.vector)

    def gain(self, runs: Sequence[ComparedRun]) -> Gain:
        """Return the gain of what is built in beside the runs."""
        return gain_of(runs, self.learned, self.noise, self.seed, self.how, self.excluded)


def held_out_runs(
    used: Sequence[ComparedRun],
    signals: Sequence[Signals],
    extended: Simulation,
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
    seed: int,
) -> HeldOut:
    """Return runs that were held out, to judge what was found in those used; unfit ones are excluded.

    Raises
    ------
    DataError
        if none of them is fit.
    """
    fit, excluded = fit_to_judge(extended, signals)
    plain = compare_runs(simulation, None, fit, low_pass, held_out=True)
    known = {run.run_id for run in plain}
    fit = tuple(run for run in fit if run.run_id in known)
    sessions = {run.session for run in plain}
    apart = all(sessions) and not sessions & {run.session for run in used}
    n, k = len(plain), len(sessions)
    how = f"{n} run{'s' * (n != 1)} held out"
    if apart:
        how = f"{n} run{'s' * (n != 1)} of {k} session{'s' * (k != 1)} held out"
    learned = tuple(predicted_residuals(used, plain))
    about = how, simulation, low_pass, fit, plain, learned, (0,) * n, ((),)
    return HeldOut(*about, noise, seed, excluded)


def crossed_runs(
    signals: Sequence[Signals],
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
    seed: int,
) -> HeldOut:
    """Return the runs behind a diagnosis, sessions or runs of them left out in turn, where none was held out."""
    plain = compare_runs(simulation, None, signals, low_pass, held_out=True)
    place = {run.run_id: i for i, run in enumerate(signals)}
    used = tuple(signals[place[run.run_id]] for run in plain)
    units = units_of(used)
    order = np.random.default_rng(seed).permutation(len(np.unique(units)))
    fold = order[np.unique(units, return_inverse=True)[1]] % MAX_FOLDS
    learned: list[Array] = [np.empty(0)] * len(plain)
    for k in np.unique(fold):
        inside = np.flatnonzero(fold == k)
        others = [plain[i] for i in np.flatnonzero(fold != k)]
        for i, own in zip(inside, predicted_residuals(others, [plain[i] for i in inside]), strict=True):
            learned[i] = own
    left_out = [
        tuple(place[plain[i].run_id] for i in np.flatnonzero(fold == k)) for k in range(max(fold) + 1)
    ]
    what = "sessions" if len({*units} - {run.run_id for run in used}) else "runs"
    how = f"{len(plain)} runs, {what} of them left out of the fit in turn"
    return HeldOut(
        how,
        simulation,
        low_pass,
        used,
        plain,
        tuple(learned),
        tuple(fold.tolist()),
        tuple(left_out),
        noise,
        seed,
    )


def values_by_part(fit: CauseFit, names: Sequence[str], on: HeldOut) -> list[dict[str, float]]:
    """Return the values of parameters that are built in as they are fitted without the runs of each part.

    Steps from the fit are linear; of fewer parameters than were fitted, those that are left make up for the others.
    """
    info = fit.info

    def solved(names: Sequence[str], runs: Sequence[int] = ()) -> Array:
        a, g = info.clusters(info.places(names))
        unit = np.sqrt(np.maximum(np.einsum("kii->i", a), 1e-30))
        rest = [i for i in range(len(a)) if i not in runs]
        system = a[rest].sum(axis=0) / np.outer(unit, unit) + 1e-9 * np.eye(len(names))
        return np.asarray(np.linalg.solve(system, g[rest].sum(axis=0) / unit) / unit)

    pooled, values = dict(zip(fit.names, fit.change - solved(fit.names), strict=True)), []
    for runs in on.left_out:
        own = {}
        for name, value in zip(names, solved(names, runs).tolist(), strict=True):
            low, high = (bound - on.simulation.effects.get(name, 0.0) for bound in BOUNDS[name])
            own[name] = min(max(pooled[name] + value, low), high)
        values.append(own)
    return values


class Judgement(NamedTuple):
    """What is built in, judged on runs held out; by cause what it removes there, where, and what speaks against it."""

    gain: Gain
    runs: tuple[ComparedRun, ...]  #: beside the simulation, and the extended one if anything is built in
    removed: Mapping[str, tuple[float, Interval]]
    """Part of the square before the extension that each removes beside the others, in the channels where it acts."""
    acting: Mapping[str, tuple[str, ...]]  #: channels beside which each is stated, the largest change first
    reasons: Mapping[str, str]  #: why some do not earn their names; empty where all do


def judge(fit: CauseFit, built: Sequence[Effect], on: HeldOut) -> Judgement:
    """Return how causes that are built in do on runs held out.

    A cause earns its name where the part of the square that goes with it, over what the others leave that are refitted
    without it, has its interval above 0, where the extension removes at least half of what the learner does over the
    channels where the cause acts, and where it makes no channel worse.

    Where the squares gain more than :data:`WORSE`, but not with their interval, that part is by how much likelier the
    runs are (:func:`likelier_with`): noise of all else, and what varies from run to run, hide a small change.  Two
    causes that make up for each other gain more than all there is.  Where they gain less, but the learner finds nothing
    there beyond the extension, so that noise is left, it is the same, and half of the change has to show with its
    interval.

    Where runs are so few that their thirds are the clusters, causes are judged together by that: where the interval of
    all of them is above 0, one is dropped only if the runs do not show it by themselves, the interval of the part of
    its change that they have holding 0, or are no likelier with it.  What varies from run to run is the same in thirds
    of one, so that these do not show that a channel gets worse.
    """
    names = names_of(built)
    of_parts = values_by_part(fit, names, on)
    runs = on.beside(of_parts) if built else on.plain
    gain, weights, squares = on.gain(runs), weights_of(on.noise), squares_of(runs, on.learned)[0]
    removed, acting, reasons = {}, {}, {}
    if built:
        whole = removed_by(runs, [run._replace(after=run.before) for run in runs], weights).changes
        info = on.evidence(fit)
        none: list[dict[str, float]] = [{}] * len(of_parts)
        few = gain.clusters == THIRDS
        together = few and likelier_with(info, of_parts, none, on, runs)[1][0] > 0.0
    for cause in built:
        rest = values_by_part(fit, [name for name in names if name not in names_of([cause])], on)
        part = removed_by(runs, on.beside(rest), weights)
        acts = part.changes >= max(ACTS * float(part.changes.max()), 1e-30)
        order = [CHANNELS[c] for c in np.argsort(-part.changes, kind="stable")]
        main = [name for name in order if acts[CHANNELS.index(name)]]
        changed = part.changes >= np.maximum(SHARE * whole, 1e-30)
        acting[cause.name] = tuple(n for n in order if n in gain.channels and changed[CHANNELS.index(n)])
        ratio, interval = part.gain(weights * acts, on.seed)
        own_gain, learner, _ = gains_of(squares @ (weights * acts), True, on.seed)
        confirmed, seen = interval[0] > 0.0, WORSE < ratio <= 1.0
        known = [gain.channels[name] for name in main if name in gain.channels]
        noise_is_left = all(of.learner_reduction <= of.reduction for of in known)
        if together or (not confirmed and ratio <= 1.0 and (seen or noise_is_left)):
            (likelier, ends), size = likelier_with(info, of_parts, rest, on, runs), part.size(weights * acts)
            ratio, interval = min(size * likelier, 1.0), (size * ends[0], min(size * ends[1], 1.0))
            least = 0.0 if seen else HALF
            confirmed = likelier > 0.0 and ends[0] > -1.0 if together else ends[0] > least
        removed[cause.name] = ratio, interval
        words = " and ".join([CHANNEL_WORDS[name][0] for name in main])
        net = float(((part.squares[:, 1] - part.squares[:, 2]).sum(axis=0) * weights).sum())
        if not confirmed:
            reasons[cause.name] = f"{_percent(ratio, interval)} of the square of {words} go with it"
        elif own_gain[0] < HALF * learner[0]:
            beside = f"a black-box learner removes {100 * learner[0]:.0f} %"
            reasons[cause.name] = f"{_percent(*own_gain)} of the square of {words} go, {beside}"
        for name in gain.channels:
            more, ends = part.gain(np.array([channel == name for channel in CHANNELS], dtype=float), on.seed)
            c = CHANNELS.index(name)
            added = -more * part.squares[:, 0, c].sum() * weights[c]
            outweighed = net + added > OUTWEIGHS * added
            if more < -WORSE and ends[1] < 0.0 and not outweighed and not few:
                worse = f"{CHANNEL_WORDS[name][0]} worse, by {-100 * more:.0f} % of its square"
                reasons.setdefault(cause.name, f"it makes {worse}")
    reasons = {name: f"on {on.how}: {why}" for name, why in reasons.items()}
    return Judgement(gain, runs, removed, acting, reasons)


def likelier_with(
    info: Evidence,
    values: Sequence[Mapping[str, float]],
    others: Sequence[Mapping[str, float]],
    on: HeldOut,
    runs: Sequence[ComparedRun],
) -> tuple[float, Interval]:
    """Return by how much runs are likelier with values than with ``others``, over the square of the change, at most 1.

    With ``r`` what the others leave, ``d`` the change from these to the values, and ``S`` the covariance of the noise
    with what varies from run to run, minus twice the log-likelihood falls by ``2 d'S^-1 r - d'S^-1 d``.  Over ``d'S^-1
    d`` that is ``2 b - 1``: ``b`` is the part of the change that these runs show, 1 if all of it is there, and above
    0.5 they are nearer to the values than to the others.  Its 95 % interval is by the variance of the evidence, see
    :func:`terrain.discrepancy.evidence.pooled_variance`.
    """
    parts = marginal_parts(info.grams, info.nuisances, info.nuisance_std)
    x, y = (
        np.array([[*[-each[k].get(name, 0.0) for name in info.names], 1.0] for k in on.fold])
        for each in (values, others)
    )
    score, square = (of_clusters(np.einsum("ik,ibkl,il->ib", y - x, parts, z), runs) for z in (y, y - x))
    if not (size := float(square.sum())) > 0.0:
        return NONE
    shown = float(score.sum()) / size
    variance, dof = pooled_variance(score - shown * square, np.clip(square / size, 0.0, 0.9), size)
    half = 2.0 * float(stdtrit(dof, 0.5 * (1.0 + LEVEL))) * math.sqrt(variance / size)
    return 2.0 * shown - 1.0, (2.0 * shown - 1.0 - half, 2.0 * shown - 1.0 + half)


def _percent(ratio: float, interval: Interval) -> str:
    low, high = interval
    return f"{100 * ratio:.0f} % ({100 * low:.0f} to {100 * high:.0f} %)"
