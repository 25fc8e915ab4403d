"""Innovations of a right filter are white and as large as it says; they are the NIS that the filter keeps."""

import numpy as np

from terrain.estimation.consistency import innovations, sample_from_model
from terrain.estimation.filter import FilterSettings, run_filter
from terrain.estimation.models.swerve import default_noise, make_filter
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")


def filtered(seed=0):
    model = make_filter("vio15", ROBOT)
    noise = default_noise("vio15", ROBOT)
    time_s, _, drawn = sample_from_model(model, noise, 1500, 0.02, np.random.default_rng(seed))
    z = np.array(drawn)
    z[200:250, model.rows.index("camera_speed_x_mps")] = np.nan
    track = run_filter(model, noise, time_s, z, FilterSettings(gate_probability=1.0))
    return model, track, innovations(model, noise, track, z)


def test_scaled_innovations_have_unit_variance_and_no_memory():
    _, _, found = filtered()
    scaled = np.column_stack([value / std for value, std in found.values()])[50:]
    assert np.isnan([value[0] for value, _ in found.values()]).all()
    for column in scaled.T:
        column = column[np.isfinite(column)]
        assert abs(column.var() - 1.0) < 5 * np.sqrt(2 / column.size)
        assert abs(np.mean(column[1:] * column[:-1])) < 5 / np.sqrt(column.size)


def test_the_first_sensor_of_a_step_has_the_square_that_the_filter_kept():
    model, track, found = filtered()
    _, rows = model.sensors[0]  # conditioned on first: its prediction is that of the step
    assert len(rows) == 1
    value, std = found[rows[0]]
    np.testing.assert_allclose((value / std)[1:] ** 2, track.nis[1:, 0], rtol=1e-6, atol=1e-9)


def test_missing_measurements_have_no_innovation():
    _, _, found = filtered()
    value, std = found["camera_speed_x_mps"]
    assert np.isnan(value[200:250]).all()
    assert np.isnan(std[200:250]).all()
    assert np.isfinite(value[251:]).all()


def test_the_first_row_after_a_gap_has_no_innovation():
    model, noise = make_filter("vio15", ROBOT), default_noise("vio15", ROBOT)
    time_s, _, z = sample_from_model(model, noise, 400, 0.02, np.random.default_rng(1))
    time_s = np.where(np.arange(400) < 200, time_s, time_s + 6.0)
    track = run_filter(model, noise, time_s, z)
    found = innovations(model, noise, track, z[np.searchsorted(time_s, track.time_s)])
    after = int(np.flatnonzero(np.diff(track.time_s) > 1.0)[0]) + 1
    for value, std in found.values():
        assert np.isnan([value[after], std[after]]).all()
        assert np.isfinite(value[after + 1 :]).all()
