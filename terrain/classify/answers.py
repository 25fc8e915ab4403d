r"""Whether the ground answers as the named terrain does: laws of response by terrain, and an alarm where none holds.

What is observed of the robot (yaw rate, shaking, motor currents, slip) depends on how its wheels are driven and on the
ground.  For each terrain c and each quantity y there is a law

.. math:: y = x^T (b_c + u_s) + e ,\qquad u_s \sim N(0, \Omega_c) ,\qquad e \sim t_5(0, \sigma_c^2)

of numbers x of the driving, with coefficients that differ by u_s from session to session (from run to run where runs
name no sessions), and scatter e within.  It is fitted by expectation and maximisation (Laird and Ware 1982,
Random-effects models for longitudinal data), with weights of the Student distribution for e (Lange et al. 1989).
The scatter between sessions is that of the terrain's own sessions and, as if there were :data:`PRIOR_UNITS` more, that
of all terrains: a terrain that was driven in one session varies as others do.

The misfit of a window of a new session is

.. math:: |z| = |y - x^T b_c| / \sqrt{x^T (V_c + \Omega_c) x + \sigma_c^2} ,

V the covariance of the coefficients: driving that the terrain was never seen with says little, and so does a robot
that drives straight on about turning.  Misfits are divided by the limit under which 95 % of held-out windows of the
terrain's own lie, quantity by quantity.  A terrain fits as well as its worst quantity does; the score is the misfit of
the best terrain.  Misfits are averaged over a manoeuvre, the windows of a run in the last :data:`MANOEUVRE_S`, before
the best terrain is sought: one terrain has to explain all of them, and the first window stands for itself.

**Unknown** is a window that either this or novelty, which compares with windows that were seen, finds so.  With the
tail probabilities ``P = (n_above + 1) / (n + 1)`` of both among held-out windows of known terrains the joint score is
:math:`\sqrt{\log^2 P_1 + \log^2 P_2}`: one strong alarm is enough, which in a mean (Fisher's sum) the noise of the
other would hide; two weak ones add up.  Its threshold keeps a given part of the windows of a new session or run, as
that of novelty does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.classify.folds import TOO_FEW, inner_splits, two_classes, units_of
from terrain.classify.limits import (
    KNOWN_KEPT,
    MAX_REFERENCE,
    N_INNER_FOLDS,
    conformal_threshold,
    rarities,
)
from terrain.errors import DataError
from terrain.records import Array

FREEDOM = 5.0  #: Of the Student distribution of scatter: a few windows of a run differ by more than most do.
#: Variances of a coefficient before data, in squared spreads of the response: where a law was not seen, anything goes.
PRIOR = 10.0
PRIOR_SCATTER = 0.01  #: Of a coefficient between sessions, as variance: as of two sessions more.
PRIOR_NOISE = 0.0025  #: Variance of the scatter within, as of five windows more: a counter that never moves
PRIOR_UNITS = 5.0  #: The scatter of all terrains counts as that of so many sessions beside a terrain's own.
N_WEIGHTINGS, N_STEPS = 4, 15
MANOEUVRE_S = 6.0  #: So long a command of DRIVE lasts.
#: Of the windows: a quantity that is known in fewer has no law, nor has one that is known in one unit only.
MIN_KNOWN = 0.1
MIN_LIMIT = 1.0  #: Of a quantity's limit in standard deviations

#: What a terrain does not do, by the first word of the quantity.
VERBS = {
    "turn": "turn like this",
    "shake": "shake like this",
    "current": "draw such currents",
    "slip": "slip like this",
}


class Observed(NamedTuple):
    """What the ground answered in n windows, quantity by quantity, and the numbers of driving that it depends on."""

    quantities: tuple[str, ...]
    response: Array  #: (n, q); NaN where it is not known
    driving: Array  #: (n, q, p); 0 where a quantity has fewer numbers

    def of(self, rows: Array) -> Observed:
        """Return what was observed in some of the windows."""
        return Observed(self.quantities, self.response[rows], self.driving[rows])

    def only(self, quantities: tuple[str, ...]) -> Observed:
        """Return some of the quantities."""
        if quantities == self.quantities:
            return self
        places = [self.quantities.index(name) for name in quantities]
        return Observed(quantities, self.response[:, places], self.driving[:, places])


class Answers(NamedTuple):
    """The laws of all terrains, and from where on none of them holds."""

    classes: tuple[str, ...]
    quantities: tuple[str, ...]
    scale: Array  #: (q, p) of the numbers of driving
    centre: Array  #: centre, spread: (q,) of the responses
    spread: Array
    coefficients: Array  #: (q, k, p) of scaled numbers and responses
    covariance: Array  #: (q, k, p, p) of the coefficients of a new session
    noise: Array  #: (q, k) variance within a session
    limit: Array  #: (q,) of the misfit of a terrain's own windows
    reference: Array  #: (r, 2) ascending scores of novelty and of misfit of held-out windows; novelty NaN without one
    threshold: float  #: of the joint score, above which a window is unknown

    def misfits(self, observed: Observed | None) -> Array:
        """Return misfits (n, k, q), each over its limit; NaN where a response is not known.

        ``DataError`` where other quantities are observed.
        """
        if observed is None or not set(self.quantities) <= set(observed.quantities):
            raise DataError(f"the windows do not show what the laws are of: {', '.join(self.quantities)}")
        observed = observed.only(self.quantities)
        x = observed.driving / self.scale
        y = (observed.response - self.centre) / self.spread
        apart = y[:, :, None] - np.einsum("nqp,qkp->nqk", x, self.coefficients)
        variance = np.einsum("nqp,qkpr,nqr->nqk", x, self.covariance, x) + self.noise
        return np.asarray((np.abs(apart) / np.sqrt(variance) / self.limit[:, None]).swapaxes(1, 2))

    def reason(self, misfits: Array, terrain: str) -> str:
        """Return in words what a terrain does not do, of the misfits (k, q) of a manoeuvre, one of which is known."""
        quantity = self.quantities[int(np.nanargmax(misfits[self.classes.index(terrain)]))]
        return f"{terrain} does not {VERBS[quantity.split(',')[0]]}"


def best_misfit(misfits: Array) -> Array:
    """Return the score (n,) of misfits (n, k, q): of the best terrain, by its worst quantity; NaN where none is known.

    Examples
    --------
    >>> best_misfit(np.array([[[0.5, 2.0], [0.9, np.nan]], [[np.nan, np.nan], [np.nan, np.nan]]]))
    array([0.9, nan])
    """
    worst = np.where(np.isfinite(misfits), misfits, -np.inf).max(axis=2)
    worst = np.where(np.isfinite(worst), worst, np.inf)
    best: Array = worst.min(axis=1)
    return np.where(np.isfinite(best), best, np.nan)


def over_manoeuvre(misfits: Array, end_s: Array, run: Array) -> Array:
    """Return the mean (n, ...) of the misfits of the windows of a run that ended in the last 6 s; NaN is left out.

    Windows (n,) of a run are in order of time.

    Examples
    --------
    >>> over_manoeuvre(np.array([1.0, 3.0, 5.0, 7.0]), np.array([2.0, 4.0, 9.0, 2.0]), np.array(["a", "a", "a", "b"]))
    array([1., 2., 4., 7.])
    """
    known = np.isfinite(misfits)
    filled, out, first = np.where(known, misfits, 0.0), np.empty_like(misfits, dtype=float), 0
    for row in range(len(misfits)):
        while run[first] != run[row] or end_s[first] <= end_s[row] - MANOEUVRE_S + 1e-6:
            first += 1
        total, n = filled[first : row + 1].sum(axis=0), known[first : row + 1].sum(axis=0)
        out[row] = np.divide(total, n, out=np.full(np.shape(total), np.nan), where=n > 0)
    return out


def _fit_law(y: Array, x: Array, class_of: Array, unit: Array, n_classes: int) -> tuple[Array, ...]:
    """Return the law of responses (n,) at numbers of driving (n, p), of classes and units (n,) as numbers.

    That is scale (p,), centre and spread, and by terrain coefficients, their covariance and the noise.
    """
    scale = np.sqrt(np.square(x).mean(axis=0))
    scale[scale < 1e-9] = 1.0
    centre, spread = y.mean(), np.maximum(y.std(), 1e-9)
    x, y = x / scale, (y - centre) / spread
    key, block = np.unique(np.stack([class_of, unit], axis=1), axis=0, return_inverse=True)
    block, of = block.ravel(), key[:, 0]
    n_blocks, p, none = len(key), x.shape[1], np.asarray(np.eye(x.shape[1]))
    n_rows = np.bincount(class_of, minlength=n_classes)
    n_units = np.bincount(of, minlength=n_classes)
    scatter, noise = np.full((n_classes, p), 0.05), np.full(n_classes, 0.3)
    coefficients, weight = np.zeros((n_classes, p)), np.ones(len(y))
    covariance: Array = np.zeros((n_classes, p, p))
    for _ in range(N_WEIGHTINGS):
        squares, products = np.zeros((n_blocks, p, p)), np.zeros((n_blocks, p))
        np.add.at(squares, block, x[:, :, None] * x[:, None, :] * weight[:, None, None])
        np.add.at(products, block, x * (weight * y)[:, None])
        total = np.bincount(block, weight * y * y)
        for _ in range(N_STEPS):
            known = squares / noise[of][:, None, None]
            own = np.linalg.inv(known + none / scatter[of][:, None, :])  # covariance of a unit's u
            information, sums = np.zeros((n_classes, p, p)), np.zeros((n_classes, p))
            np.add.at(information, of, known - known @ own @ known)
            right = products / noise[of][:, None]
            np.add.at(sums, of, right - np.einsum("bij,bj->bi", known @ own, right))
            covariance = np.linalg.inv(information + none / PRIOR)
            coefficients = np.einsum("kij,kj->ki", covariance, sums)
            left = right - np.einsum("bij,bj->bi", known, coefficients[of])
            apart = np.einsum("bij,bj->bi", own, left)
            square = np.zeros((n_classes, p))
            np.add.at(square, of, apart**2 + np.einsum("bii->bi", own))
            pooled = (square.sum(axis=0) + 2.0 * PRIOR_SCATTER) / (n_blocks + 2.0)
            scatter = (square + PRIOR_UNITS * pooled) / (n_units + PRIOR_UNITS)[:, None]
            b = coefficients[of] + apart
            rest = total - 2.0 * (products * b).sum(axis=1) + np.einsum("bi,bij,bj->b", b, squares, b)
            rest += np.einsum("bij,bji->b", squares, own)
            noise = (np.bincount(of, rest, n_classes) + 5.0 * PRIOR_NOISE) / (n_rows + 5.0)
        residual = y - (x * b[block]).sum(axis=1)
        weight = (FREEDOM + 1.0) / (FREEDOM + residual**2 / noise[class_of])
    new = covariance + none * scatter[:, None, :]
    return scale, centre, spread, coefficients, new, noise


def _fit(observed: Observed, y: Array, unit: Array, classes: Array) -> Answers:
    """Return the laws without limits and thresholds."""
    class_of, unit_of = np.searchsorted(classes, y), np.unique(unit, return_inverse=True)[1]
    laws = []
    for number in range(len(observed.quantities)):
        x, response = observed.driving[:, number], observed.response[:, number]
        rows = np.isfinite(response)
        laws.append(_fit_law(response[rows], x[rows], class_of[rows], unit_of[rows], len(classes)))
    scale, centre, spread, *rest = (np.stack(each) for each in zip(*laws, strict=True))
    names, without = tuple(map(str, classes)), (np.ones(len(laws)), np.zeros((0, 2)), np.inf)
    return Answers(names, observed.quantities, scale, centre, spread, rest[0], rest[1], rest[2], *without)


def learn_answers(
    observed: Observed,
    y: Array,
    groups: Array,
    end_s: Array,
    novelty: Array | None = None,
    *,
    gap: int = 1,
    seed: int = 0,
) -> Answers:
    """Return the laws of training windows.

    Parameters
    ----------
    observed : what the ground answered in the windows; those of a run in order of time
    y, groups, end_s : terrain, run (n,) or session and run (n, 2), and end of each window
    novelty : scores (n,) of windows whose units were held out, which share the threshold
    gap : rows left out beside a block, where the only run of a class is cut
    seed : deals units into inner folds

    Raises
    ------
    DataError
        if there is one class only, or rows are too few to hold some of them out.
    """
    y, groups = np.asarray(y).astype(str), np.asarray(groups, dtype=str).reshape(len(y), -1)
    classes, unit = two_classes(y), units_of(y, groups)
    splits, known = list(inner_splits(y, groups, N_INNER_FOLDS, seed, gap)), np.isfinite(observed.response)
    share = np.all(
        [known.mean(axis=0) >= MIN_KNOWN, *(known[train].any(axis=0) for train, _ in splits)], axis=0
    )
    if not share.any():
        raise DataError(f"of {', '.join(observed.quantities)} too few are known")
    observed = observed.only(tuple(np.array(observed.quantities)[share].tolist()))
    misfits = np.full((len(y), len(classes), len(observed.quantities)), np.nan)
    for train, test in splits:
        misfits[test] = _fit(observed.of(train), y[train], unit[train], classes).misfits(observed.of(test))
    own = misfits[np.arange(len(y)), np.searchsorted(classes, y)]
    if not np.isfinite(own).any(axis=0).all():
        raise DataError(TOO_FEW)
    limit = np.maximum(np.nanquantile(own, KNOWN_KEPT, axis=0), MIN_LIMIT)
    score = best_misfit(over_manoeuvre(misfits / limit, end_s, groups[:, -1]))
    novelty = np.full(len(y), np.nan) if novelty is None else novelty
    known = np.isfinite(score)
    reference = np.sort(np.stack([novelty[known], score[known]], axis=1), axis=0)
    if len(reference) > MAX_REFERENCE:
        reference = reference[np.linspace(0, len(reference) - 1, MAX_REFERENCE).round().astype(int)]
    joint = joint_score(reference, novelty[known], score[known])
    threshold = conformal_threshold(joint, unit[known], KNOWN_KEPT, np.inf)
    return _fit(observed, y, unit, classes)._replace(limit=limit, reference=reference, threshold=threshold)


def joint_score(reference: Array, novelty: Array, misfit: Array) -> Array:
    """Return the joint score (n,) of novelty and misfit (n,) by the reference (r, 2) of both."""
    return np.asarray(np.linalg.norm(rarities(reference, np.stack([novelty, misfit], axis=1)), axis=1))


def check_answers(answers: Answers, classes: tuple[str, ...], observed: Observed | None) -> None:
    """Refuse by ``DataError`` laws that are of other classes or of what windows do not show, or are no numbers."""
    if (
        observed is None
        or answers.classes != classes
        or not set(answers.quantities) <= set(observed.quantities)
    ):
        raise DataError("the laws of response are of other terrains, or of what the windows do not show")
    q, k, p = len(answers.quantities), len(classes), observed.driving.shape[2]
    shapes = ((q, p), (q,), (q,), (q, k, p), (q, k, p, p), (q, k), (q,), (len(answers.reference), 2), ())
    for name, array, shape in zip(Answers._fields[2:], map(np.asarray, answers[2:]), shapes, strict=True):
        known = array[:, 1:] if name == "reference" and array.ndim == 2 else array  # there may be no novelty
        if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(known).all():
            raise DataError(f"the {name} of the laws of response are not {shape} finite numbers")
    if (
        not q
        or min(answers.scale.min(), answers.spread.min(), answers.noise.min(), answers.limit.min()) <= 0.0
    ):
        raise DataError("the scales of the laws of response are not above zero")
