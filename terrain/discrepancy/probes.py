"""Probes: whether the residual depends on an input, its square or rate, or the angle of a wheel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from terrain.discrepancy.evidence import Evidence, pooled_variance, z_of, z_of_t
from terrain.discrepancy.noise import whiten
from terrain.discrepancy.runs import INPUTS, Rows
from terrain.effects import CHANNELS
from terrain.records import Array

Z_PROBE = 4.5  #: Evidence that a probe needs: 7e-6, of some two hundred

BLOCK_S = 5.0
"""Length of the blocks of a run that count as independent: several times what the noise remembers."""

RUN_RATIO = 2.0
"""Runs are the clusters instead of their blocks where the variance between runs is larger by that ratio: what
the residual depends on is then one more thing that differs from run to run (MacKinnon, Nielsen and Webb,
Journal of Econometrics 2023)."""

CRAWL_MPS = 0.2  #: Scale of speed of the probes of crawling

STANDSTILL_MPS = 0.05

HARMONICS = (1, 2)  #: Of a wheel's angle: an eccentric wheel, an oval one
PLACEBOS = (0.63, 1.37, 1.63)  #: Multiples of a wheel's angle that nothing on a wheel repeats with


TILT_INPUTS = ("grade", "roll", "grade |speed|", "roll |speed|")
"""Inputs that say nothing where only a part of the tilt is a slope: which part differs along a run."""


class ProbeResult(NamedTuple):
    """Evidence of one probe."""

    z: float  #: as of :class:`terrain.discrepancy.evidence.WaldTest`
    gain: float  #: fall of minus twice the log-likelihood, were it built in
    alike: Mapping[str, float] = MappingProxyType({})
    """By selected parameter, the correlation of what the input and the parameter change in the channel."""

    @property
    def significant(self) -> bool:
        """Whether the residual depends on the input."""
        return self.z > Z_PROBE


def probe_inputs(rows: Rows, rate_hz: float) -> dict[str, Array]:
    """Return the inputs (m,) that residuals are compared with, by name."""
    speed, turn, steer, grade, roll, force, sideways = rows.inputs[:, :7].T
    few = len(speed) < 2
    accel, steering_rate = [np.zeros_like(x) if few else np.gradient(x) * rate_hz for x in (speed, steer)]
    tau = rows.time_s / 60.0 - 0.5
    direction = np.tanh(speed / STANDSTILL_MPS)
    crawl = np.exp(-((speed / CRAWL_MPS) ** 2)) * np.abs(direction)
    sides = np.array([speed - 0.5 * turn, speed + 0.5 * turn])  # friction is of each wheel
    return {
        "constant": np.ones_like(speed),
        "time": tau,
        "time^2": tau**2,
        "speed": speed,
        "|speed|": np.abs(speed),
        "speed |speed|": speed * np.abs(speed),
        "direction": direction,
        "crawling": crawl,
        "crawling direction": crawl * direction,
        "crawling wheels": (np.exp(-((sides / CRAWL_MPS) ** 2)) * np.tanh(sides / STANDSTILL_MPS)).mean(
            axis=0
        ),
        "turn": turn,
        "|turn|": np.abs(turn),
        "turn |turn|": turn * np.abs(turn),
        "speed turn": speed * turn,
        "sideways": sideways,
        "|sideways|": np.abs(sideways),
        "speed sideways": speed * sideways,
        "steering": steer,
        "steering rate": steering_rate,
        "acceleration": accel,
        "jerk": accel if few else np.gradient(accel) * rate_hz,
        "grade": grade,
        "roll": roll,
        "roll |speed|": roll * np.abs(speed),
        "grade |speed|": grade * np.abs(speed),
        "force": force,
        "force |force|": force * np.abs(force),
        "force |speed|": force * np.abs(speed),
        "time speed": tau * speed,
        "time turn": tau * turn,
        "time force": tau * force,
        "time acceleration": tau * accel,
    }


def probe_residuals(
    info: Evidence,
    names: Sequence[str],
    change: Array,
    error: Mapping[tuple[str, str], float] = MappingProxyType({}),
) -> dict[tuple[str, str], ProbeResult]:
    """Return the result of every probe beside the fitted change of parameters, by channel and input.

    ``error`` is how much a channel depends on an input by the simulation's own error, in the channel's unit for one
    of the input; where it is not named, not at all.
    """
    rate_hz = 1 / float(np.median(np.diff(info.rows[0].time_s)))
    results: dict[tuple[str, str], ProbeResult] = {}
    inputs = [probe_inputs(run, rate_hz) for run in info.rows]
    change, info = change - info.away[info.places(names)], info.counted_from(info.origin)
    for c, channel in enumerate(CHANNELS):
        if not any(white[-1, :, c].any() for white in info.white):
            continue
        columns = [_whitened(info, i, c, np.array([*own.values()])) for i, own in enumerate(inputs)]
        known_error = np.array([error.get((channel, name), 0.0) for name in inputs[0]])
        tested = _test_inputs(info, names, change, c, columns, known_error)
        results |= {(channel, name): result for name, result in zip(inputs[0], tested, strict=True)}
        for wheel in range(info.rows[0].inputs.shape[1] - len(INPUTS) + 1):
            # the mean square of waves that no wheel makes: what they explain is no turn of a wheel
            explained = _wave_statistics(info, c, wheel)
            false = np.concatenate([explained[times] for times in PLACEBOS])
            placebo = max(float(np.mean(false)) / 2.0, 1.0) if false.size else 1.0
            for harmonic in HARMONICS:
                waves, result = np.array(explained[harmonic]) / placebo, ProbeResult(0.0, 0.0)
                if (
                    waves.size
                ):  # a phase of its own in each run; the median of chi^2 with 2 degrees is 2 log 2
                    in_most_runs = float(np.median(waves)) > 2 * math.log(2.0) * 1.5
                    z = z_of(float(chi2.logsf(waves.sum(), 2 * waves.size))) if in_most_runs else 0.0
                    result = ProbeResult(z, float(waves.sum()) - 2 * waves.size)
                results[channel, f"wheel {wheel + 1} turn{'' if harmonic == 1 else f' x{harmonic}'}"] = result
    return results


def input_values(info: Evidence, c: int) -> dict[str, tuple[Array, Array]]:
    """Return by input how much the residual of a channel depends on it in each run (runs,), and the information.

    What varies from run to run is taken out; the information is 0 where a run shows nothing.
    """
    rate_hz = 1 / float(np.median(np.diff(info.rows[0].time_s)))
    inputs, products = [probe_inputs(run, rate_hz) for run in info.rows], []
    for i, own in enumerate(inputs):
        columns = _whitened(info, i, c, np.array([*own.values()]))
        products.append(_products(info, i, c, [], columns, (0, columns.shape[1]))[0])
    every = np.array(products)
    size, score = np.diagonal(every, axis1=1, axis2=2)[:, :-1], every[:, :-1, -1]
    known = size > 1e-9 * np.maximum(size.max(axis=0), 1e-30)
    value, size = np.where(known, score / np.where(known, size, 1.0), 0.0), np.where(known, size, 0.0)
    return {name: (value[:, k], size[:, k]) for k, name in enumerate(inputs[0])}


def _whitened(info: Evidence, i: int, c: int, columns: Array) -> Array:
    """Whiten columns (q, m) of a run as channel c, 0 where its residual is not known."""
    scaled = columns / info.noise.size(info.rows[i].pace_mps)[:, c]
    white = whiten(info.noise.filters[c : c + 1], np.ascontiguousarray(scaled[:, :, None]))[:, :, 0]
    return np.asarray(white * (info.white[i][-1, :, c] != 0.0))


def _products(
    info: Evidence, i: int, c: int, at: Sequence[int], columns: Array, edges: Sequence[int] | Array
) -> Array:
    """Return products (blocks, z, z) of columns of a run with the same, nuisances taken out of the second.

    They are the sensitivities of some parameters, whitened columns (q, m) of channel c, and the residual;
    ``edges`` are the first rows of the blocks, and the end.
    """
    white = info.white[i]
    nuisances = white[info.nuisances]
    in_channel = np.zeros((len(columns), *white.shape[1:]))
    in_channel[:, :, c] = columns
    every = np.concatenate([white[at], in_channel, white[-1:]])
    deviations = info.marginal[2][i] @ np.tensordot(nuisances, every, axes=((1, 2), (1, 2)))
    free, z = every - np.tensordot(deviations.T, nuisances, axes=1), len(every)
    return np.array(
        [every[:, a:b].reshape(z, -1) @ free[:, a:b].reshape(z, -1).T for a, b in pairwise(edges)]
    )


def _test_inputs(
    info: Evidence, names: Sequence[str], change: Array, c: int, columns: Sequence[Array], error: Array
) -> list[ProbeResult]:
    """Return the results of whitened columns (q, m) a run, in channel c, where the simulation has an error (q,).

    The selected parameters go back where a probe goes ahead: what is left of each block's score, along that
    direction and at the fit, is the evidence, and its scatter between blocks or runs the noise.
    """
    at, q = info.places(names), len(columns[0])
    selected, probe = slice(0, len(at)), slice(len(at), len(at) + q)
    n_blocks = [max(round(float(run.time_s[-1] - run.time_s[0]) / BLOCK_S), 1) for run in info.rows]
    first = np.cumsum([0, *n_blocks[:-1]])
    products = []
    for i, n in enumerate(n_blocks):
        edges = np.linspace(0, len(info.rows[i].time_s), n + 1).astype(int)
        products.append(_products(info, i, c, at, columns[i], edges))
    every = np.concatenate(products)
    a = (every[:, selected, selected] + every[:, selected, selected].transpose(0, 2, 1)) / 2.0
    g = every[:, selected, -1] - a @ change
    own = np.diagonal(every[:, probe, probe], axis1=1, axis2=2)
    cross, score = every[:, probe, selected], every[:, probe, -1]
    follow = np.zeros((0, q))
    if at:
        follow = np.linalg.lstsq(a.sum(axis=0), cross.sum(axis=0).T, rcond=1e-10)[0]
    free = own.sum(axis=0) - (cross.sum(axis=0) * follow.T).sum(axis=1)
    sizes = own - 2 * (cross * follow.T).sum(axis=2) + ((a @ follow) * follow).sum(axis=1)
    part = score - cross @ change - g @ follow
    enough = free > 1e-6 * np.maximum(own.sum(axis=0), 1e-12)
    # variance of the score by the simulation's own error; of several parameters the largest counts: each error was
    # measured as if it were alone
    doubtful = np.flatnonzero(info.model_std)
    shown = -follow.T @ info.a[:, at][:, :, doubtful].sum(axis=0)
    power = np.zeros(len(at))
    for x, white, shift in zip(columns, info.white, info.marginal[1], strict=True):
        shown += x @ (white[doubtful, :, c] - shift[:, doubtful].T @ white[info.nuisances, :, c]).T
        power += (white[at][:, :, c] ** 2).sum(axis=1)
    by_model = ((shown * info.model_std[doubtful]) ** 2).max(axis=1, initial=0.0)
    by_model = by_model + (np.where(enough, free, 0.0) * error) ** 2
    both = np.sqrt(np.outer(own.sum(axis=0), power))
    alike = np.divide(np.abs(cross.sum(axis=0)), both, out=np.zeros_like(both), where=both > 1e-9)
    results = []
    for k in range(q):
        if not enough[k]:
            results.append(ProbeResult(0.0, 0.0))
            continue
        total, information = float(part[:, k].sum()), float(free[k])
        left, ratio = part[:, k] - sizes[:, k] * total / information, sizes[:, k] / information
        # the variance of the score is estimated between blocks, or between runs
        variance, dof = pooled_variance(left, np.clip(ratio, 0.0, 0.9), information)
        of_runs = np.add.reduceat(left, first), np.clip(np.add.reduceat(ratio, first), 0.0, 0.9)
        over_runs = pooled_variance(*of_runs, information)
        if over_runs[0] > RUN_RATIO * variance:
            variance, dof = over_runs
        z = z_of_t(abs(total) / math.sqrt(information * variance + float(by_model[k])), dof)
        known = dict(zip(names, np.minimum(alike[k], 1.0).tolist(), strict=True))
        results.append(ProbeResult(z, total**2 / information, known))
    return results


def _wave_statistics(info: Evidence, c: int, wheel: int) -> dict[float, list[float]]:
    """Return what each multiple of a wheel's angle explains of the runs, as chi^2 with 2 degrees."""
    explained: dict[float, list[float]] = {times: [] for times in (*PLACEBOS, *HARMONICS)}
    for i, run in enumerate(info.rows):
        turned_rad = run.inputs[:, len(INPUTS) - 1 + wheel]
        if len(turned_rad) < 2:
            continue
        phase, rate = np.outer([*explained], turned_rad), np.gradient(turned_rad)  # it errs by its own speed
        waves = _whitened(info, i, c, rate * np.concatenate([np.cos(phase), np.sin(phase)]))
        (products,) = _products(info, i, c, [], waves, (0, phase.shape[1]))
        for k, of_runs in enumerate(explained.values()):
            both = [k, k + len(explained)]
            own, score = products[np.ix_(both, both)], products[both, -1]
            if np.linalg.eigvalsh(own)[0] > 1e-6:
                of_runs.append(float(score @ np.linalg.solve(own, score)))
    return explained
