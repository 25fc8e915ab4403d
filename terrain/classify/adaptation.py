r"""What shifts between sessions, found in a short drive: gain and offset of motor currents, level of vibration.

On one ground, with the wheels driven alike, the level of channel j in a window (mean magnitude of a current, standard
deviation of an IMU channel) is :math:`L_j(c, z)`: the mean of training windows of ground c that were driven nearly
alike (z: wheel speeds over their norm, and the norm).  In another session it is

.. math:: y_j = (1 + a)\,L_j + b + \epsilon_j, \qquad (a, b) = \theta_c = G + H_c ,

a load, a battery or a temperature (G: common to all grounds) and what the ground itself became (H: of each ground).  a
and b are of all currents; of vibration there is a gain only.  A priori G and H have the variances :math:`\rho P` and
:math:`(1 - \rho) P`.  P comes from the sessions of training, with a stated value counted as :data:`PRIOR_SESSIONS`
sessions.  Scatter :math:`\epsilon` is that of runs of one session; a run is one observation, its windows repeat it.

*A reference on a known ground* c gives the posterior of :math:`\theta_c` by linear least squares with the prior
(Gauss-Markov; Rasmussen and Williams 2006, 2.1), and by the covariance :math:`\rho P` that of other grounds: a drive on
grass says little of what ice became.  *An unlabelled reference* weighs draws of G by the likelihood of a mixture in
which each window is on any of the grounds; it says little where a gain and another ground look alike, as it should.

*Prediction* averages over the corrections that remain possible: for each ground c, :math:`2 d + 1` equally likely
values of :math:`\theta_c` (the points of Julier and Uhlmann 2004, Unscented filtering and nonlinear estimation), the
channels corrected by each, so that every recipe gains,

.. math:: p(c) \propto \tfrac1{2d + 1} \sum_i p\big(c \mid (x - b_{ci}) / (1 + a_{ci})\big) .

A probability is therefore not near one where a gain inside what is possible makes another ground of a window.

Gains of wheel speeds cannot be distinguished from slip by what a window holds, and are left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.records import WINDOW_COLUMNS, Array, Windows

GAIN_STD, OFFSET_STD = 0.2, 0.1
"""Between sessions, where none tell: gains of 0.6 to 1.4 (two standard deviations) hold an added load of 40 %;
offsets are in median levels of the currents."""

PRIOR_SESSIONS = 2.0
COMMON = 0.5  #: rho: part of the variance that all grounds of a session share; no data set yet shows it.
MIN_REFERENCE_S = 5.0
START_S = 20.0  #: The start of a session that is taken for a reference.
CERTAIN = 0.7
"""Of an adapted model: where no terrain is more probable, it is unknown.  Chosen on runs of the Robotino's one session,
in those held out of which currents of 0.9 to 1.4 times their values and offsets were hidden: 4 to 7 % of windows are
then wrong and not unknown (14 to 17 % as trained), at 0.6 it is 8 to 11 %."""

WIDTHS = (0.1, 0.2, 0.4)  #: Of "driven nearly alike", among which held-out runs choose.
MAX_ROWS = 400  #: Training windows of a ground and session that are kept, thinned evenly.
AT_ONCE_VALUES = 8_000_000  #: Of differences between windows and kept ones: 64 MB.
MIN_GAIN = 0.2
TIME_TOLERANCE_S = 1e-6
N_DRAWS = 1024
KINDS = {"currents": ("gain of currents", "offset of currents"), "imu": ("gain of vibration",)}


class Shift(NamedTuple):
    """What a reference shows: mean (k, d) and covariance (k, d, d) of theta for each terrain of the model."""

    terrain: str  #: of the reference; empty where it was not known
    length_s: float
    mean: Array
    cov: Array


class Adaptation(NamedTuple):
    """What was learned of sessions, and the shift of the present one.

    With m levels, d parameters, k terrains and p kept training windows.
    """

    classes: tuple[str, ...]
    #: levels, wheels: stream and channel of each level (m), and of each wheel speed
    levels: tuple[tuple[str, str], ...]
    wheels: tuple[tuple[str, str], ...]
    scale: Array  #: (m,) unit of each level
    parameters: tuple[str, ...]  #: (d) among :data:`KINDS`
    motion: Array  #: motion, level, of: (p, w + 1), (p, m) and (p,) z, levels and terrain of training windows
    level: Array
    of: Array
    fastest: float  #: norm of wheel speeds that counts as 1
    width: float
    run_std: Array  #: run_std, window_std: (m,) scatter of runs of a session and of windows of a run
    window_std: Array
    prior_std: Array  #: (d,) of theta between sessions
    n_sessions: int  #: that it was learned from
    #: whether inner sessions show a gain by the start of a session, so that it is used unasked
    shown: bool = False
    status: str = "not shown: never judged"
    #: of a session's start that is taken for a reference, "" where that is not known; None: no start is taken
    start: str | None = None
    shift: Shift | None = None  #: of the present session; None: as in training

    @property
    def found(self) -> str:
        """What was found, in a sentence; empty without a shift."""
        if (shift := self.shift) is None or not shift.length_s:
            return ""
        c = self.classes.index(shift.terrain) if shift.terrain else 0
        std, parts = np.sqrt(np.diagonal(shift.cov[c])), []
        for name, value, deviation in zip(self.parameters, shift.mean[c], std, strict=True):
            if name.startswith("offset"):
                unit = self.scale[_are_currents(self.levels)][0]
                parts.append(f"{value * unit:+.2f} A (+- {deviation * unit:.2f}) offset")
            else:
                what = name.rpartition(" ")[2]
                parts.append(f"{what} {1.0 + value:.2f} (+- {deviation:.2f}) times those of training")
        where = f"on {shift.terrain}" if shift.terrain else "on a ground that was not named"
        return f"{', '.join(parts)}, from {shift.length_s:.0f} s {where}"

    def of_start(self, terrain: str = "") -> Adaptation:
        """Return the adaptation as a session begins with it: any shift of the prior, until its start was a reference.

        ``ConfigError`` where that is named to be on a terrain that was not learned.
        """
        check_terrain(self, terrain)
        k, prior = len(self.classes), np.diag(self.prior_std**2)
        shift = Shift("", 0.0, np.zeros((k, len(prior))), np.repeat(prior[None], k, axis=0))
        return self._replace(start=terrain, shift=shift)


def learn_adaptation(
    windows: Windows, levels: Sequence[tuple[str, str]], wheels: Sequence[tuple[str, str]]
) -> Adaptation:
    """Return what labelled windows of training show of sessions; nothing is shifted.

    Parameters
    ----------
    levels : stream and channel of each current, and of each channel of an IMU
    wheels : of each wheel speed

    Raises
    ------
    DataError
        if there are no levels, or no terrain has two runs.
    """
    if not windows.values:
        raise DataError("windows of a cache have no samples")
    if not levels:
        raise DataError("the windows hold neither motor currents nor an IMU, whose levels could be compared")
    kept = _thinned(windows)
    windows = windows[kept]
    y, current = _levels(windows, levels), _are_currents(levels)
    scale = np.maximum(np.median(y, axis=0), 1e-9)
    if current.any():
        scale[current] = np.median(y[:, current])
    scale = np.where(scale > 0.0, scale, 1.0)
    kinds = [kind for kind, there in (("currents", current.any()), ("imu", not current.all())) if there]
    parameters = tuple(name for kind in kinds for name in KINDS[kind])
    default = np.array([OFFSET_STD if name.startswith("offset") else GAIN_STD for name in parameters])
    fastest = float(np.linalg.norm(_speeds(windows, wheels), axis=1).max(initial=1e-9))
    motion, level, terrain = _motion(windows, wheels, fastest), y / scale, windows.terrain.astype(str)
    classes = tuple(np.unique(terrain).tolist())
    session, run = windows.session.astype(str), windows.run_id.astype(str)
    for of_session in (session, np.full(len(run), "")):  # of all runs, where no session has two on a terrain
        scatters = [(_scatter(motion, level, terrain, of_session, run, width), width) for width in WIDTHS]
        known = [(*scatter, width) for scatter, width in scatters if scatter is not None]
        if known:
            break
    else:
        raise DataError("no terrain has two runs, so that the scatter of runs is not known")
    _, run_std, window_std, width = min(known, key=itemgetter(0))
    of = np.searchsorted(classes, terrain)
    learned = Adaptation(
        classes, tuple(levels), tuple(wheels), scale, parameters, motion, level, of, fastest, width,
        run_std, window_std, default, 0,
    )  # fmt: skip
    squares, n = PRIOR_SESSIONS * default**2, 0
    for c, name in enumerate(classes):
        of_class = terrain == name
        for each in np.unique(session[of_class]):
            own, others = of_class & (session == each), of_class & (session != each)
            if not others.any():
                continue
            law = learned._replace(motion=motion[others], level=level[others], of=of[others])
            mean, cov = _posterior(law, windows[own], c)
            squares, n = squares + mean**2 + np.diag(cov), n + 1
    return learned._replace(prior_std=np.sqrt(squares / (PRIOR_SESSIONS + n)), n_sessions=n)


def adapt(adaptation: Adaptation, windows: Windows, terrain: str = "") -> Adaptation:
    """Return the adaptation with the shift that windows of a session show.

    Parameters
    ----------
    windows : of the session, :data:`MIN_REFERENCE_S` or longer
    terrain : that all of them are on; empty where it is not known

    Raises
    ------
    ConfigError
        if the terrain is none that was learned.
    DataError
        if the windows are too few, or lack a channel.
    """
    check_terrain(adaptation, terrain)
    length_s = reference_s(windows)
    if length_s < MIN_REFERENCE_S:
        raise DataError(
            f"the reference holds {length_s:g} s of windows; {MIN_REFERENCE_S:g} s at least are needed to adapt"
        )
    k, prior = len(adaptation.classes), np.diag(adaptation.prior_std**2)
    if terrain:
        c = adaptation.classes.index(terrain)
        own, own_cov = _posterior(adaptation, windows, c)
        means = np.repeat(COMMON * own[None], k, axis=0)
        covs = np.repeat((prior - COMMON**2 * (prior - own_cov))[None], k, axis=0)
        means[c], covs[c] = own, own_cov
    else:
        common, common_cov = _mixture(adaptation, windows)
        means = np.repeat(common[None], k, axis=0)
        covs = np.repeat((common_cov + (1.0 - COMMON) * prior)[None], k, axis=0)
    return adaptation._replace(shift=Shift(terrain, length_s, means, covs))


def check_adaptation(adaptation: Adaptation, classes: Sequence[str]) -> None:
    """Refuse by ``DataError`` what does not fit these terrains or itself, or is not of finite numbers."""
    m, d, p = len(adaptation.levels), len(adaptation.parameters), len(adaptation.of)
    k, n_wheels, shift = len(classes), max(len(adaptation.wheels), 1), adaptation.shift
    positive = adaptation.scale, adaptation.run_std, adaptation.window_std, adaptation.prior_std
    arrays: list[tuple[Array, tuple[int, ...]]] = [
        *zip(positive, ((m,), (m,), (m,), (d,)), strict=True),
        (adaptation.motion, (p, n_wheels + 1)),
        (adaptation.level, (p, m)),
    ]
    if shift is not None:
        arrays += [(shift.mean, (k, d)), (shift.cov, (k, d, d))]
    if adaptation.classes != tuple(classes) or set(adaptation.of.tolist()) != set(range(k)):
        raise DataError("the terrains that it adapts by are not its own")
    if not set(adaptation.parameters) <= {name for names in KINDS.values() for name in names}:
        raise DataError("it adapts by parameters that are not known")
    for array, shape in arrays:
        if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise DataError(f"what it adapts by holds no {shape} finite numbers")
    if min(each.min() for each in positive) <= 0.0 or min(adaptation.fastest, adaptation.width) <= 0.0:
        raise DataError("what it adapts by has scales that are not above zero")


def check_terrain(adaptation: Adaptation, terrain: str) -> None:
    """Raise ``ConfigError`` where a terrain is named that was not learned."""
    if terrain and terrain not in adaptation.classes:
        known = ", ".join(adaptation.classes)
        raise ConfigError(
            f"the model has not learned {terrain!r}, so that it is no reference; it knows {known}"
        )


def reference_s(windows: Windows) -> float:
    """Return how long the windows of each run last from the first to the last, in total."""
    runs = windows.run_id.astype(str)
    return float(sum(np.ptp(windows.start_s[runs == run]) + windows.length_s for run in np.unique(runs)))


def start_of(windows: Windows) -> Array:
    """Return which windows (n,) end within :data:`START_S` of the start of their session, or run where it names none.

    Runs of a session follow each other as they are given.
    """
    session, run = windows.groups.T
    start = np.zeros(len(windows), dtype=bool)
    for each in np.unique(session):
        passed_s = 0.0
        for one in dict.fromkeys(run[session == each].tolist()):
            rows = np.flatnonzero((session == each) & (run == one))
            end_s = windows.start_s[rows] - windows.start_s[rows].min() + windows.length_s
            start[rows] = passed_s + end_s <= START_S + TIME_TOLERANCE_S
            passed_s += float(end_s.max())
    return start


def corrections(adaptation: Adaptation) -> tuple[Array, Array]:
    """Return values of theta (p, d) that remain possible, and the weight of each for each terrain (p, k).

    Those of a terrain have the mean and the covariance of its theta, the mean first; without a shift it is zero, alone.
    """
    k, d, shift = len(adaptation.classes), len(adaptation.parameters), adaptation.shift
    if shift is None:
        return np.zeros((1, d)), np.ones((1, k))
    alike: dict[bytes, list[int]] = {}
    for c in range(k):
        alike.setdefault(shift.mean[c].tobytes() + shift.cov[c].tobytes(), []).append(c)
    n = 2 * d + 1
    points = np.concatenate([np.zeros((1, d)), np.eye(d), -np.eye(d)]) * np.sqrt(n / 2.0)
    values, weights = [], []
    for members in alike.values():
        variance, axes = np.linalg.eigh(shift.cov[members[0]])
        root = axes * np.sqrt(np.maximum(variance, 0.0))
        values.append(shift.mean[members[0]] + points @ root.T)
        weights.append(np.tile(np.isin(np.arange(k), members) / n, (n, 1)))
    return np.concatenate(values), np.concatenate(weights)


def averaged(probability: Array, weights: Array) -> Array:
    """Return probabilities (n, k) by those (p n, k) of windows :func:`corrected` by each theta, and weights (p, k)."""
    p, k = weights.shape
    mean = np.einsum("ink,ik->nk", probability.reshape(p, len(probability) // p, k), weights)
    return np.asarray(mean / mean.sum(axis=1, keepdims=True))


def corrected(adaptation: Adaptation, windows: Windows, theta: Array) -> Windows:
    """Return windows whose channels are as in training, if theta is what shifted: of each theta (p, d) all n.

    They follow each other theta by theta.
    """
    theta, current = np.atleast_2d(theta), _are_currents(adaptation.levels)
    gains, offsets = _parts_of_levels(adaptation)
    gain, offset = np.maximum(1.0 + theta @ gains.T, MIN_GAIN), theta @ offsets.T
    values = {}
    for stream, x in windows.values.items():
        scale, shift = np.ones((len(theta), 1, x.shape[1], 1)), np.zeros((len(theta), *x.shape[:2], 1))
        least = np.full((*x.shape[:2], 1), -np.inf)
        for j, (of_stream, name) in enumerate(adaptation.levels):
            if of_stream != stream:
                continue
            row = _place(windows, stream, name)
            mean = x[:, row].mean(axis=1)
            scale[:, 0, row, 0] = 1.0 / gain[:, j]
            if current[j]:  # one that has a sign is shifted along it, a magnitude stays one
                along = np.where(mean < 0.0, -adaptation.scale[j], adaptation.scale[j])
                shift[:, :, row, 0] = -np.outer(offset[:, j] / gain[:, j], along)
                least[:, row, 0] = np.where((x[:, row] >= 0.0).all(axis=1), 0.0, -np.inf)
            else:
                shift[:, :, row, 0] = np.outer(1.0 - 1.0 / gain[:, j], mean)
        values[stream] = np.maximum(x * scale + shift, least).reshape(-1, *x.shape[1:])
    columns = [np.tile(getattr(windows, name), len(theta)) for name in WINDOW_COLUMNS]
    return Windows(values, windows.channels, windows.rate_hz, windows.length_s, *columns)


def _parts_of_levels(adaptation: Adaptation) -> tuple[Array, Array]:
    """Return which parameter is the gain of each level, and which its offset: (m, d) each, of 0 and 1."""
    current = _are_currents(adaptation.levels)
    own = np.stack([current == name.endswith("currents") for name in adaptation.parameters], axis=1)
    offset = np.array([name.startswith("offset") for name in adaptation.parameters])
    return 1.0 * (own & ~offset), 1.0 * (own & offset)


def _design(adaptation: Adaptation, level: Array) -> Array:
    """Return the derivative (m, d) of expected levels (m,) by theta."""
    gains, offsets = _parts_of_levels(adaptation)
    return gains * level[:, None] + offsets


def _observed(adaptation: Adaptation, windows: Windows, c: int) -> tuple[Array, Array]:
    """Return levels (n, m) of windows, and those (n, m) that ground c had in training, driven alike."""
    level = _levels(windows, adaptation.levels) / adaptation.scale
    motion = _motion(windows, adaptation.wheels, adaptation.fastest)
    own = adaptation.of == c
    return level, _law(motion, adaptation.motion[own], adaptation.level[own], adaptation.width)


def _posterior(adaptation: Adaptation, windows: Windows, c: int) -> tuple[Array, Array]:
    """Return mean (d,) and covariance (d, d) of theta by windows on ground c."""
    information, weighed = np.diag(adaptation.prior_std**-2.0), np.zeros(len(adaptation.parameters))
    (level, expected), runs = _observed(adaptation, windows, c), windows.run_id.astype(str)
    for run in np.unique(runs):
        rows = runs == run
        design = _design(adaptation, expected[rows].mean(axis=0))
        variance = adaptation.run_std**2 + adaptation.window_std**2 / rows.sum()
        information += design.T @ (design / variance[:, None])
        weighed += design.T @ ((level - expected)[rows].mean(axis=0) / variance)
    cov = np.linalg.inv(information)
    return cov @ weighed, cov


def _mixture(adaptation: Adaptation, windows: Windows) -> tuple[Array, Array]:
    """Return mean and covariance of G by windows whose grounds are not known, each on any of them."""
    from scipy.stats import norm, qmc

    d, prior = len(adaptation.parameters), adaptation.prior_std**2
    uniform = qmc.Halton(d, scramble=False).random(N_DRAWS + 1)[1:]
    draws = norm.ppf(uniform) * np.sqrt(COMMON * prior)
    variance = np.diag(adaptation.run_std**2 + adaptation.window_std**2)
    _, place, n_of_run = np.unique(windows.run_id.astype(str), return_inverse=True, return_counts=True)
    observed = [_observed(adaptation, windows, c) for c in range(len(adaptation.classes))]
    log_weight = np.zeros(N_DRAWS)
    for i in range(len(windows)):
        each = []
        for level, expected in observed:
            design = _design(adaptation, expected[i])
            cov = design * ((1.0 - COMMON) * prior) @ design.T + variance
            apart = level[i] - expected[i] - draws @ design.T
            distance = np.einsum("ni,ni->n", apart, np.linalg.solve(cov, apart.T).T)
            each.append(-0.5 * (distance + np.linalg.slogdet(cov)[1]))
        log_weight += np.logaddexp.reduce(each, axis=0) / n_of_run[place[i]]  # a run is one observation
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = weight @ draws
    apart = draws - mean
    return mean, np.asarray((apart * weight[:, None]).T @ apart)


def _scatter(
    motion: Array, level: Array, terrain: Array, session: Array, run: Array, width: float
) -> tuple[float, Array, Array] | None:
    """Return what other runs of a session leave: mean square, and deviations (m,) of runs and of windows of a run."""
    means, within = [], []
    for name in np.unique(terrain):
        for each in np.unique(session[terrain == name]):
            rows = np.flatnonzero((terrain == name) & (session == each))
            rows = rows[:: -(-len(rows) // MAX_ROWS)]  # of all sessions together there are more
            runs = run[rows]
            if len(np.unique(runs)) < 2:
                continue
            left = level[rows] - _law(motion[rows], motion[rows], level[rows], width, runs)
            for one in np.unique(runs):
                means.append(left[runs == one].mean(axis=0))
                within.append(left[runs == one] - means[-1])
    if not means:
        return None
    square = np.square(means).mean(axis=0)
    of_windows = np.square(np.concatenate(within)).mean(axis=0)
    return float(square.sum()), np.sqrt(square + 1e-12), np.sqrt(of_windows + 1e-12)


def _law(motion: Array, known: Array, level: Array, width: float, runs: Array | None = None) -> Array:
    """Return the mean level (n, m) of windows (p, m) driven nearly alike; of other runs, where those are given."""
    at_once = max(AT_ONCE_VALUES // max(known.size, 1), 1)
    if len(motion) > at_once and runs is None:
        parts = range(0, len(motion), at_once)
        return np.concatenate([_law(motion[i : i + at_once], known, level, width) for i in parts])
    squared = np.square(motion[:, None] - known[None]).sum(axis=2) / width**2
    if runs is not None:
        squared[runs[:, None] == runs] = np.inf
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)))
    return np.asarray(weight @ level / weight.sum(axis=1, keepdims=True))


def _levels(windows: Windows, levels: Sequence[tuple[str, str]]) -> Array:
    """Return the level (n, m) of each channel in its unit; ``DataError`` where one is missing."""
    columns = []
    for (stream, name), current in zip(levels, _are_currents(levels), strict=True):
        x = windows.values[stream][:, _place(windows, stream, name)]
        columns.append(np.abs(x).mean(axis=1) if current else x.std(axis=1))
    return np.stack(columns, axis=1)


def _speeds(windows: Windows, wheels: Sequence[tuple[str, str]]) -> Array:
    if not wheels:
        return np.zeros((len(windows), 1))
    rows = [windows.values[stream][:, _place(windows, stream, name)] for stream, name in wheels]
    return np.stack([row.mean(axis=1) for row in rows], axis=1)


def _motion(windows: Windows, wheels: Sequence[tuple[str, str]], fastest: float) -> Array:
    """Return z (n, w + 1): wheel speeds over their norm, and the norm over the fastest."""
    speeds = _speeds(windows, wheels)
    norm = np.linalg.norm(speeds, axis=1, keepdims=True)
    unit = np.divide(speeds, norm, out=np.zeros_like(speeds), where=norm > 1e-3 * fastest)
    return np.concatenate([unit, norm / fastest], axis=1)


def _thinned(windows: Windows) -> Array:
    """Return the rows (r,) that are kept of each terrain and session."""
    names = np.char.add(np.char.add(windows.terrain.astype(str), "\n"), windows.session.astype(str))
    parts = [np.flatnonzero(names == name) for name in np.unique(names)]
    return np.sort(np.concatenate([rows[:: -(-len(rows) // MAX_ROWS)] for rows in parts]))


def _place(windows: Windows, stream: str, name: str) -> int:
    try:
        return windows.channels[stream].index(name)
    except (KeyError, ValueError):
        raise DataError(
            f"the windows have no channel {name!r} of stream {stream!r}, which adapting needs"
        ) from None


def _are_currents(levels: Sequence[tuple[str, str]]) -> Array:
    return np.array([name.startswith("current_") for _, name in levels])
