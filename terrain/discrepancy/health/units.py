"""Units that are not those of the channel's name, found by gains that no effect reaches.

The logarithms of the gains have a prior: what robots and effects do to them.  A reading of the logs in which
a column is in another unit costs a fixed evidence, and is taken where the gains cost more without it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.health.common import MIN_FAULTY_RATIO
from terrain.discrepancy.health.faults import CHANNELS_OF, LOGGED, Change, Column, Fault, FaultKind, in_runs
from terrain.discrepancy.health.response import AMPS, A, G, H, Response, X, gains_of
from terrain.records import Array
from terrain.robots import Robot

DEG, RPM, KMH, MILLI = math.pi / 180.0, math.pi / 30.0, 1.0 / 3.6, 1e-3

UNITS: dict[Column, dict[str, float]] = {
    Column.GYRO: {"deg/s": DEG, "rpm": RPM},
    Column.HEADING: {"deg/s": DEG, "rpm": RPM},
    Column.SPEED: {"km/h": KMH, "mm/s": MILLI},
    Column.ACCEL: {"g": GRAVITY_MPS2},
    Column.CURRENTS: {"mA": MILLI},
    Column.WHEELS: {"deg/s": DEG, "rpm": RPM, "km/h": KMH, "mm/s": MILLI},
}
"""By column, units that loggers have, and their size in SI."""

SI = {
    Column.GYRO: "rad/s",
    Column.HEADING: "rad/s",
    Column.SPEED: "m/s",
    Column.ACCEL: "m/s^2",
    Column.CURRENTS: "A",
}

NOT_IN_MAPPINGS = ("mm/s",)
"""Units that a mapping file has no word for; there the scale is changed."""

MIN_FIT = 0.7
"""Correlation about zero from which a gain is used: of a run that hardly responds it says nothing."""

SKID_TURN, SWERVE_TURN = (math.log(0.75), 0.5, 0.35), (0.0, 0.2, 0.2)
"""Gain of the yaw rate, mean of its logarithm and standard deviations to below and above: skid-steer robots
have an effective track of 1 to 2.5 times the nominal one (Mandow et al., IROS 2007), and the bounds of the
catalogue, which are gains of 0.2 and 2, are within three; a swerve robot turns as its wheels do."""

SPEED = (-0.08, 0.2)
"""Gain of the speed: a wheel radius may be off by 30 %, and slip takes up to a half, within three and a half
standard deviations."""

GYRO_SPREAD = 0.12
"""Of gyro over heading rate: the catalogue's bound of a gyro's scale is within three standard deviations."""

ACCEL_SPREAD = 0.25
"""Of the accelerometer over the speed: it sees bumps too."""

CURRENT = (0.7, 1.2)
"""Of the currents: constants of motors and the resistance of a terrain are known to a factor of 10."""

COST = 16.0
"""Evidence that a unit has to bring, in minus twice the log-likelihood: four standard deviations."""

LEFT = 9.0
"""Cost of the gains under the right reading, at most: three standard deviations."""

TIE = 1.5
"""Readings whose costs differ by less cannot be distinguished: their odds are within 2."""

MIN_USUAL_RATIO = 0.2
"""Ratio of runs without a fault, from which they are what the others are compared with."""

NEAR, TIGHT, SCATTERS = 0.35, 0.1, 3.0
"""A run of another unit than the others agrees with them after its repair: within so many times their
scatter, the second at the least and the first at the most, in the logarithm.  Where its motion would be too
small it is the second, since a run may slip or stall, by any factor."""

CLEAR_FIT = 0.95
"""Correlation of the channels of such a run, if it is another unit and nothing that changes over a run."""

KEYS = (G, X, A, AMPS, H)
"""Channels that have a gain, in the order of the columns of logarithms."""

_PLACE = {c: i for i, c in enumerate(KEYS)}
_MOTION = [_PLACE[c] for c in (G, X, A, H)]

Changes = tuple[Change, ...]


def unit_faults(responses: Sequence[Response], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose unit is not that of their name, in all runs or in some of them."""
    logs, fit = (np.array(each) for each in zip(*(_log_gains(run) for run in responses), strict=True))
    informed = [i for i in range(len(logs)) if np.isfinite(logs[i]).any()]
    if not informed:
        return ()
    options = _options(logs, robot)
    turn = SKID_TURN if robot.skids else SWERVE_TURN
    own = {i: _best(logs[i], options, turn)[0] for i in informed}
    suggested = {changes for changes in own.values() if changes}
    usual = [i for i in informed if not own[i] and any(_shows(logs[i], changes) for changes in suggested)]
    if not suggested:
        return ()
    if len(usual) < MIN_USUAL_RATIO * len(informed):
        best, rivals = _best(_middle(logs[[i for i in informed if i not in usual]]), options, turn)
        has = [i for i in range(len(logs)) if i not in usual]
        return tuple(_fault(best, change, rivals, has, responses, logs) for change in best)
    middle, scatter = _middle(logs[usual]), 1.48 * _middle(np.abs(logs[usual] - _middle(logs[usual])))
    near = np.clip(SCATTERS * np.where(np.isfinite(scatter), scatter, TIGHT), TIGHT, NEAR)
    of_runs: dict[Changes, list[int]] = {}
    for i in (i for i in informed if own[i]):
        off = np.where(fit[i] > CLEAR_FIT, logs[i], np.nan) - middle
        fitting = [changes for changes in options if changes and _agrees(off, changes, near)]
        if fitting:
            nearest = min(fitting, key=partial(_distance, off))
            of_runs.setdefault(nearest, []).append(i)
    return tuple(
        _fault(changes, change, (), has, responses, logs)
        for changes, has in of_runs.items()
        if len(has) >= MIN_FAULTY_RATIO * len(informed)
        for change in changes
    )


def _log_gains(response: Response) -> tuple[Array, Array]:
    """Return the logarithms of the gains (len(KEYS),), NaN where none is clear, and correlations."""
    gain, correlation = gains_of(response)
    clear = np.isfinite(gain) & (gain > 0) & (np.abs(correlation) > MIN_FIT)
    return np.log(np.where(clear, gain, np.nan))[list(KEYS)], correlation[list(KEYS)]


def _middle(logs: Array) -> Array:
    """Return the medians of columns, NaN where nothing is known."""
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else np.nan for x in logs.T])


def _options(logs: Array, robot: Robot) -> list[Changes]:
    """Return the readings: nothing, one column in another unit, or two that are measured.

    Wheels and what they turn in one other unit would hide each other: then a body that slips looks like it.
    """
    known = np.array([np.isfinite(column).any() for column in logs.T])
    units = {column: list(sizes.values()) for column, sizes in UNITS.items()}
    units[Column.WHEELS].append(robot.wheel_radius_m)  # rates of wheels in the place of speeds
    single = [
        Change(FaultKind.UNIT, column, factor)
        for column, sizes in units.items()
        if column is Column.WHEELS or any(known[_PLACE[c]] for c in CHANNELS_OF[column] if c in _PLACE)
        for size in sizes
        for factor in (size, 1.0 / size)
    ]
    measured = [change for change in single if not change.of_wheels]
    pairs = [pair for pair in combinations(measured, 2) if pair[0].column is not pair[1].column]
    return [(), *((change,) for change in single), *pairs]


def _repaired_logs(logs: Array, changes: Changes) -> Array:
    """Return the logarithms of gains after changes: of measured channels up, of a larger prediction down.

    The currents are not in proportion to the wheel speeds: beside a motion their gain says nothing of these.
    """
    after = logs.copy()
    for change in changes:
        if change.of_wheels:
            after[_MOTION] -= math.log(change.factor)
            if np.isfinite(after[_MOTION]).any():
                after[_PLACE[AMPS]] = np.nan
        else:
            for c in CHANNELS_OF[change.column]:
                if c in _PLACE:
                    after[_PLACE[c]] += math.log(change.factor)
    return after


def _cost(logs: Array, turn: tuple[float, float, float]) -> float:
    """Return minus twice the logarithm of the prior of gains, up to a constant."""
    gyro, speed, accel, current, heading = logs
    yaw = heading if math.isfinite(heading) else gyro
    along = speed if math.isfinite(speed) else SPEED[0]
    terms = (
        (yaw - turn[0]) / (turn[1] if yaw < turn[0] else turn[2]),
        (gyro - heading) / GYRO_SPREAD,
        (speed - SPEED[0]) / SPEED[1],
        (accel - along) / ACCEL_SPREAD,
        (current - CURRENT[0]) / CURRENT[1],
    )
    return float(sum(term**2 for term in terms if math.isfinite(term)))


def _shows(logs: Array, changes: Changes) -> bool:
    """Whether a run has the channels in which changes show."""
    return not np.array_equal(_repaired_logs(logs, changes), logs, equal_nan=True)


def _best(
    logs: Array, options: Sequence[Changes], turn: tuple[float, float, float]
) -> tuple[Changes, list[Changes]]:
    """Return the reading of least cost, and those that cost hardly more."""
    costs = [_cost(_repaired_logs(logs, changes), turn) for changes in options]
    total = [cost + COST * len(changes) for cost, changes in zip(costs, options, strict=True)]
    best = int(np.argmin(total))
    if not options[best] or costs[best] > LEFT:
        return (), []
    rivals = [
        changes
        for i, changes in enumerate(options)
        if i != best and changes and len(changes) == len(options[best]) and total[i] - total[best] < TIE
    ]
    return options[best], rivals


def _distance(off: Array, changes: Changes) -> float:
    return float(np.nansum(np.abs(_repaired_logs(off, changes)))) + COST * (len(changes) - 1)


def _agrees(off: Array, changes: Changes, near: Array) -> bool:
    """Whether a run that is off from the others agrees with them after changes, and may not just stall."""
    after = np.abs(_repaired_logs(off, changes))
    known = np.isfinite(off)
    if not known.any() or (after[known] > near[known]).any() or not (np.abs(off[known]) > 2 * NEAR).any():
        return False
    small = [i for i in _MOTION if known[i] and off[i] < -2 * NEAR]
    sound = [i for i in _MOTION if known[i] and abs(off[i]) < near[i]]  # these show that it moved
    return not small or (bool((after[small] < TIGHT).all()) and len(small) + len(sound) > 1)


def _fault(
    changes: Changes,
    change: Change,
    rivals: Sequence[Changes],
    has: Sequence[int],
    responses: Sequence[Response],
    logs: Array,
) -> Fault:
    """Return the fault of a change in words; it is left out where other readings are as good."""
    every = [run.run_id for run in responses]
    ids = tuple(every[i] for i in has)
    seen = ", ".join(_gain_words(_middle(logs[list(has)]), change.column))
    what, unit = _words(change)
    scale = unit in NOT_IN_MAPPINGS or not unit
    hint = f"scale: {change.factor:.4g}" if scale else f"unit: {unit}"
    repair = f"multiply {LOGGED[change.column]} by {change.factor:.4g} (mapping file: {hint})"
    sentence = f"{what} {in_runs(ids, every)}: {seen}"
    if not rivals:
        return Fault(change.kind, change.column, ids, change.factor, f"{sentence}; {repair}", repair, change)
    others = " or ".join(" and ".join(_words(each)[0] for each in reading) for reading in rivals)
    measured = next((each for reading in (changes, *rivals) for each in reading if not each.of_wheels), None)
    if measured is None:  # of the wheels in either case: without them there is nothing to compare
        sentence = f"{sentence}; another reading is as good ({others}); {repair}"
        return Fault(change.kind, change.column, ids, change.factor, sentence, repair, change)
    left_out = f"{LOGGED[measured.column]} is left out; state the units that the logger has"
    sentence = f"{sentence}; another reading is as good ({others}), so that {left_out}"
    return Fault(change.kind, measured.column, ids, math.nan, sentence, left_out, measured)


def _words(change: Change) -> tuple[str, str]:
    """Return what is wrong with a unit, and the unit that the samples have."""
    sizes = UNITS[change.column]
    plural = change.column in (Column.WHEELS, Column.CURRENTS)
    subject, verb = ("the " + change.column.value, "are" if plural else "is")
    for unit, size in sizes.items():
        si = SI.get(change.column, "m/s" if unit in ("km/h", "mm/s") else "rad/s")
        if math.isclose(change.factor, size):
            return f"{subject} {verb} in {unit} instead of {si}", unit
        if math.isclose(change.factor, 1.0 / size):
            return f"{subject} {verb} in {si}, and {'were' if plural else 'was'} read as {unit}", si
    if change.factor < 1.0:
        return f"{subject} are rates in rad/s instead of speeds in m/s", ""
    return f"{subject} are speeds in m/s, and were read as rates in rad/s", ""


def _gain_words(middle: Array, column: Column) -> Iterator[str]:
    names = {
        G: "the gyro reads {:.3g} times what the wheels predict",
        X: "the speed {:.3g} times",
        A: "the acceleration {:.3g} times",
        AMPS: "the currents {:.3g} times",
        H: "the heading rate {:.3g} times",
    }
    for c, place in _PLACE.items():
        if math.isfinite(middle[place]) and (c == AMPS) is (column is Column.CURRENTS):
            yield names[c].format(math.exp(middle[place]))
