r"""Causal filter over the class probabilities of windows: the terrain now, or "unknown".

Hidden Markov model with k classes and the state "unknown", in continuous time.  With state probabilities
:math:`b` and a step :math:`\Delta t`:

.. math::

    \text{transition:}\quad & \bar b = e^{-r\,\Delta t}\, b + (1 - e^{-r\,\Delta t})\, \pi \\
    \text{emission:}\quad & b_c \propto \bar b_c\, \ell_c^{\lambda}, \qquad
    \ell_c = (1 - \varepsilon)\, k\, p_c / (k\, q_c)^\alpha + \varepsilon, \qquad \ell_\text{unknown} = \nu^w \\
    \text{evidence:}\quad & \lambda = \min(\Delta t_\text{output} / T, 1)

- A ground holds for a mean dwell D; then the next one is drawn from :math:`\pi`, uniform over the classes
  beside a small share of "unknown".  As a draw may repeat the ground, :math:`r = 1 / (D (1 - \pi_c))`.  Two
  steps are one long step exactly, so that a gap in time or a refused window is a longer transition and no
  special case.
- A classifier gives the posterior p under the class shares q of its training; were q wholly in it, the likelihood
  would be p / q up to a factor (Bourlard and Morgan 1994, chapter 7).  A classifier that is tuned for accuracy holds
  less of them: :math:`\alpha` = 1 divides by the shares, 0 does not.  A share :math:`\varepsilon` of windows that
  follow no model bounds the likelihood.  Of an unknown ground, windows are as frequent as of all grounds together:
  likelihood 1, or :math:`\nu^w` where a score of novelty is given; as a run is novel as a whole, its windows repeat
  each other, and a weight w below 1 counts them for less.  :func:`choose_settings` chooses both on held-out windows.
- Windows that overlap repeat each other: one that comes :math:`\Delta t_\text{output}` after the last adds
  that part of a window's evidence, to the power :math:`\lambda` (Gruenwald and van Ommen 2017 call it the
  learning rate).  Below T, any stride gives the same evidence per second.
- Belief goes on from run to run of a session.  What was driven between two runs is not known; if it is like what was
  recorded, it lasts as long as a run, so that the transition is over the duration of the run before.  After a command
  of 6 s belief is widened by a third, after a recording of a minute little of it is left.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.classify.folds import units_of
from terrain.errors import ConfigError, DataError
from terrain.records import Array

#: Mean time on one ground: assumed. Robots of the thesis cross fields and paths at 0.5 to 1 m/s, so 10 to 20 m.
DWELL_S = 20.0
#: Time between windows that bring evidence of their own. The length of a window would be right of windows that err
#: independently of the ground's age, but makes a change of ground cost seconds. A settled belief has to be outweighed
#: by about 6 nats (0.98 against the 0.002 of a ground that may have come since the last window), and a window at 0.8
#: among five classes brings 2.8: at 0.4 s a change is found within 1 s of windows on the new ground, beside the time
#: in which windows hold samples of both. 0.25, 0.5, 1 and 2 s were compared on spliced courses of BorealTC and Vulpi,
#: where accuracy falls beyond 0.5 s: the value was chosen with these figures in view.
EVIDENCE_S = 0.4
THRESHOLD = 0.5  #: Above it one terrain is more likely than all others and "unknown" together.
#: Assumed share of windows that follow no class, as at an obstacle; it bounds the evidence of a window.
OUTLIER_RATIO = 0.02
#: Assumed share of grounds that no class describes; it only decides where no class is likely.
UNKNOWN_RATIO = 0.05
#: Assumed share of the windows of a terrain that was never learned that are found to be unknown. It is 0.17 of those
#: of BorealTC, each terrain left out in turn, at the threshold that keeps 95 % of known windows.
DETECTED_RATIO = 0.2
#: Share of windows of learned terrains that are taken for unknown, by the definition of the threshold.
KNOWN_FLAGGED_RATIO = 0.05


#: Powers of the shares and weights of novelty, what is preferred first: the square root lies between what a posterior
#: that holds the shares and one that holds none of them need, and unknown ground is found by novelty alone.
SHARE_POWERS, NOVELTY_WEIGHTS = (0.5, 0.25, 0.75, 0.0, 1.0), (1.0, 0.5, 0.0)
#: Standard errors by which an accuracy has to be lower to be distinguished
DISTINCT = 2.0


class FilterSettings(NamedTuple):
    """What the outputs of a classifier are as evidence."""

    prior: Array  #: (k,) share of each class among the training windows
    share_power: float = SHARE_POWERS[0]  #: power of these shares by which outputs are divided, 0 to 1
    novelty_weight: float = NOVELTY_WEIGHTS[0]  #: of the log-likelihood of novelty, 0 to 1

    def likelihood(self, probability: Array) -> Array:
        """Return the likelihood (k,) of each class, against that of all grounds together, by an output (k,)."""
        k = len(self.prior)
        divided = k * np.asarray(probability) / (k * self.prior) ** self.share_power
        return np.asarray((1.0 - OUTLIER_RATIO) * divided + OUTLIER_RATIO)


class FilterBelief(NamedTuple):
    """Probability of each state (k + 1,), "unknown" last, and the time since the last output in s."""

    probability: Array
    silent_s: float = math.inf


def check_settings(
    prior: Sequence[float],
    share_power: float = SHARE_POWERS[0],
    novelty_weight: float = NOVELTY_WEIGHTS[0],
) -> FilterSettings:
    """Return settings; ``ConfigError`` where there are fewer than two classes, or a number is not within 0 and 1."""
    if len(prior) < 2:
        raise ConfigError(f"terrain filter: {len(prior)} classes, at least 2 are required")
    for number, share in enumerate(prior, start=1):
        if not 0.0 < share < 1.0:
            raise ConfigError(
                f"terrain filter: prior of class {number} is {share!r}, a number between 0 and 1 is required"
            )
    for name, value in (("share power", share_power), ("novelty weight", novelty_weight)):
        if not 0.0 <= value <= 1.0:
            raise ConfigError(f"terrain filter: {name} is {value!r}, a number from 0 to 1 is required")
    return FilterSettings(np.array(prior, dtype=float), share_power, novelty_weight)


def grounds_of(n_classes: int) -> Array:
    """Return the share of each state (k + 1,) among the grounds that are come to; "unknown" is the last."""
    return np.append(np.full(n_classes, (1.0 - UNKNOWN_RATIO) / n_classes), UNKNOWN_RATIO)


def filter_step(
    belief: FilterBelief, probability: Array, dt_s: float, settings: FilterSettings, novelty: float = 0.0
) -> FilterBelief:
    """Return the belief after a time, and one output of the classifier: probabilities (k,), NaN where there is none.

    ``novelty`` is the log-likelihood of "unknown" against that of all known grounds together.
    """
    grounds = grounds_of(len(settings.prior))
    stays = math.exp(-dt_s / (DWELL_S * (1.0 - grounds[0])))
    now = stays * belief.probability + (1.0 - stays) * grounds
    silent_s = belief.silent_s + dt_s
    if not np.isfinite(probability).all():
        return FilterBelief(now, silent_s)
    power = min(silent_s / EVIDENCE_S, 1.0)
    now[:-1] *= settings.likelihood(probability) ** power
    if math.isfinite(novelty):
        now[-1] *= math.exp(power * settings.novelty_weight * novelty)
    return FilterBelief(now / now.sum(), 0.0)


def filter_run(
    probability: Array, time_s: Array, settings: FilterSettings, novelty: Array | None = None
) -> Array:
    """Return the belief (n, k + 1) after each of the windows of a run; it knows nothing of later ones.

    Parameters
    ----------
    probability : (n, k) class probabilities; rows of NaN where the classifier refused a window
    time_s : (n,) end of each window, not decreasing
    settings : what these are as evidence
    novelty : (n,) log-likelihood of "unknown" against that of all known grounds together; 0 by default

    Raises
    ------
    DataError
        if shapes do not fit, or time goes back.

    Examples
    --------
    >>> probability = np.repeat([[0.9, 0.1], [0.1, 0.9]], 24, axis=0)
    >>> belief = filter_run(probability, np.arange(48) / 4, check_settings((0.5, 0.5)))
    >>> float((reported(belief[24:]) == 1).argmax() / 4)  # s from the change to where it is reported
    0.75
    """
    rows, time_s = np.asarray(probability, dtype=np.float64), np.asarray(time_s, dtype=np.float64)
    k = len(settings.prior)
    if rows.shape != (len(time_s), k):
        needed = f"({len(time_s)}, {k})"
        raise DataError(f"class probabilities have the shape {rows.shape}, {needed} is needed")
    scores = np.zeros(len(rows)) if novelty is None else np.asarray(novelty, dtype=np.float64)
    if scores.shape != time_s.shape:
        raise DataError(f"{len(scores)} scores of novelty do not fit {len(time_s)} windows")
    dt_s = np.diff(time_s, prepend=time_s[:1])
    if not (dt_s >= 0.0).all():
        raise DataError("the windows of a run must be in order of time")
    belief, out = FilterBelief(grounds_of(k)), np.empty((len(rows), k + 1))
    for i, (row, step_s, score) in enumerate(zip(rows, dt_s.tolist(), scores.tolist(), strict=True)):
        belief = filter_step(belief, row, step_s, settings, score)
        out[i] = belief.probability
    return out


def session_time(end_s: Array, run: Array, length_s: float) -> Array:
    """Return the ends (n,) of the windows of a session on one clock: runs (n,) follow each other, with time between.

    Examples
    --------
    >>> session_time(np.array([2.0, 4.0, 2.0, 4.0]), np.array(["a", "a", "b", "b"]), 2.0).tolist()
    [2.0, 4.0, 10.0, 12.0]
    """
    time_s, begin_s = np.array(end_s, dtype=float), None
    for rows in np.split(np.arange(len(run)), np.flatnonzero(run[1:] != run[:-1]) + 1):
        first_s, last_s = time_s[rows[[0, -1]]]
        time_s[rows] += 0.0 if begin_s is None else begin_s - (first_s - length_s)
        begin_s = time_s[rows[-1]] + (last_s - first_s + length_s)
    return time_s


def filter_sessions(
    probability: Array,
    end_s: Array,
    groups: Array,
    length_s: float,
    settings: FilterSettings,
    novelty: Array | None = None,
) -> Array:
    """Return the belief (n, k + 1) after each of the windows of runs: it goes on through a session.

    Parameters
    ----------
    probability, settings, novelty : as of :func:`filter_run`
    end_s, length_s : (n,) end of each window on the clock of its run, and their length
    groups : (n, 2) session and run of each; runs of a session in the order in which they were driven
    """
    belief = np.empty((len(end_s), len(settings.prior) + 1))
    (_, session), (runs, run) = (np.unique(each, return_inverse=True) for each in np.transpose(groups))
    appears = np.full(len(runs), len(run))
    np.minimum.at(appears, run, np.arange(len(run)))
    order = np.lexsort((end_s, appears[run], session))
    for rows in np.split(order, np.flatnonzero(np.diff(session[order])) + 1):
        time_s = session_time(end_s[rows], run[rows], length_s)
        scores = None if novelty is None else novelty[rows]
        belief[rows] = filter_run(probability[rows], time_s, settings, scores)
    return belief


def reported(belief: Array) -> Array:
    """Return the class (n,) that is certain enough in each belief (n, k + 1); -1 for "unknown"."""
    best = belief[:, :-1].argmax(axis=1)
    certain = belief[np.arange(len(belief)), best] >= THRESHOLD
    return np.asarray(np.where(certain, best, -1))


def novelty_evidence(novelty: Array, unknown: Array) -> Array:
    """Return the log-likelihood (n,) of an unknown terrain against the learned ones; 0 without a score."""
    flagged = math.log(DETECTED_RATIO / KNOWN_FLAGGED_RATIO)
    passed = math.log((1.0 - DETECTED_RATIO) / (1.0 - KNOWN_FLAGGED_RATIO))
    return np.asarray(np.where(np.isnan(novelty) & ~unknown, 0.0, np.where(unknown, flagged, passed)))


def choose_settings(
    held_out: Array | None,
    terrain: Array,
    end_s: Array,
    groups: Array,
    length_s: float,
    prior: Mapping[str, float],
    novelty: Array | None = None,
) -> FilterSettings | None:
    """Return the settings under which the filter is right most often; None where single windows are.

    Of those that are no worse than single windows and cannot be distinguished from the best one, the first in the order
    of :data:`SHARE_POWERS` and :data:`NOVELTY_WEIGHTS`: a mean difference over sessions, or runs where no class has
    several sessions, is distinguished beyond :data:`DISTINCT` standard errors.  "unknown" counts as wrong.

    Parameters
    ----------
    held_out : (n, k) probabilities of windows when their runs or sessions were held out, NaN where they were not; where
        there are none, the settings are those that are preferred
    terrain : (n,) class of each window
    end_s, groups, length_s, novelty : as of :func:`filter_sessions`
    prior : share of each of the k classes among the training windows, in order
    """
    classes, shares = np.array([*prior]), check_settings([*prior.values()]).prior
    weights = NOVELTY_WEIGHTS[:1] if novelty is None else NOVELTY_WEIGHTS
    choices = [FilterSettings(shares, power, weight) for weight in weights for power in SHARE_POWERS]
    if held_out is None or not (there := np.isfinite(held_out).all(axis=1)).any():
        return choices[0]
    truth = np.searchsorted(classes, terrain)
    right = np.empty((len(choices), there.sum()))
    for i, settings in enumerate(choices):
        belief = filter_sessions(held_out, end_s, groups, length_s, settings, novelty)
        right[i] = (reported(belief) == truth)[there]
    single = np.mean(held_out[there].argmax(axis=1) == truth[there])
    accuracy = right.mean(axis=1)
    unit = units_of(truth, groups)[there]
    behind = right[accuracy.argmax()] - right
    errors = np.array([_standard_error(each, unit) for each in behind])
    among = np.flatnonzero((accuracy >= single) & (behind.mean(axis=1) <= DISTINCT * errors))
    return choices[among[0]] if len(among) else None


def _standard_error(values: Array, unit: Array) -> float:
    """Return the standard error of the mean of values (n,) that are independent from unit to unit (n,) only."""
    _, place = np.unique(unit, return_inverse=True)
    sums = np.bincount(place, values - values.mean())
    n = len(sums)
    return math.sqrt(n / (n - 1) * float(np.square(sums).sum())) / len(values) if n > 1 else math.inf


class LiveTerrainFilter:
    """The filter from one output of the classifier to the next, as they come.

    Examples
    --------
    >>> live = LiveTerrainFilter(check_settings((0.5, 0.5)))
    >>> for end_s in (2.0, 2.25, 2.5, 2.75):
    ...     best, probability = live.take(end_s, np.array([0.9, 0.1]))
    >>> best, round(probability, 2)
    (0, 0.97)
    """

    def __init__(self, settings: FilterSettings) -> None:
        self._settings, self._belief = settings, FilterBelief(grounds_of(len(settings.prior)))
        self._end_s = math.nan

    def restart(self, gap_s: float) -> None:
        """Go on, after a time without windows, with windows on another clock: belief stays, and is widened."""
        nothing = np.full(len(self._settings.prior), math.nan)
        self._belief = filter_step(self._belief, nothing, gap_s, self._settings)
        self._end_s = math.nan

    def take(
        self, end_s: float, probability: Array, novelty: float = math.nan, unknown: bool = False
    ) -> tuple[int, float]:
        """Return the class after a window, and its probability; -1 and NaN where none is certain enough.

        Probabilities that are NaN let the belief widen; a window that does not end after the last is no
        evidence, but the next one is.
        """
        first, dt_s = math.isnan(self._end_s), end_s - self._end_s
        self._end_s = end_s  # also where it goes back, so that a clock that was set does not stop the filter
        if first or dt_s > 0.0:
            dt_s = 0.0 if first else dt_s
            evidence = float(novelty_evidence(np.array([novelty]), np.array([unknown]))[0])
            self._belief = filter_step(self._belief, probability, dt_s, self._settings, evidence)
        belief = self._belief.probability
        best = int(reported(belief[None])[0])
        return best, float(belief[best]) if best >= 0 else math.nan
