"""Networks: two routes to each number, what they learn, and what they refuse."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import ShortTimeFFT
from scipy.special import log_softmax

from terrain.classify.network import (
    Augmentation,
    GroupedNetwork,
    SampleColumns,
    Training,
    augmented,
    check_network,
    fit_temperature,
    log_probabilities,
    mirror_of,
    mirrors_of,
    network_onnx,
    power_spectrogram,
    reproducible,
    streams_of,
)
from terrain.errors import ConfigError, DataError

COLUMNS = (
    SampleColumns("imu", ("gyro_z_radps", "accel_z_mps2"), 50.0, 50),
    SampleColumns("wheels", ("speed_left_mps", "speed_right_mps"), 10.0, 10),
)
WIDTH = sum(each.width for each in COLUMNS)


def draw_windows(n_runs=4, n_windows=10, seed=0, strength=1.0):
    """Return samples, classes and runs: the classes vibrate at 5, 12 and 20 Hz."""
    rng = np.random.default_rng(seed)
    terrain = np.repeat(["ice", "sand", "snow"], n_runs * n_windows)
    run = np.repeat(np.arange(3 * n_runs), n_windows)
    time_s = np.arange(50) / 50.0
    hz = {"ice": 5.0, "sand": 12.0, "snow": 20.0}
    phase = rng.uniform(0, 2 * np.pi, len(run))
    wave = np.array([np.sin(2 * np.pi * hz[t] * time_s + p) for t, p in zip(terrain, phase, strict=True)])
    imu = rng.standard_normal((len(run), 2, 50))
    imu[:, 1] += strength * wave
    wheels = rng.standard_normal((len(run), 2, 10))
    return np.concatenate([imu.reshape(len(run), -1), wheels.reshape(len(run), -1)], axis=1), terrain, run


def quick(**changed):
    return GroupedNetwork(COLUMNS, **({"n_members": 2, "epochs": 12, "trial_epochs": 0} | changed))


@pytest.fixture(scope="module")
def fitted():
    X, y, run = draw_windows()
    return quick().fit(X, y, run)


def test_a_network_learns_a_vibration_of_runs_it_never_saw(fitted):
    X, y, _ = draw_windows(seed=1)
    assert np.mean(fitted.predict(X) == y) > 0.9
    # One window has the bytes of many.
    one_by_one = np.concatenate([fitted.predict_proba(X[i : i + 1]) for i in range(40)])
    assert np.array_equal(one_by_one, fitted.predict_proba(X)[:40])
    with pytest.raises(DataError, match="infinite"):
        log_probabilities(fitted.onnx_, COLUMNS, np.full((1, WIDTH), np.inf))
    with pytest.raises(DataError, match="is needed"):
        log_probabilities(fitted.onnx_, COLUMNS, np.zeros((1, WIDTH - 1)))


def test_the_graph_computes_what_torch_computes():
    import torch  # takes seconds, which processes without this file do not need

    X, y, _ = draw_windows()
    run = np.repeat([0, 1], [96, 24])
    training = Training(COLUMNS, X.astype(np.float32), np.unique(y, return_inverse=True)[1], run)
    assert training.weight[-1] / training.weight[0] == pytest.approx(2.0)  # of a long run less: sqrt(96 / 24)
    with reproducible():
        nets = [
            list(training.epochs(np.arange(60), Augmentation(shift=True), 2, seed))[-1] for seed in (0, 1)
        ]
        rows = [torch.from_numpy(rows) for rows in training.rows(training.streams)]
        with torch.no_grad():
            desired = np.mean([torch.log_softmax(net(rows), 1).numpy() for net in nets], axis=0)
    graph = network_onnx(training, nets, np.zeros(WIDTH), 1.0, list("abc"))
    check_network(graph, COLUMNS, 3)
    np.testing.assert_allclose(log_probabilities(graph, COLUMNS, X), log_softmax(desired, axis=1), atol=2e-5)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_leaves_the_generator_alone(fitted):
    import torch

    X, y, run = draw_windows()
    torch.manual_seed(3)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    again = quick().fit(X, y, run)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    assert np.array_equal(again.predict_proba(X), fitted.predict_proba(X))
    assert not np.array_equal(quick(seed=1).fit(X, y, run).predict_proba(X), fitted.predict_proba(X))


def test_what_cannot_be_learned_is_refused_and_without_torch_classifying_is_not(fitted, monkeypatch):
    X, y, run = draw_windows()
    few = [0, 39, 41]
    for rows, sentence in (
        ((X, np.full(len(y), "ice"), run), "all windows are 'ice'"),
        ((X[:, :-1], y, run), "do not describe rows of 119 columns"),
        ((X[few], y[few], run[few]), "too few to hold some"),
    ):
        with pytest.raises(DataError, match=sentence):
            quick(epochs=1).fit(*rows)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConfigError, match="pip install"):
        quick().fit(X, y, run)
    assert fitted.predict_proba(X).shape == (len(X), 3)


def test_the_spectrogram_is_that_of_scipy():
    values = np.random.default_rng(0).standard_normal((2, 3, 200))
    found = power_spectrogram(values, 40, 10)
    transform = ShortTimeFFT(np.hanning(40), 10, fs=100.0, fft_mode="onesided", scale_to=None)
    centred = values - values.mean(axis=2, keepdims=True)
    slices = transform.stft(centred, p0=2, p1=19)  # those that lie inside of the window
    np.testing.assert_allclose(found, np.abs(slices[:, :, 1:]) ** 2, atol=1e-9)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["shift", "gain", "mirror", "dropout"]))
def test_a_variation_keeps_what_it_must(seed, name):
    rng = np.random.default_rng(seed)
    X, _, _ = draw_windows(n_runs=1, n_windows=2, seed=seed)
    streams = list(streams_of(COLUMNS, X))
    means = [values.mean(axis=(0, 2)) for values in streams]
    used = Augmentation(**{name: True})
    found = augmented(streams, means, used, COLUMNS, rng)
    for before, after, mean in zip(streams, found, means, strict=True):
        assert after.shape == before.shape
        if name == "shift":
            np.testing.assert_array_equal(np.sort(after, axis=2), np.sort(before, axis=2))
        elif name == "gain":
            ratio = after / before
            np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1, :1], ratio.shape))
            assert (ratio > 0).all()
            assert before.shape[2] == 50 or (ratio == 1).all()  # wheels turn as fast as they did
        elif name == "mirror":
            np.testing.assert_allclose(np.abs(after).sum(axis=(1, 2)), np.abs(before).sum(axis=(1, 2)))
        else:
            kept = (after == before).all(axis=(1, 2))
            assert (kept | (after == mean[:, None]).all(axis=(1, 2))).all()
    if name == "dropout":
        failed = [(after != before).any(axis=(1, 2)) for before, after in zip(streams, found, strict=True)]
        assert not (failed[0] & failed[1]).any()  # one sensor at a time


def test_the_mirror_turns_what_geometry_turns():
    """A vector keeps x and z and turns y in the plane y = 0; a rate, an axial vector, the reverse."""
    for channels, mirror in (
        (("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"), ((0, 1, 2), (-1.0, 1.0, -1.0))),
        (("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"), ((0, 1, 2), (1.0, -1.0, 1.0))),
        (("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), ((0, 1, 2), (1.0, -1.0, -1.0))),
        (("current_left_a", "current_right_a"), ((1, 0), (1.0, 1.0))),
        (("current_1_a", "current_2_a"), None),  # wheels with numbers have places that only the robot knows
        (("speed_left_mps",), None),
    ):
        assert mirror_of(channels) == mirror
    with_numbers = SampleColumns("wheels", ("motor_1_radps",), 10.0, 10)
    assert mirrors_of((COLUMNS[0], with_numbers)) is None


@pytest.mark.parametrize("temperature", [0.4, 1.7])
def test_the_temperature_is_found_again(temperature):
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(20000, 3))
    drawn = (np.exp(log_softmax(logits, axis=1)).cumsum(axis=1) < rng.random((20000, 1))).sum(axis=1)
    assert fit_temperature(log_softmax(logits * temperature, axis=1), drawn) == pytest.approx(
        temperature, rel=0.08
    )
