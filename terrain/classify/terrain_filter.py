r"""Causal filter over the class probabilities of windows: the terrain now, or "unknown".

Hidden Markov model with k classes and the state "unknown", in continuous time.  With state probabilities
:math:`b` and a step :math:`\Delta t`:

.. math::

    \text{transition:}\quad & \bar b = e^{-r\,\Delta t}\, b + (1 - e^{-r\,\Delta t})\, \pi \\
    \text{emission:}\quad & b_c \propto \bar b_c\, \ell_c^{\lambda}, \qquad
    \ell_c = (1 - \varepsilon)\, p_c / q_c + \varepsilon, \qquad \ell_\text{unknown} = \nu \\
    \text{evidence:}\quad & \lambda = \min(\Delta t_\text{output} / T, 1)

- A ground holds for a mean dwell D; then the next one is drawn from :math:`\pi`, uniform over the classes
  beside a small share of "unknown".  As a draw may repeat the ground, :math:`r = 1 / (D (1 - \pi_c))`.  Two
  steps are one long step exactly, so that a gap in time or a refused window is a longer transition and no
  special case.
- A classifier gives the posterior p under the class shares q of its training; the likelihood is p / q up to a
  factor (Bourlard and Morgan 1994, chapter 7), which a share :math:`\varepsilon` of windows that follow no
  model bounds.  Of an unknown ground, windows are as frequent as of all grounds together: likelihood 1, or
  :math:`\nu` where a score of novelty is given.
- Windows that overlap repeat each other: one that comes :math:`\Delta t_\text{output}` after the last adds
  that part of a window's evidence, to the power :math:`\lambda` (Gruenwald and van Ommen 2017 call it the
  learning rate).  Below T, any stride gives the same evidence per second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

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


class FilterBelief(NamedTuple):
    """Probability of each state (k + 1,), "unknown" last, and the time since the last output in s."""

    probability: Array
    silent_s: float = math.inf


def check_prior(prior: Sequence[float]) -> Array:
    """Return the shares (k,) of the classes; ``ConfigError`` where they are fewer than two, or not within 0 and 1."""
    if len(prior) < 2:
        raise ConfigError(f"terrain filter: {len(prior)} classes, at least 2 are required")
    for number, share in enumerate(prior, start=1):
        if not 0.0 < share < 1.0:
            raise ConfigError(
                f"terrain filter: prior of class {number} is {share!r}, a number between 0 and 1 is required"
            )
    return np.array(prior, dtype=float)


def grounds_of(n_classes: int) -> Array:
    """Return the share of each state (k + 1,) among the grounds that are come to; "unknown" is the last."""
    return np.append(np.full(n_classes, (1.0 - UNKNOWN_RATIO) / n_classes), UNKNOWN_RATIO)


def filter_step(
    belief: FilterBelief, probability: Array, dt_s: float, prior: Array, novelty: float = 0.0
) -> FilterBelief:
    """Return the belief after a time, and one output of the classifier: probabilities (k,), NaN where there is none.

    ``prior`` (k,) has the share of each class among the training windows, ``novelty`` is the log-likelihood of
    "unknown" against that of all known grounds together.
    """
    grounds = grounds_of(len(prior))
    stays = math.exp(-dt_s / (DWELL_S * (1.0 - grounds[0])))
    now = stays * belief.probability + (1.0 - stays) * grounds
    silent_s = belief.silent_s + dt_s
    if not np.isfinite(probability).all():
        return FilterBelief(now, silent_s)
    power = min(silent_s / EVIDENCE_S, 1.0)
    now[:-1] *= ((1.0 - OUTLIER_RATIO) * np.asarray(probability) / prior + OUTLIER_RATIO) ** power
    if math.isfinite(novelty):
        now[-1] *= math.exp(power * novelty)
    return FilterBelief(now / now.sum(), 0.0)


def filter_run(probability: Array, time_s: Array, prior: Array, novelty: Array | None = None) -> Array:
    """Return the belief (n, k + 1) after each of the windows of a run; it knows nothing of later ones.

    Parameters
    ----------
    probability : (n, k) class probabilities; rows of NaN where the classifier refused a window
    time_s : (n,) end of each window, not decreasing
    prior : (k,) share of each class among the training windows
    novelty : (n,) log-likelihood of "unknown" against that of all known grounds together; 0 by default

    Raises
    ------
    DataError
        if shapes do not fit, or time goes back.

    Examples
    --------
    >>> probability = np.repeat([[0.9, 0.1], [0.1, 0.9]], 24, axis=0)
    >>> belief = filter_run(probability, np.arange(48) / 4, np.array([0.5, 0.5]))
    >>> float((reported(belief[24:]) == 1).argmax() / 4)  # s from the change to where it is reported
    0.75
    """
    rows, time_s = np.asarray(probability, dtype=np.float64), np.asarray(time_s, dtype=np.float64)
    if rows.shape != (len(time_s), len(prior)):
        needed = f"({len(time_s)}, {len(prior)})"
        raise DataError(f"class probabilities have the shape {rows.shape}, {needed} is needed")
    scores = np.zeros(len(rows)) if novelty is None else np.asarray(novelty, dtype=np.float64)
    if scores.shape != time_s.shape:
        raise DataError(f"{len(scores)} scores of novelty do not fit {len(time_s)} windows")
    dt_s = np.diff(time_s, prepend=time_s[:1])
    if not (dt_s >= 0.0).all():
        raise DataError("the windows of a run must be in order of time")
    belief, out = FilterBelief(grounds_of(len(prior))), np.empty((len(rows), len(prior) + 1))
    for i, (row, step_s, score) in enumerate(zip(rows, dt_s.tolist(), scores.tolist(), strict=True)):
        belief = filter_step(belief, row, step_s, prior, score)
        out[i] = belief.probability
    return out


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


class LiveTerrainFilter:
    """The filter from one output of the classifier to the next, as they come.

    Examples
    --------
    >>> live = LiveTerrainFilter(np.array([0.5, 0.5]))
    >>> for end_s in (2.0, 2.25, 2.5, 2.75):
    ...     best, probability = live.take(end_s, np.array([0.9, 0.1]))
    >>> best, round(probability, 2)
    (0, 0.97)
    """

    def __init__(self, prior: Array) -> None:
        self._prior, self._belief = prior, FilterBelief(grounds_of(len(prior)))
        self._end_s = math.nan

    def take(
        self, end_s: float, probability: Array, novelty: float = math.nan, unknown: bool = False
    ) -> tuple[int, float]:
        """Return the class after a window, and its probability; -1 and NaN where none is certain enough.

        Probabilities that are NaN let the belief widen; a window that does not end after the last is no
        evidence.
        """
        dt_s = 0.0 if math.isnan(self._end_s) else end_s - self._end_s
        if dt_s > 0.0 or math.isnan(self._end_s):
            self._end_s = end_s
            evidence = float(novelty_evidence(np.array([novelty]), np.array([unknown]))[0])
            self._belief = filter_step(self._belief, probability, dt_s, self._prior, evidence)
        belief = self._belief.probability
        best = int(reported(belief[None])[0])
        return best, float(belief[best]) if best >= 0 else math.nan
