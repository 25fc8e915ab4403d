"""A truth and its measurements, drawn from a filter's own equations; and the smallest filter, a carriage on a line."""

import dataclasses

import numpy as np

from terrain.angles import wrapped
from terrain.estimation.filter import FilterModel, process_noise
from terrain.kernels import njit


def sample_from_model(model, n, dt_s, rng):
    """Return ``time_s (n,), truth (n, d), z (n, m)``; the truth starts from the initial mean and variance."""
    d, m = len(model.states), len(model.rows)
    x = model.initial_mean + np.linalg.cholesky(model.initial_variance) @ rng.standard_normal(d)
    values, vectors = np.linalg.eigh(process_noise(model, dt_s))
    walk = rng.standard_normal((n, d)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    z = rng.standard_normal((n, m)) * np.sqrt(model.measurement_variance)
    is_angle_state, is_angle_row = (
        np.isin(names, angles)
        for names, angles in ((model.states, model.angle_states), (model.rows, model.angle_rows))
    )
    params = np.append(model.params, np.zeros(len(model.inputs)))
    truth, x_next, z_hat = np.empty((n, d)), np.zeros(d), np.zeros(m)
    for k in range(n):
        if k > 0:
            model.propagate(x, dt_s, params, x_next, np.zeros((d, d)))
            x = x_next + walk[k]
            x[is_angle_state] = wrapped(x[is_angle_state])
        truth[k] = x
        model.observe(x, params, z_hat, np.zeros((m, d)))
        z[k] += z_hat
    z[:, is_angle_row] = wrapped(z[:, is_angle_row])
    return np.arange(n) * dt_s, truth, z


@njit
def drift(x, dt, params, x_next, f):
    x_next[0], x_next[1] = x[0] + dt * x[1], x[1]
    f[0, 0], f[0, 1], f[1, 1] = 1.0, dt, 1.0


@njit
def fix(x, params, z_hat, h):
    z_hat[0], z_hat[1] = x[0], x[1]
    h[0, 0], h[1, 1] = 1.0, 1.0


def carriage(**changes):
    """A line, and a sensor for either state."""
    return dataclasses.replace(
        FilterModel(
            name="carriage",
            states=("position_m", "speed_mps"),
            rows=("place_m", "rate_mps"),
            sensors=(("place", ("place_m",)), ("rate", ("rate_mps",))),
            propagate=drift,
            observe=fix,
            params=np.zeros(1),
            process_variance=np.square([1e-3, 0.1]),
            measurement_variance=np.square([0.05, 0.05]),
            initial_variance=np.ones(2),
            references=("rate",),
            positions=("position_m",),
        ),
        **changes,
    )


CARRIAGE = carriage()
