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

from terrain.discrepancy.compared import CHANNEL_WORDS, ComparedRun, beside_extended, compare_runs
from terrain.discrepancy.evidence import MIN_CLUSTERS, evidence_at
from terrain.discrepancy.gain import (
    ChannelGain,
    Gain,
    Interval,
    earns,
    gain_of,
    gains_of,
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
"""Part of the square of a channel by which a cause makes it worse, and how many times that, over the noise, it has to
remove from the others all the same: a channel that is wrong by itself, as currents of a turning resistance that is not
known, hardly speaks against a track that takes the error of three others."""


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
    def shown(self) -> bool:
        """Whether runs are left out in turn that are enough for an interval of the evidence itself."""
        return self.in_turn and len(self.plain) >= MIN_CLUSTERS

    @property
    def in_turn(self) -> bool:
        """Whether the runs are those behind the diagnosis, left out in turn."""
        return any(self.left_out)

    def beside(self, values: Sequence[Mapping[str, float]]) -> tuple[ComparedRun, ...]:
        """Return the runs beside the simulation extended by values of parameters, of each part its own."""
        extended = [self.simulation.with_effects(own) for own in values]
        runs = zip(self.plain, self.signals, self.fold, strict=True)
        return tuple(beside_extended(run, own, extended[k], self.low_pass) for run, own, k in runs)

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


def values_by_part(fit: CauseFit, built: Mapping[str, float], on: HeldOut) -> list[dict[str, float]]:
    """Return the values of parameters that are built in as they are fitted without the runs of each part.

    The step from the fit to all runs is linear, with the same causes.
    """
    places = fit.info.places(fit.names)
    a, g = fit.info.clusters(places)
    unit = np.sqrt(np.maximum(np.einsum("kii->i", a), 1e-30))
    tiny, values = 1e-9 * np.eye(len(places)), []

    def solved(runs: Sequence[int]) -> Array:
        rest = [i for i in range(len(a)) if i not in runs]
        system = a[rest].sum(axis=0) / np.outer(unit, unit) + tiny
        return np.asarray(np.linalg.solve(system, g[rest].sum(axis=0) / unit) / unit)

    every = solved(()) if built else np.zeros(0)
    for runs in on.left_out:
        step = solved(runs) - every if runs and built else 0.0 * every
        own = {}
        for name, value in built.items():
            low, high = (bound - on.simulation.effects.get(name, 0.0) for bound in BOUNDS[name])
            own[name] = min(max(value + float(step[fit.names.index(name)]), low), high)
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
    shown: bool  #: whether runs were left out in turn that are enough for an interval of the evidence itself

    def earned(self, gain: Gain | ChannelGain) -> bool:
        """Return whether a gain, of a channel or of all, is as good as :func:`terrain.discrepancy.gain.earns` asks."""
        return earns(gain.reduction, gain.ci, gain.learner_reduction, self.shown)


def judge(fit: CauseFit, built: Sequence[Effect], on: HeldOut) -> Judgement:
    """Return how causes that are built in do on runs held out.

    A cause earns its name where, over the channels where it acts, it removes a part of the square beside the others
    whose interval is above 0, and the extension at least half of what the learner does, and where it makes no channel
    worse.
    """
    change = dict(zip(fit.names, fit.change.tolist(), strict=True))
    of_parts = values_by_part(fit, {name: change[name] for name in names_of(built)}, on)
    runs = on.beside(of_parts) if built else on.plain
    gain, weights, squares = on.gain(runs), weights_of(on.noise), squares_of(runs, on.learned)[0]
    removed, acting, reasons = {}, {}, {}
    whole = (
        removed_by(runs, [run._replace(after=run.before) for run in runs], weights).changes if built else 0.0
    )
    for cause in built:
        own = names_of([cause])
        rest = [{name: value for name, value in part.items() if name not in own} for part in of_parts]
        part = removed_by(runs, on.beside(rest), weights)
        acts = part.changes >= max(ACTS * float(part.changes.max()), 1e-30)
        order = [CHANNELS[c] for c in np.argsort(-part.changes, kind="stable")]
        main = [name for name in order if acts[CHANNELS.index(name)]]
        changed = part.changes >= np.maximum(SHARE * whole, 1e-30)
        acting[cause.name] = tuple(n for n in order if n in gain.channels and changed[CHANNELS.index(n)])
        ratio, interval = removed[cause.name] = part.gain(weights * acts, on.seed)
        own_gain, learner, _ = gains_of(squares @ (weights * acts), True, on.seed)
        words = " and ".join([CHANNEL_WORDS[name][0] for name in main])
        net = float(((part.squares[:, 1] - part.squares[:, 2]).sum(axis=0) * weights).sum())
        if not earns(ratio, interval, -math.inf, on.shown):
            reasons[cause.name] = f"{_percent(ratio, interval)} of the square of {words} go with it"
        elif not earns(*own_gain, learner[0], on.shown):
            beside = f"a black-box learner removes {100 * learner[0]:.0f} %"
            reasons[cause.name] = f"{_percent(*own_gain)} of the square of {words} go, {beside}"
        for name in gain.channels:
            more, ends = part.gain(np.array([channel == name for channel in CHANNELS], dtype=float), on.seed)
            c = CHANNELS.index(name)
            added = -more * part.squares[:, 0, c].sum() * weights[c]
            outweighed = net + added > OUTWEIGHS * added
            if more < -WORSE and ends[1] < 0.0 and not outweighed:
                worse = f"{CHANNEL_WORDS[name][0]} worse, by {-100 * more:.0f} % of its square"
                reasons.setdefault(cause.name, f"it makes {worse}")
    reasons = {name: f"on {on.how}: {why}" for name, why in reasons.items()}
    return Judgement(gain, runs, removed, acting, reasons, on.shown)


def _percent(ratio: float, interval: Interval) -> str:
    low, high = interval
    return f"{100 * ratio:.0f} % ({100 * low:.0f} to {100 * high:.0f} %)"
