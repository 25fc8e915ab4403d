"""A truth and its measurements, drawn from a filter's own equations."""

import numpy as np

from terrain.angles import wrapped


def sample_from_model(model, n, dt_s, rng):
    """Return ``time_s (n,), truth (n, d), z (n, m)``; the truth starts from the initial mean and variance."""
    d, m = len(model.states), len(model.rows)
    x = model.initial_mean + np.linalg.cholesky(model.initial_variance) @ rng.standard_normal(d)
    values, vectors = np.linalg.eigh(model.process_variance * dt_s)
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
