"""Units that are not those of the channel's name, found by gains that no effect reaches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from terrain.discrepancy.health.agreement import AMPS, A, G, H, X, agreement_of, medians
from terrain.discrepancy.health.fault import (
    KINDS,
    Change,
    Changes,
    Column,
    Fault,
    FaultKind,
    FaultStatus,
    change_in_words,
    fault_of,
)
from terrain.discrepancy.health.sessions import faulty_runs, halves
from terrain.discrepancy.runs import Rows
from terrain.records import Array
from terrain.robots import Robot

# The logarithms of the gains have a prior: what robots and effects do to them.  A reading of the logs in which
# a column is in another unit costs a fixed evidence, and is taken where the gains cost more without it.

#: Correlation about zero from which a gain is used: of a run that hardly responds it says nothing.
MIN_FIT = 0.7
#: Gain of the yaw rate, mean of its logarithm and standard deviations to below and above: skid-steer robots have an
#: effective track of 1 to 2.5 times the nominal one (Mandow et al., IROS 2007), and the bounds of the catalogue,
#: which are gains of 0.2 and 2, are within three; a swerve robot turns as its wheels do.
SKID_TURN, SWERVE_TURN = (math.log(0.75), 0.5, 0.35), (0.0, 0.2, 0.2)
#: Gain of the speed: a wheel radius may be off by 30 %, and slip takes up to a half, within three and a half standard
#: deviations.
SPEED_GAIN = (-0.08, 0.2)
#: Of gyro over heading rate: the catalogue's bound of a gyro's scale is within three standard deviations.
GYRO_SPREAD = 0.12

ACCEL_SPREAD = 0.25  #: Of the accelerometer over the speed: it sees bumps too.
#: Of the currents: constants of motors and the resistance of a terrain are known to a factor of 10.
CURRENT_GAIN = (0.7, 1.2)

#: Evidence that a unit has to bring, in minus twice the log-likelihood: four standard deviations.
COST = 16.0
LEFT = 9.0  #: Cost of the gains under the right reading, at most: three standard deviations.
#: Wheels do not turn so many times faster than the maker states, at the quantile of a run; the cost of a reading by
#: which they do.
OVERSPEED, PACE_QUANTILE, IMPOSSIBLE = 1.5, 0.9, 1e3
UNIT_TIE = 1.5  #: Readings whose costs differ by less cannot be distinguished: their odds are within 2.
#: A unit is that of all runs if so many of those that measure its column show it; a wheel that slips as if it was read
#: in another unit does so by a factor that scatters, in the logarithm, over the second: but none slips by e^ the third.
MIN_SHOWN_RATIO, STEADY, GROSS = 1 / 3, 0.25, 3.0
#: Ratio of runs without a fault, from which they are what the others are compared with.
MIN_USUAL_RATIO = 0.2
#: A run of another unit than the others agrees with them after its repair: within so many times their scatter, the
#: second at the least and the first at the most, in the logarithm.  Where its motion would be too small it is the
#: second, since a run may slip or stall, by any factor.
NEAR, TIGHT, SCATTERS = 0.35, 0.1, 3.0
MIN_SCATTER_RUNS = 3
#: Correlation of the channels of such a run, if it is another unit and nothing that changes over a run.
CLEAR_FIT = 0.95

#: Channels that have a gain, in the order of the columns of logarithms, with what a sentence calls it.
KEYS = {
    G: "the gyro reads {:.3g} times what the wheels predict",
    X: "the speed {:.3g} times",
    A: "the acceleration {:.3g} times",
    AMPS: "the currents {:.3g} times",
    H: "the heading rate {:.3g} times",
}
_MOVING = np.array([c != AMPS for c in KEYS])

#: Readings, and what they add to the logarithms of gains (readings, keys): see :func:`options_of`.
Options = tuple[list[Changes], Array]


def unit_faults(runs: Sequence[Rows], sessions: Sequence[str], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose unit is not that of their name, in all runs, in sessions, or in successive runs of one."""
    follows, keys, ids = agreement_of(runs, robot.sideways), list(KEYS), [run.run_id for run in runs]
    gain, fit = follows.gain[:, keys], follows.correlation[:, keys]
    clear = np.isfinite(gain) & (gain > 0) & (np.abs(fit) > MIN_FIT)
    logs = np.log(np.where(clear, gain, np.nan))
    informed = np.flatnonzero(clear.any(axis=1)).tolist()
    measures = np.array([np.isfinite(run.measured[:, keys]).any(axis=0) for run in runs])
    options = changes, adds = options_of(logs, robot)
    pace_mps = np.array(
        [np.quantile(run.pace_mps, PACE_QUANTILE) if run.time_s.size else 0.0 for run in runs]
    )
    own = {i: likeliest(logs[i], options, robot, pace_mps[i])[0] for i in informed}
    suggested = [changes.index(each) for each in {each for each in own.values() if each}]
    if not suggested:
        return ()

    def fault(reading: Changes, change: Change, rivals: Sequence[Changes], has: Sequence[int]) -> Fault:
        """Return the fault of a change in words; it is left out where other readings are as good."""
        middle = medians(logs[list(has)])
        gains = [
            text.format(math.exp(at))
            for (c, text), at in zip(KEYS.items(), middle, strict=True)
            if math.isfinite(at) and (c == AMPS) is (change.column is Column.CURRENTS)
        ]
        seen = f": {', '.join(gains)}"
        if rivals:
            words = (" and ".join(change_in_words(each, robot)[0] for each in rival) for rival in rivals)
            seen += f"; another reading is as good ({' or '.join(words)})"
        fault = fault_of(change, has, ids, seen, robot)
        if sum(i in own for i in has) < 2:
            return fault._replace(status=FaultStatus.NOT_CONFIRMED)
        measured = [each for some in (reading, *rivals) for each in some if not each.of_wheels]
        if not rivals or not measured:  # without wheels there is nothing to compare
            return fault
        left_out = f"{KINDS[measured[0].column].logged} is left out; state the units that the logger has"
        sentence = f"{fault.sentence.removesuffix(f'; {fault.repair}')}, so that {left_out}"
        change, others = (
            measured[0]._replace(factor=math.nan),
            tuple(each for some in rivals for each in some),
        )
        return Fault(change, fault.run_ids, sentence, left_out, FaultStatus.UNDECIDED, others)

    def of_runs_at(places: Sequence[int]) -> tuple[Changes, list[Changes]]:
        """Return the reading of the medians of some runs with its rivals."""
        some = list(places)
        return likeliest(medians(logs[some]), options, robot, float(np.median(pace_mps[some])))

    def shown_by(places: Sequence[int]) -> tuple[Changes, list[Changes]]:
        """Return the reading of some runs with its rivals; none where halves of them differ, or few show it."""
        best, rivals = of_runs_at(places)
        equal = {best, *rivals}
        for change in best:
            moves = np.nan_to_num(adds[changes.index((change,))]) != 0.0
            shows = [i for i in places if (clear[i] & moves).any()]
            scatter = 1.48 * medians(np.abs(logs[shows] - medians(logs[shows])))[moves]
            steady = not (np.nan_to_num(scatter) > STEADY).all() or abs(math.log(change.factor)) > GROSS
            alike = all(of_runs_at(part)[0] in equal for part in halves(shows) if part)
            n_measured = int((measures[list(every)] & moves).any(axis=1).sum())
            if not (steady and alike and len(shows) >= MIN_SHOWN_RATIO * n_measured):
                return (), []
        return best, rivals

    # those that contradict: with the units that others seem to have, their gains are less likely
    usual = []
    for i in (i for i in informed if not own[i]):
        cost = costs_of(logs[i], options, robot, pace_mps[i])
        if (np.isfinite(logs[i]) & np.nan_to_num(adds[suggested]).any(axis=0)).any():
            usual += [i] if cost[suggested].min() > cost[0] else []
    n_of = {
        name: [sum(sessions[i] == name for i in some) for some in (usual, [i for i in own if own[i]])]
        for name in dict.fromkeys(sessions)
    }
    sound = {name for name, (n, n_own) in n_of.items() if n and n >= MIN_USUAL_RATIO * (n + n_own)}
    faults, left = [], set(range(len(logs)))
    parts = [
        range(len(logs)),
        *([i for i, s in enumerate(sessions) if s == name] for name in dict.fromkeys(sessions)),
    ]
    for every in parts:
        asks = [i for i in informed if i in left and i in set(every) and i not in usual]
        n_usual = sum(i in set(every) for i in usual)
        n_own = sum(bool(own[i]) for i in asks)
        if n_own and n_usual < MIN_USUAL_RATIO * (n_usual + n_own):
            best, rivals = shown_by(asks)
            has = [i for i in every if i in left and sessions[i] not in sound]
            faults += [fault(best, change, rivals, has) for change in best]
            left -= set(has) if best else set()
    if not usual:
        return tuple(faults)
    middle, scatter = medians(logs[usual]), 1.48 * medians(np.abs(logs[usual] - medians(logs[usual])))
    known = np.isfinite(logs[usual]).sum(axis=0) >= MIN_SCATTER_RUNS  # of fewer no scatter is known
    near = np.clip(np.where(known, SCATTERS * scatter, NEAR), TIGHT, NEAR)
    of_runs: dict[Changes, list[int]] = {}
    n_changes = np.array([len(each) for each in changes])
    for i in (i for i in informed if own[i] and i in left):
        off = np.where(fit[i] > CLEAR_FIT, logs[i], np.nan) - middle
        apart = np.abs(_after(off, adds))
        agrees = (np.nan_to_num(apart) <= near).all(axis=1) & (n_changes > 0) & (np.abs(off) > 2 * NEAR).any()
        small, sound = (off < -2 * NEAR) & _MOVING, (np.abs(off) < near) & _MOVING
        if small.any():  # it may just stall, unless another channel shows that it moved
            agrees &= (apart[:, small] < TIGHT).all(axis=1) & (small.sum() + sound.sum() > 1)
        if agrees.any():
            distance = np.where(agrees, np.nansum(apart, axis=1) + COST * n_changes, np.inf)
            of_runs.setdefault(changes[int(np.argmin(distance))], []).append(i)
    for reading, some in of_runs.items():
        votes = np.zeros(len(logs), dtype=int)
        votes[usual], votes[some] = -1, 1
        has = faulty_runs(sessions, votes)
        faults += [fault(reading, change, (), has) for change in reading if has]
    return tuple(faults)


def options_of(logs: Array, robot: Robot) -> Options:
    """Return the readings: nothing, one column in another unit, or two that are measured; and what each adds.

    Added is NaN for the currents where wheels change, since they are not in proportion to the wheel speeds: beside a
    motion their gain says nothing of these.  Wheels and what they turn in one other unit would hide each other: then
    a body that slips looks like it.
    """
    known = {c for c, column in zip(KEYS, logs.T, strict=True) if np.isfinite(column).any()}
    single, adds = [], []
    for column, kind in KINDS.items():
        rates = [robot.wheel_radius_m] if column is Column.WHEELS else []  # of wheels in the place of speeds
        if rates or known & {*kind.channels}:
            by = [float(c in kind.channels) for c in KEYS]
            if rates:
                by = [math.nan if c == AMPS else -1.0 for c in KEYS]
            for factor in np.ravel([(size, 1.0 / size) for size in (*kind.units.values(), *rates)]).tolist():
                single.append(Change(FaultKind.UNIT, column, factor))
                adds.append(math.log(factor) * np.array(by))
    measured = [i for i, change in enumerate(single) if not change.of_wheels]
    pairs = [(i, j) for i, j in combinations(measured, 2) if single[i].column is not single[j].column]
    changes = [(), *((change,) for change in single), *((single[i], single[j]) for i, j in pairs)]
    return changes, np.array([np.zeros(len(KEYS)), *adds, *(adds[i] + adds[j] for i, j in pairs)])


def _after(logs: Array, adds: Array) -> Array:
    """Return the logarithms of gains (readings, keys) after changes: a larger prediction makes them less."""
    after = logs + np.nan_to_num(adds)
    if np.isfinite(logs[_MOVING]).any():
        after[np.isnan(adds)] = np.nan
    return np.asarray(after)


def likeliest(
    logs: Array, options: Options, robot: Robot, pace_mps: float = math.nan
) -> tuple[Changes, list[Changes]]:
    """Return the reading whose gains are likeliest by their prior, and those that are hardly less likely."""
    changes, _ = options
    cost = costs_of(logs, options, robot, pace_mps)
    n_changes = np.array([len(each) for each in changes])
    total = cost + COST * n_changes
    best = int(np.argmin(total))
    if not changes[best] or cost[best] > LEFT:
        return (), []
    near = (total - total[best] < UNIT_TIE) & (n_changes == n_changes[best])
    return changes[best], [changes[i] for i in np.flatnonzero(near).tolist() if i != best]


def costs_of(logs: Array, options: Options, robot: Robot, pace_mps: float = math.nan) -> Array:
    """Return what gains cost by their prior under each reading, in minus twice the log-likelihood.

    It is large of one under which the wheels, at ``pace_mps`` as they are logged, are faster than motors turn them.
    """
    changes, adds = options
    gyro, speed, accel, current, heading = _after(logs, adds).T
    mean, below, above = SKID_TURN if robot.skids else SWERVE_TURN
    yaw = np.where(np.isfinite(heading), heading, gyro)
    along = np.where(np.isfinite(speed), speed, SPEED_GAIN[0])
    terms = (
        (yaw - mean) / np.where(yaw < mean, below, above),
        (gyro - heading) / GYRO_SPREAD,
        (speed - SPEED_GAIN[0]) / SPEED_GAIN[1],
        (accel - along) / ACCEL_SPREAD,
        (current - CURRENT_GAIN[0]) / CURRENT_GAIN[1],
    )
    cost = np.nansum(np.square(terms), axis=0)
    if robot.describes("motors") and math.isfinite(pace_mps):
        scale = np.array([math.prod([each.factor for each in some if each.of_wheels]) for some in changes])
        top_mps = robot.motors.speed_max_radps * robot.wheel_radius_m
        cost = cost + IMPOSSIBLE * (scale * pace_mps > OVERSPEED * top_mps)
    return np.asarray(cost)
