"""One extended Kalman step for every filter, in a batch or sample by sample.

State x (d,) with covariance P, measurement z (m,) with independent rows of variance R, functions f and h::

    predict       x <- f(x, dt)              P <- F P F' + Q dt                 F = df/dx
    condition on  nu = z - h(x), s = H P H' + R, K = P H' / s                   H = dh/dx
                  x <- x + K nu              P <- P - K H P - P H' K' + K s K'  (Joseph form)

h and H are evaluated once a step, at the predicted state, and the rows conditioned on one by one: the same
answer as all at once, in O(m d^2) and without inverting a matrix.  A robot, a sensor or a soil is a
:class:`FilterModel` given to this step; there is no second one.

What arrives is not trusted.  Missing values (NaN) are skipped; so are infinite ones, and counted.  What
disagrees with the prediction beyond the gate of its sensor is left out, and believed once after a while, so
that a filter that went wrong finds back.  A leap of the clock is believed when the next stamp follows it, and
is not integrated over.  Nothing that comes in makes what comes out infinite or NaN.

Source: the form of the step follows the textbook of Sarkka, Bayesian Filtering and Smoothing (2013), 5.2.
"""

from __future__ import annotations

import numpy as np

from terrain.errors import DataError
from terrain.estimation.ekf.arrays import Columns, FilterArrays, Memory, SampleArrays
from terrain.estimation.ekf.kernel import LIKELIHOOD, run
from terrain.estimation.ekf.model import (
    DEFAULT_SETTINGS,
    NOTHING_GIVEN,
    UNGATED,
    FilterModel,
    FilterSettings,
    Given,
    Noise,
)
from terrain.estimation.ekf.state import (
    FilterState,
    columns_of,
    dropped_counts,
    initial_state,
    memory_of,
    noise_arrays,
)
from terrain.records import Array, StateTrack


def filter_step(
    model: FilterModel,
    noise: Noise,
    state: FilterState,
    time_s: float,
    z: Array,
    settings: FilterSettings = DEFAULT_SETTINGS,
    given: Given = NOTHING_GIVEN,
) -> FilterState:
    """Return the state after one sample; sample by sample a log gives what it gives at once, bit for bit.

    Parameters
    ----------
    model, noise, settings : as of :func:`run_filter`
    state : of the sample before, or :func:`initial_state`; it is not changed
    time_s : stamp of the sample; the first one starts the clock
    z : (m,) measurements, NaN where there is none
    given : what is known of this sample beside its measurements

    Returns
    -------
    FilterState
        with ``use`` all :data:`~terrain.records.ABSENT` and the state as it was, where the stamp did not
        advance, or leapt.

    Raises
    ------
    DataError
        where z or the variance has the wrong length.
    """
    if given.measurement_variance is None:
        given = given._replace(measurement_variance=noise.measurement_variance)
    memory, stamp_s = memory_of(state), np.array([time_s], dtype=np.float64)
    columns = _feed(model, noise, settings, stamp_s, np.asarray(z)[None], given, memory)
    for array in (*memory, *columns):
        array.flags.writeable = False
    seen_s, pending_s, age_s, likelihood = memory.clock.tolist()
    return FilterState(
        seen_s,
        memory.x,
        memory.p,
        columns.nis[0],
        columns.nis_dof[0],
        columns.use[0],
        age_s,
        likelihood,
        pending_s,
        memory.rejected_s,
        memory.counts,
        state.sensors,
    )


def run_filter(
    model: FilterModel,
    noise: Noise,
    time_s: Array,
    z: Array,
    settings: FilterSettings = DEFAULT_SETTINGS,
    inputs: Array | None = None,
) -> StateTrack:
    """Filter a whole log.

    Parameters
    ----------
    model : what is estimated, from what
    noise : how much either is off
    time_s : (n,) stamps, at any spacing
    z : (n, m) measurements, NaN where there is none
    settings : gates and gaps
    inputs : (n, k) of the step up to each sample; zeros without

    Returns
    -------
    StateTrack
        ``time_s`` increases strictly.  Left out and counted in ``dropped`` are rows whose stamp does not
        advance; the first row after a jump of more than ``max_gap_s`` forward or back, which is accepted when
        the next stamp follows it (so that one bad stamp costs one row); and, of a clock that was set back,
        the rows up to the time that the track had reached: the filter uses them, the track omits them.

    Raises
    ------
    DataError
        where the shapes do not fit each other, the model or the noise.

    Notes
    -----
    After a leap, means are kept and all covariances but those of the positions go back to the initial one, or
    stay where they were when wider; positions are as uncertain as the speeds that this allows make them over
    the gap.  The means are kept because a logger pauses more often than a drive ends, and because what a gap
    does not change, as a gyro's bias, is best known from before; the covariance makes either harmless.
    """
    stamps = np.array(time_s, dtype=np.float64)
    memory = memory_of(initial_state(model, noise))
    given = Given(noise.measurement_variance, noise.walk_variance, inputs)
    columns = _feed(model, noise, settings, stamps, z, given, memory)
    reached = np.maximum.accumulate(np.where(columns.taken, stamps, -np.inf))
    shown = columns.taken & (stamps > np.append(-np.inf, reached[:-1])[: stamps.size])
    dropped = dropped_counts(model.sensor_names, memory.counts)
    if not shown.all():
        if set_back := int((columns.taken & ~shown).sum()):
            dropped["clock set back"] = set_back
        stamps, columns = stamps[shown], Columns(*(column[shown] for column in columns))
    for array in (stamps, *columns):
        array.flags.writeable = False
    return StateTrack(
        stamps,
        columns.mean,
        columns.cov,
        model.states,
        columns.nis,
        columns.nis_dof,
        columns.use,
        model.sensor_names,
        columns.reference_age_s,
        float(memory.clock[LIKELIHOOD]),
        dropped,
    )


def log_likelihood(
    model: FilterModel,
    noise: Noise,
    time_s: Array,
    z: Array,
    settings: FilterSettings = UNGATED,
) -> float:
    """Return the log likelihood of a log without keeping its track; everything is believed by default."""
    memory = memory_of(initial_state(model, noise))
    stamps = np.array(time_s, dtype=np.float64)
    given = Given(noise.measurement_variance, noise.walk_variance)
    _feed(model, noise, settings, stamps, z, given, memory, keep=False)
    return float(memory.clock[LIKELIHOOD])


def _feed(
    model: FilterModel,
    noise: Noise,
    settings: FilterSettings,
    stamps: Array,
    z: Array,
    given: Given,
    memory: Memory,
    *,
    keep: bool = True,
) -> Columns:
    """Run the kernel, which moves the memory; return its columns, empty ones but the last unless kept."""
    fixed = noise_arrays(model, noise, settings)
    n, d, m = len(stamps), len(model.states), len(model.rows)
    values = np.array(z, dtype=np.float64, order="C")
    variance, walks, inputs = (
        np.zeros((1, columns))
        if array is None
        else np.array(np.atleast_2d(array), dtype=np.float64, order="C")
        for array, columns in zip(given, (m, d, len(model.inputs)), strict=True)
    )
    for name, shape, desired in (
        ("time_s", stamps.shape, [(n,)]),
        ("z", values.shape, [(n, m)]),
        ("measurement_variance", variance.shape, [(n, m), (1, m)]),
        ("walk_variance", walks.shape, [(n, d), (1, d)]),
        ("inputs", inputs.shape, [(n, len(model.inputs)), (1, len(model.inputs))]),
    ):
        if shape not in desired:
            raise DataError(f"filter {model.name}: {name} has shape {shape}, {desired[0]} is needed")
    columns = columns_of(model, n, keep=keep)
    samples = SampleArrays(stamps, values, variance, walks, inputs)
    run(FilterArrays(model.arrays, fixed, samples, memory, columns), model.propagate, model.observe)
    return columns
