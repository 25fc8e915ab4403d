"""Learned terms: what a learner knows of a robot where no name fits, as sums of readable terms.

A term adds ``sum_k c_k g_k(x)`` to one channel of the simulation, with the robot's motion by its wheels as ``x``
(:data:`INPUTS`, without slip and as the geometry is described), and products of :data:`FACTORS` of it as ``g_k``::

    abs(speed_mps) * max(turn_radps - 0.8, 0)

``change(x, 0.3)`` is ``x`` minus ``x`` behind a first-order lag of 0.3 s, so that a term needs no later sample, and
is the same sample by sample.  Of a heading rate and speeds over ground it is motion of the body: the simulated robot
moves so, and filters take wheels that roll so.  Of a gyro, an accelerometer and currents it is what they read.

**Outside its region** a term is off: with the range of each of its inputs that runs drove, it is whole inside, and
falls smoothly to 0 over a margin beyond (:data:`MARGIN` of the range).

The section ``learned`` of a robot's description::

    learned:
      schema: 1
      terms:
        - channel: speed_x_mps
          says: speed lost in turns to the left above 0.8 rad/s
          source: "terrain explain, 40 runs"
          coefficients: {"abs(speed_mps) * max(turn_radps - 0.8, 0)": -0.31}
          covariance: [[0.0004]]
          region: {speed_mps: [-1.0, 1.5], turn_radps: [-1.2, 1.3]}

A coefficient has the unit of the channel over that of its product.

Source of the family: Friedman, Multivariate adaptive regression splines, Annals of Statistics 1991 (products of
hinges, selected one after the other).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import yaml

from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    checked_covariance,
)
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, is_number
from terrain.files.names import shown
from terrain.kernels import njit
from terrain.records import Array, read_only

INPUTS = ("speed_mps", "sideways_mps", "turn_radps", "grade_rad", "roll_rad")
"""Speeds ahead and to the left and yaw rate that the wheels would roll, and the tilt, uphill and left side up."""
OF_WHEELS = INPUTS[:3]  #: Inputs of a term that is motion: filters know the wheels before they know a tilt.

#: Channels whose terms are motion of the body; those of others are read.
MOTION = (HEADING, SPEED_X, SPEED_Y)

SOFT = {"speed_mps": 0.05, "sideways_mps": 0.05, "turn_radps": 0.05, "grade_rad": 0.02, "roll_rad": 0.02}
"""Where a sign has three quarters of its size: nothing is signed at rest."""

#: Part of a range beyond it over which a term falls to 0; a range of percentiles misses as much.
MARGIN = 0.1
LEAST_MARGIN = 0.02  #: The same of a narrow range, in the input's own unit.
LONGEST_S = 1.0  #: A lag starts anew after a longer gap: nothing is known of what was driven.

SCHEMA = 1  #: Version of the section that is read and written.
MAX_TERMS = 64  #: Terms of a section, and products of a term; far above what is learned.

_NUMBER = r"[0-9]+(?:\.[0-9]+)?(?:e-?[0-9]+)?"
_FACTOR = re.compile(
    rf"(?P<one>1)|(?P<moving>moving)|(?P<plain>\w+)|(?P<kind>abs|sign)\((?P<of>\w+)\)"
    rf"|max\((?P<minus>-?)(?P<over>\w+)(?: - (?P<from>{_NUMBER}))?, 0\)"
    rf"|change\((?P<changing>\w+), (?P<lag>{_NUMBER})\)"
)
FACTORS = "1, moving, INPUT, abs(INPUT), sign(INPUT), max(INPUT - NUMBER, 0), max(-INPUT - NUMBER, 0), change(INPUT, S)"
"""What a product is made of; ``moving`` is 0 at rest and 1 from a tenth of a metre a second."""


class Factor(NamedTuple):
    """A function of one input."""

    kind: str  #: ``1``, ``moving``, ``plain``, ``abs``, ``sign``, ``max`` or ``change``
    name: str = ""  #: of the input
    sign: float = 1.0  #: of the input, of ``max``
    number: float = 0.0  #: where ``max`` begins, or the lag of ``change`` in s


@cache
def factors_of(product: str) -> tuple[Factor, ...]:
    """Return the factors of a product.

    Raises
    ------
    ConfigError
        if it is no product of :data:`FACTORS` of :data:`INPUTS`.

    Examples
    --------
    >>> factors_of("abs(speed_mps) * max(-turn_radps - 0.8, 0)")[1]
    Factor(kind='max', name='turn_radps', sign=-1.0, number=0.8)
    >>> factors_of("abs(speed)")
    Traceback (most recent call last):
    terrain.errors.ConfigError: 'abs(speed)' is no product of 1, moving, INPUT, abs(INPUT), sign(INPUT), ...
    """
    found = []
    for text in product.split(" * "):
        match = _FACTOR.fullmatch(text)
        group = {} if match is None else {name: part for name, part in match.groupdict().items() if part}
        if "one" in group or "moving" in group:
            found.append(Factor(text))
            continue
        name = next((group[key] for key in ("plain", "of", "over", "changing") if key in group), "")
        number = float(group.get("from", group.get("lag", 0.0)))
        if name not in INPUTS or ("changing" in group and number <= 0.0):
            raise ConfigError(
                f"{shown(product)} is no product of {FACTORS}, with the inputs {', '.join(INPUTS)}"
            )
        kind = group.get("kind", "max" if "over" in group else "change" if "changing" in group else "plain")
        found.append(Factor(kind, name, -1.0 if "minus" in group else 1.0, number))
    return tuple(found)


def inputs_used(products: Sequence[str]) -> tuple[str, ...]:
    """Return the inputs that products depend on, in the order of :data:`INPUTS`."""
    used = {name for product in products for factor in factors_of(product) for name in _inputs_of(factor)}
    return tuple(name for name in INPUTS if name in used)


def _inputs_of(factor: Factor) -> tuple[str, ...]:
    return OF_WHEELS[::2] if factor.kind == "moving" else (factor.name,) if factor.name else ()


@njit
def _behind_lag(values: Array, dt_s: Array, tau_s: float, memory: Array) -> Array:
    """Return a signal (n,) behind a lag, exact for what runs straight from sample to sample; ``memory`` (2,) moves on.

    The memory is the last input and output, NaN before the first; a sample that is NaN, or not later, changes nothing.
    """
    out = np.empty(values.size)
    for k in range(values.size):
        x, dt = values[k], dt_s[k]
        if np.isfinite(x) and (not np.isfinite(memory[0]) or dt > LONGEST_S):
            memory[0], memory[1] = x, x
        elif np.isfinite(x) and dt > 0.0:
            lead = tau_s * (x - memory[0]) / dt
            memory[1] = x - lead + math.exp(-dt / tau_s) * (memory[1] - memory[0] + lead)
            memory[0] = x
        out[k] = memory[1]
    return out


def columns_of(
    products: Sequence[str], inputs: Array, dt_s: Array, memory: dict[Factor, Array] | None = None
) -> Array:
    """Return the products (n, k) of inputs (n, len(INPUTS)).

    Parameters
    ----------
    dt_s : (n,) time since the sample before, of the first since the last of the block before
    memory : of lags, moved on from block to block; by default the first sample is a steady motion
    """
    memory, known = {} if memory is None else memory, {}
    out = np.ones((len(inputs), len(products)))
    for j, product in enumerate(products):
        for factor in factors_of(product):
            if factor not in known:
                known[factor] = _factor(factor, inputs, dt_s, memory)
            out[:, j] *= known[factor]
    return out


def _factor(factor: Factor, inputs: Array, dt_s: Array, memory: dict[Factor, Array]) -> Any:
    if factor.kind == "1":
        return 1.0
    if factor.kind == "moving":
        pace = np.hypot(inputs[:, 0], inputs[:, 1]) + np.abs(inputs[:, 2])
        return np.tanh(pace / SOFT["speed_mps"])
    x = inputs[:, INPUTS.index(factor.name)]
    if factor.kind == "abs":
        return np.abs(x)
    if factor.kind == "sign":
        return np.tanh(x / SOFT[factor.name])
    if factor.kind == "max":
        return np.maximum(factor.sign * x - factor.number, 0.0)
    if factor.kind == "change":
        state = memory.setdefault(factor, np.full(2, np.nan))
        return x - _behind_lag(np.ascontiguousarray(x), dt_s, factor.number, state)
    return x


def activity(region: Mapping[str, tuple[float, float]], inputs: Array) -> Array:
    """Return how much of a term acts (n,): 1 in its region, 0 from a margin beyond, smooth between.

    Examples
    --------
    >>> at = np.zeros((4, len(INPUTS)))
    >>> at[:, 0] = 0.5, 1.0, 1.05, 1.2
    >>> activity({"speed_mps": (0.0, 1.0)}, at)
    array([1. , 1. , 0.5, 0. ])
    """
    acts = np.ones(len(inputs))
    for name, (low, high) in region.items():
        x, margin = inputs[:, INPUTS.index(name)], max(MARGIN * (high - low), LEAST_MARGIN)
        beyond = np.clip(np.maximum(low - x, x - high) / margin, 0.0, 1.0)
        acts *= 1.0 - beyond * beyond * (3.0 - 2.0 * beyond)
    return acts


@dataclass(frozen=True, slots=True, eq=False)
class LearnedTerm:
    """What is added to a channel of a robot's simulation.

    ``ConfigError`` where the parts do not fit each other.
    """

    #: of :data:`terrain.effects.CHANNELS`; the heading rate is the body's own, the yaw rate what the gyro reads
    channel: str
    products: tuple[str, ...]  #: as :func:`factors_of` reads them
    coefficients: Array  #: (k,) of the products
    covariance: Array  #: (k, k) of the coefficients
    region: Mapping[str, tuple[float, float]]  #: range of each input that it depends on
    says: str = ""  #: where it acts, in words
    source: str = "assumed"

    def __post_init__(self) -> None:
        n, place = len(self.products), f"learned term of {self.channel}"
        if self.channel not in CHANNELS:
            raise ConfigError(f"{place}: the channel is unknown, one of {', '.join(CHANNELS)} is required")
        if not 0 < n <= MAX_TERMS or len(set(self.products)) != n:
            raise ConfigError(f"{place}: it has {n} products, 1 to {MAX_TERMS} different ones are required")
        used, allowed = inputs_used(self.products), OF_WHEELS if self.channel in MOTION else INPUTS
        if beyond := [name for name in used if name not in allowed]:
            raise ConfigError(f"{place}: motion depends on the wheels alone, not on {', '.join(beyond)}")
        if set(self.region) != set(used):
            needed = ", ".join(used) or "none"
            raise ConfigError(
                f"{place}: its region has {', '.join(self.region) or 'no range'}, {needed} is required"
            )
        if not all(-math.inf < low < high < math.inf for low, high in self.region.values()):
            raise ConfigError(f"{place}: a range of its region is not two rising finite numbers")
        coefficients = np.asarray(self.coefficients, dtype=float)
        if coefficients.shape != (n,) or not np.isfinite(coefficients).all():
            raise ConfigError(f"{place}: {n} finite coefficients are required")
        covariance = checked_covariance(f"{place}: covariance", np.asarray(self.covariance, dtype=float))
        if covariance.shape != (n, n):
            raise ConfigError(f"{place}: covariance has the shape {covariance.shape}, {(n, n)} is required")
        object.__setattr__(self, "coefficients", read_only(coefficients))
        object.__setattr__(self, "covariance", covariance)

    def columns(self, inputs: Array, dt_s: Array, memory: dict[Factor, Array] | None = None) -> Array:
        """Return the products (n, k) as they act: 0 outside the region, and where an input is not known."""
        columns = columns_of(self.products, inputs, dt_s, memory) * activity(self.region, inputs)[:, None]
        return np.where(np.isfinite(columns), columns, 0.0)

    def predict(
        self, inputs: Array, dt_s: Array, memory: dict[Factor, Array] | None = None
    ) -> tuple[Array, Array]:
        """Return what is added (n,), and its standard deviation (n,) by that of the coefficients.

        Parameters are those of :func:`columns_of`.
        """
        columns = self.columns(inputs, dt_s, memory)
        variance = np.einsum("nk,kl,nl->n", columns, self.covariance, columns)
        added = np.zeros(len(inputs))
        for column, value in zip(columns.T, self.coefficients.tolist(), strict=True):
            added += value * column  # in one order, so that blocks of any length give the same bytes
        return added, np.sqrt(np.maximum(variance, 0.0))


def add_terms(terms: Sequence[LearnedTerm], inputs: Array, dt: float, truth: Array) -> None:
    """Add terms to what they are of: the motion of a body, or what is read of it.

    Parameters
    ----------
    inputs : (n, len(INPUTS))
    dt : step in s
    truth : (n,) of :data:`terrain.simulation.plants.planar.TRUTH`, changed in place
    """
    dt_s = np.full(len(inputs), dt)
    for term in terms:
        truth[FIELDS.get(term.channel, term.channel)] += term.predict(inputs, dt_s)[0]


FIELDS = {HEADING: "yaw_rate_radps", GYRO: "gyro_error_radps"}
"""Field of the truth that the term of a channel is added to, where that has another name."""


def rolling_change(
    terms: Sequence[LearnedTerm], inputs: Array, dt_s: Array, memories: Sequence[dict[Factor, Array]]
) -> Array:
    """Return what motion terms add to the twist (n, 3) of wheels that roll without slip; ``memories`` one a term."""
    change = np.zeros((len(inputs), 3))
    for term, memory in zip(terms, memories, strict=True):
        if term.channel in MOTION:
            place = (SPEED_X, SPEED_Y, HEADING).index(term.channel)
            change[:, place] += term.predict(inputs, dt_s, memory)[0]
    return change


# -- Where a term acts, in words --------------------------------------------------------------------------------

MOST_OF_IT = 0.9  #: Part of the square of what a term adds that lies where its words say.
LEAST_PART = 0.05  #: Over the most that it adds: where it adds less it does not act.
LEAST_GAP = 0.25  #: Threshold that words state, over the range of the input.

SIDES = {
    "turn_radps": ("in turns to the left", "in turns to the right", "in turns", "rad/s"),
    "speed_mps": ("driving forward", "driving backward", "driving", "m/s"),
    "sideways_mps": ("driving to the left", "driving to the right", "driving sideways", "m/s"),
    "grade_rad": ("uphill", "downhill", "on slopes", "rad"),
    "roll_rad": ("with the left side up", "with the right side up", "on side slopes", "rad"),
}
"""By input: where it is positive, negative and either, and its unit."""

INPUT_WORDS = dict(zip(INPUTS, ("speed", "sideways speed", "turn rate", "grade", "roll"), strict=True))

AMOUNTS = {
    SPEED_X: ("speed gained", "speed lost", "speed gained or lost", "speed_mps"),
    HEADING: ("yaw rate gained", "yaw rate lost", "yaw rate gained or lost", "turn_radps"),
    SPEED_Y: ("pushed to the left", "pushed to the right", "pushed sideways", ""),
    GYRO: ("gyro reads more of a turn", "gyro reads less of a turn", "gyro reads more or less", "turn_radps"),
    ACCEL: ("accelerometer reads more", "accelerometer reads less", "accelerometer reads more or less", ""),
    CURRENT: ("more current drawn", "less current drawn", "more or less current drawn", "speed_mps"),
    TURNING_CURRENT: (
        "more current to turn",
        "less current to turn",
        "more or less current to turn",
        "turn_radps",
    ),
}
"""By channel: what a term adds that is along an input (or positive where none is named), against it, and neither."""


def where_it_acts(channel: str, products: Sequence[str], added: Array, inputs: Array) -> str:
    """Return in words what a term adds, and where most of the square of it lies.

    Parameters
    ----------
    channel, products : of the term
    added : (n,) what it adds
    inputs : (n, len(INPUTS)) of the same samples

    Examples
    --------
    >>> inputs = np.zeros((400, len(INPUTS)))
    >>> inputs[:, 0], inputs[:, 2] = 1.0, np.linspace(-1.5, 1.5, 400)
    >>> lost = -0.3 * np.maximum(inputs[:, 2] - 0.8, 0.0)
    >>> where_it_acts("speed_x_mps", ["max(turn_radps - 0.8, 0)"], lost, inputs)
    'speed lost in turns to the left above 0.9 rad/s'
    """
    more, less, either, along = AMOUNTS[channel]
    square, size, places = added * added, np.abs(added), []
    total, acts = float(square.sum()), size >= LEAST_PART * np.percentile(size, 99.0)
    direction = np.sign(inputs[:, INPUTS.index(along)]) if along else np.ones(len(inputs))
    net = float((added * direction).sum()) / max(float(size.sum()), 1e-300)
    what = more if net > 0.5 else less if net < -0.5 else either
    for name in inputs_used(products):
        x = inputs[:, INPUTS.index(name)]
        left, right, both, unit = SIDES[name]
        positive = float(square[x > 0.0].sum()) / max(total, 1e-300)
        driven = min((x > SOFT[name]).mean(), (x < -SOFT[name]).mean()) > 1.0 - MOST_OF_IT
        side = left if positive > MOST_OF_IT else right if positive < 1.0 - MOST_OF_IT else both
        least, most = np.percentile(np.abs(x[acts]), 2.0), np.percentile(np.abs(x), 99.0)
        above = least > LEAST_GAP * most and (np.abs(x) < least).mean() > 1.0 - MOST_OF_IT
        if above or (side != both and driven):
            places.append(side + (f" above {least:.1g} {unit}" if above else ""))
    changing = [name for name in products if "change(" in name]
    if len(changing) == len(products):
        places.append("while that changes" if places else "while speeds change")
    by = [INPUT_WORDS[name] for name in inputs_used(products)]
    everywhere = f"by {' and '.join(by)}" if what == either and by else "throughout"
    return f"{what} {', '.join(places) or everywhere}"


# -- The section of a description ------------------------------------------------------------------------------

_KEYS = ["channel", "says", "source", "coefficients", "covariance", "region"]
DIGITS = 7  #: Significant digits of each number that is written.


def read_learned(place: str, described: Any) -> tuple[LearnedTerm, ...]:
    """Return the terms of a section; ``place`` is file and section, as messages name them.

    Raises
    ------
    ConfigError
        if the schema is newer, a key is unknown or missing, a product or number is not accepted, or the parts of a
        term do not fit each other.
    """
    check_keys(place, described, ["schema", "terms"])
    schema, entries = described["schema"], described["terms"]
    if isinstance(schema, bool) or not isinstance(schema, int) or not 1 <= schema <= SCHEMA:
        raise ConfigError(f"{place}: schema is {shown(schema)}; this version of terrain reads {SCHEMA}")
    if not isinstance(entries, list) or len(entries) > MAX_TERMS:
        raise ConfigError(f"{place}: terms are {shown(entries)}, a list of at most {MAX_TERMS} is required")
    return tuple([_read_term(f"{place}: term {i + 1}", entry) for i, entry in enumerate(entries)])


def _read_term(place: str, entry: Any) -> LearnedTerm:
    check_keys(place, entry, _KEYS)
    for key in ("channel", "says", "source"):
        if not isinstance(entry[key], str) or not entry[key].strip():
            raise ConfigError(f"{place}: {key} is {shown(entry[key])}, words are required")
    coefficients, region, rows = entry["coefficients"], entry["region"], entry["covariance"]
    if not isinstance(coefficients, dict) or not all(isinstance(name, str) for name in coefficients):
        raise ConfigError(f"{place}: coefficients are {shown(coefficients)}, a number by product is required")
    pairs = list(region.values()) if isinstance(region, dict) else [None]
    if not all(isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) for pair in pairs):
        raise ConfigError(f"{place}: region is {shown(region)}, two numbers by input are required")
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == len(rows) for row in rows):
        raise ConfigError(f"{place}: covariance is {shown(rows)}, rows of as many numbers are required")
    for number in [*coefficients.values(), *[each for row in rows for each in row]]:
        if not is_number(number):
            raise ConfigError(f"{place}: {shown(number)} is no finite number")
    for product in coefficients:
        try:
            factors_of(product)
        except ConfigError as error:
            raise ConfigError(f"{place}: {error}") from error
    try:
        return LearnedTerm(
            channel=entry["channel"],
            products=tuple(coefficients),
            coefficients=np.array([*coefficients.values()], dtype=float),
            covariance=np.array(rows, dtype=float),
            region={name: (float(pair[0]), float(pair[1])) for name, pair in region.items()},
            says=entry["says"],
            source=entry["source"],
        )
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from error


def learned_lines(terms: Sequence[LearnedTerm]) -> list[str]:
    """Return the lines of a section ``learned``; none without terms."""
    if not terms:
        return []
    section = {"schema": SCHEMA, "terms": [_written(term) for term in terms]}
    text = yaml.safe_dump(
        {"learned": section}, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110
    )
    return str(text).rstrip().splitlines()


def _written(term: LearnedTerm) -> dict[str, Any]:
    def rounded(value: float) -> float:
        return float(f"{value:.{DIGITS}g}")

    numbers = zip(term.products, map(rounded, term.coefficients.tolist()), strict=True)
    return {
        "channel": term.channel,
        "says": term.says or "learned",
        "source": term.source,
        "coefficients": dict(numbers),
        "covariance": [[rounded(each) for each in row] for row in term.covariance.tolist()],
        "region": {name: [rounded(low), rounded(high)] for name, (low, high) in term.region.items()},
    }
