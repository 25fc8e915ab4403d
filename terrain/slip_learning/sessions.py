r"""Slip of a surface by session: what runs of one session share is no evidence of what another day does.

Runs of a session share load, tyres, weather and place, so that a surface's slip differs more between sessions than
its runs within one let expect.  The unit is the session, the median :math:`y_k` over its runs; runs that name no
session count as one.  With K sessions of a surface, their mean :math:`\bar y` and their variance :math:`s^2` of
:math:`\nu` degrees of freedom, a *new* session's slip is within

.. math:: \bar y \pm t_{\nu, 0.975} \, s \sqrt{1 + 1 / K}

with 95 % (prediction interval of a normal law; Hahn and Meeker, Statistical Intervals, 1991, 4.7).  The variance is
the surface's own from :data:`MIN_SESSIONS` on (:math:`\nu = K - 1`).  With fewer it is pooled over all surfaces
(:math:`\nu = \sum (K_j - 1)`, if that is two or more): which assumes that sessions differ alike on each.  Where that
cannot be, two sessions show their range, which contains the next one in a third of all cases (of three exchangeable
ones), and one shows nothing of another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from terrain.bootstrap import LEVEL, bootstrap_rows, percentile_interval
from terrain.records import Array

MIN_SESSIONS = 3  #: From fewer, how sessions of a surface differ is not known of it alone
N_DRAWS = 1000  #: Of runs, where there is one session


class IntervalOf(StrEnum):
    """What an interval of slip contains with 95 %, or that it is a range."""

    NEW_SESSION = "new session"
    POOLED = "new session, pooled"
    RANGE = "range of two"
    ONE_SESSION = "one session"

    @property
    def words(self) -> str:
        """The same in full."""
        return {
            IntervalOf.NEW_SESSION: "95 % of a new session",
            IntervalOf.POOLED: "95 % of a new session, spread of sessions pooled over surfaces",
            IntervalOf.RANGE: "range of two sessions, which contains a third in one case of three",
            IntervalOf.ONE_SESSION: "95 % within one session: what another day does is not shown",
        }[self]


class SessionSlip(NamedTuple):
    """Slip of a surface; NaN where it is not known."""

    slip_ratio: float  #: mean over sessions of the median over runs
    interval: tuple[float, float]
    interval_of: IntervalOf
    std: float  #: of the normal law with that interval; with two sessions, that of a new one
    n_sessions: int


def session_slips(
    surfaces: Mapping[str, tuple[Array, Array]], rng: np.random.Generator
) -> dict[str, SessionSlip]:
    """Return the slip of each surface, by its name; an empty name is no surface and adds nothing to others.

    Parameters
    ----------
    surfaces : (n,) slip and session of each run, by surface
    rng : of the draws of runs where there is one session

    Examples
    --------
    >>> session, slip = np.array(["a", "b", "c"]), np.array([0.04, 0.05, 0.06])
    >>> found = session_slips({"mud": (slip, session)}, np.random.default_rng(0))["mud"]
    >>> found.interval_of.value, [round(float(end), 3) for end in found.interval]
    ('new session', [0.0, 0.1])
    """
    medians = {
        name: np.array([np.median(slip[session == each]) for each in np.unique(session)])
        for name, (slip, session) in surfaces.items()
    }
    squares = {name: float(((each - each.mean()) ** 2).sum()) for name, each in medians.items() if each.size}
    named = [name for name in squares if name]
    pooled = sum(squares[name] for name in named), sum(medians[name].size - 1 for name in named)
    found = {}
    for name, (slip, _) in surfaces.items():
        values, k = medians[name], medians[name].size
        if k == 0:
            found[name] = SessionSlip(math.nan, (math.nan, math.nan), IntervalOf.ONE_SESSION, math.nan, 0)
            continue
        middle = float(values.mean())
        own = squares[name], k - 1
        square, freedom = own if k >= MIN_SESSIONS or not name else pooled
        if freedom >= MIN_SESSIONS - 1:
            half = stdtrit(freedom, (1 + LEVEL) / 2) * math.sqrt(square / freedom * (1 + 1 / k))
            interval = max(middle - half, -1.0), min(middle + half, 1.0)
            of = IntervalOf.NEW_SESSION if k >= MIN_SESSIONS else IntervalOf.POOLED
            std = float(half / ndtri((1 + LEVEL) / 2))
        elif k == MIN_SESSIONS - 1:
            interval, of = (float(values.min()), float(values.max())), IntervalOf.RANGE
            std = math.sqrt(own[0] * (1 + 1 / k))
        else:
            interval, of = (math.nan, math.nan), IntervalOf.ONE_SESSION
            if slip.size > 1:
                draws = np.median(slip[bootstrap_rows(slip.size, N_DRAWS, rng)], axis=1)
                interval = percentile_interval(draws)
            std = (interval[1] - interval[0]) / (2 * float(ndtri((1 + LEVEL) / 2)))
        found[name] = SessionSlip(middle, interval, of, std, k)
    return found
