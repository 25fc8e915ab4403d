"""Networks: two routes to each number, what they learn, and what they refuse."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import ShortTimeFFT
from sklearn.base import clone
from sklearn.utils.estimator_checks import (
    check_no_attributes_set_in_init,
    check_parameters_default_constructible,
)

from terrain.classify import grouped_network
from terrain.classify.augment import Augmentation, augmented, mirror_of, mirrors_of
from terrain.classify.grouped_network import GroupedNetwork, fill_of, fit_temperature
from terrain.classify.network import fit_member, fit_on_all, reproducible, task_of, weights_of
from terrain.classify.network_input import (
    SampleColumns,
    fourier_kernel,
    log_softmax,
    power_spectrogram,
    softmax,
    streams_of,
)
from terrain.classify.network_onnx import check_network, log_probabilities, network_onnx
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


def graph_of(task, nets):
    return network_onnx(
        COLUMNS,
        task.branches,
        [weights_of(net) for net in nets],
        np.zeros(WIDTH),
        1.0,
        list("abc")[: task.n_classes],
    )


def quick(**changed):
    return GroupedNetwork(COLUMNS, **({"n_members": 2, "epochs": 12, "trial_epochs": 0} | changed))


@pytest.fixture(scope="module")
def fitted():
    X, y, run = draw_windows()
    return quick().fit(X, y, run)


def test_constructor_keeps_its_parameters():
    check_no_attributes_set_in_init("GroupedNetwork", GroupedNetwork())
    check_parameters_default_constructible("GroupedNetwork", GroupedNetwork())
    assert clone(quick()).get_params() == quick().get_params()


def test_a_network_learns_a_vibration_of_runs_it_never_saw(fitted):
    X, y, _ = draw_windows(seed=1)
    assert np.mean(fitted.predict(X) == y) > 0.9
    probability = fitted.predict_proba(X)
    np.testing.assert_allclose(probability.sum(axis=1), 1.0)
    np.testing.assert_allclose(softmax(fitted.decision_function(X)), probability)


def test_labels_dealt_to_runs_at_random_are_not_learned():
    X, y, run = draw_windows(strength=0.0)
    model = quick().fit(X, y, run)
    test, truth, _ = draw_windows(seed=1, strength=0.0)
    assert np.mean(model.predict(test) == truth) < 0.5
    assert model.predict_proba(test).max(axis=1).mean() < 0.6  # and the temperature shows it


def test_the_graph_computes_what_torch_computes():
    X, y, run = draw_windows()
    index = np.unique(y, return_inverse=True)[1]
    task = task_of(COLUMNS, X.astype(np.float32), index, run)
    train, test = np.flatnonzero(run % 2 == 0), np.flatnonzero(run % 2 == 1)
    with reproducible():
        members = [fit_member(task, (train, test), Augmentation(shift=True), 2, seed) for seed in (0, 1)]
        rows = [torch.from_numpy(rows) for rows in task.rows(task.streams)]
        with torch.no_grad():
            desired = np.mean([torch.log_softmax(m.net(rows), 1).numpy() for m in members], axis=0)
    graph = graph_of(task, [member.net for member in members])
    check_network(graph, COLUMNS, 3)
    np.testing.assert_allclose(log_probabilities(graph, COLUMNS, X), log_softmax(desired), atol=2e-5)
    np.testing.assert_allclose(
        log_softmax(members[0].held_out), members[0].held_out, atol=1e-6, err_msg="log probabilities"
    )


def test_one_window_has_the_bytes_of_many(fitted):
    X, _, _ = draw_windows(seed=2, n_windows=30)
    whole = fitted.predict_proba(X)
    assert np.array_equal(np.concatenate([fitted.predict_proba(X[i : i + 1]) for i in range(40)]), whole[:40])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_leaves_the_generator_alone(fitted):
    X, y, run = draw_windows()
    torch.manual_seed(3)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    again = quick().fit(X, y, run)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    assert np.array_equal(again.predict_proba(X), fitted.predict_proba(X))
    assert not np.array_equal(quick(seed=1).fit(X, y, run).predict_proba(X), fitted.predict_proba(X))


def test_out_of_fold_probabilities_are_of_members_that_did_not_see_the_run(fitted):
    _, y, _ = draw_windows()
    held_out = fitted.inner_probability_
    assert np.isfinite(held_out).all()
    memorised = draw_windows(strength=0.0)
    model = quick(epochs=30).fit(*memorised)
    truth = np.searchsorted(model.classes_, memorised[1])
    of_truth = model.inner_probability_[np.arange(len(truth)), truth]
    assert of_truth.mean() < 0.45  # chance is 0.33: nothing of the held-out run is known
    assert np.mean(fitted.classes_[held_out.argmax(axis=1)] == y) > 0.8


def test_missing_samples_are_taken_for_the_mean_of_their_channel(fitted):
    X, _, _ = draw_windows(seed=3)
    damaged = X.copy()
    damaged[:, 100:] = np.nan
    filled = X.copy()
    filled[:, 100:] = fill_of(COLUMNS, draw_windows()[0])[100:]
    assert np.array_equal(fitted.predict_proba(damaged), fitted.predict_proba(filled))
    X_train, y, run = draw_windows()
    X_train[:, 100:] = np.nan  # never measured
    assert np.isfinite(quick(epochs=1).fit(X_train, y, run).predict_proba(X_train)).all()


def test_a_variation_is_kept_only_where_held_out_runs_are_more_likely_under_it():
    X, y, run = draw_windows()
    model = quick(trial_epochs=2).fit(X, y, run)
    losses = {each.augmentation: each.loss for each in model.trials_}
    assert {Augmentation(), Augmentation(shift=True), Augmentation(dropout=True)} <= losses.keys()
    assert Augmentation(mirror=True) in losses  # all channels have a mirror image
    chosen = Augmentation(*model.best_[:4])
    assert losses[chosen] == min(losses.values())


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda X, y, run: (X, np.full(len(y), "ice"), run), "all windows are 'ice'"),
        (lambda X, y, run: (X[:, :-1], y, run), "do not describe rows of 119 columns"),
        (lambda X, y, run: (X[[0, 39, 41]], y[[0, 39, 41]], run[[0, 39, 41]]), "too few to hold some"),
    ],
)
def test_what_cannot_be_learned_is_refused_in_one_sentence(change, sentence):
    with pytest.raises(DataError, match=sentence):
        quick(epochs=1).fit(*change(*draw_windows()))


def test_without_torch_training_is_refused_and_classifying_is_not(fitted, monkeypatch):
    X, y, run = draw_windows()
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConfigError, match="pip install"):
        quick().fit(X, y, run)
    assert fitted.predict_proba(X).shape == (len(X), 3)


def test_infinite_samples_and_other_widths_are_refused(fitted):
    with pytest.raises(DataError, match="infinite"):
        log_probabilities(fitted.onnx_, COLUMNS, np.full((1, WIDTH), np.inf))
    with pytest.raises(DataError, match="is needed"):
        log_probabilities(fitted.onnx_, COLUMNS, np.zeros((1, WIDTH - 1)))


def test_the_spectrogram_is_that_of_scipy():
    values = np.random.default_rng(0).standard_normal((2, 3, 200))
    found = power_spectrogram(values, 40, 10)
    transform = ShortTimeFFT(np.hanning(40), 10, fs=100.0, fft_mode="onesided", scale_to=None)
    centred = values - values.mean(axis=2, keepdims=True)
    slices = transform.stft(centred, p0=2, p1=19)  # those that lie inside of the window
    np.testing.assert_allclose(found, np.abs(slices[:, :, 1:]) ** 2, atol=1e-9)
    assert fourier_kernel(40).shape == (40, 40)


def test_a_window_of_a_long_run_weighs_less():
    X, y, _ = draw_windows(n_runs=1, n_windows=10)
    run = np.repeat(["long", "short"], [24, 6])
    weight = task_of(COLUMNS, X.astype(np.float32), np.unique(y, return_inverse=True)[1], run).weight
    assert weight.mean() == pytest.approx(1.0)
    assert weight[-1] / weight[0] == pytest.approx(2.0)  # sqrt(24 / 6)


def test_many_short_runs_outweigh_one_long_run():
    """Windows without any difference: 40 of one run against 30 of ten; their weights are 6.3 against 17.3."""
    rng = np.random.default_rng(0)
    index, run = np.repeat([0, 1], [40, 30]), np.concatenate([np.zeros(40), 1 + np.arange(30) // 3])
    X = rng.standard_normal((70, WIDTH)).astype(np.float32)
    task = task_of(COLUMNS, X, index, run)
    with reproducible():
        nets = [fit_on_all(task, Augmentation(shift=True), 6, seed) for seed in range(2)]
    other = rng.standard_normal((200, WIDTH))
    assert np.exp(log_probabilities(graph_of(task, nets), COLUMNS, other))[:, 1].mean() > 0.55


def test_all_inner_folds_choose_the_augmentation(monkeypatch):
    fits = []
    monkeypatch.setattr(
        grouped_network, "fit_member", lambda *given: fits.append(given) or fit_member(*given)
    )
    X, y, run = draw_windows(n_windows=4)
    model = quick(trial_epochs=1, epochs=1, n_inner_folds=4).fit(X, y, run)
    assert len(fits) == 4 * (len(model.trials_) + 1)


def test_a_slow_stream_and_a_short_window_have_no_spectrum():
    assert [each.frame for each in COLUMNS] == [20, 0]
    assert SampleColumns("imu", ("accel_z_mps2",), 50.0, 10).frame == 0


@given(st.integers(0, 2**32 - 1), st.sampled_from(["shift", "gain", "mirror", "dropout"]))
def test_a_variation_keeps_what_it_must(seed, name):
    rng = np.random.default_rng(seed)
    X, _, _ = draw_windows(n_runs=1, n_windows=2, seed=seed)
    streams = list(streams_of(COLUMNS, X))
    means = [values.mean(axis=(0, 2)) for values in streams]
    used = Augmentation(**{name: True})
    vibrates = [each.frame > 0 for each in COLUMNS]
    found = augmented(streams, means, used, mirrors_of(COLUMNS), vibrates, rng)
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


@pytest.mark.parametrize(
    ("channels", "signs"),
    [
        (("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"), (-1.0, 1.0, -1.0)),
        (("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"), (1.0, -1.0, 1.0)),
        (("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), (1.0, -1.0, -1.0)),
        (("current_left_a", "current_right_a"), (1.0, 1.0)),
    ],
)
def test_the_mirror_turns_what_geometry_turns(channels, signs):
    """A vector keeps x and z and turns y in the plane y = 0; a rate, an axial vector, the reverse."""
    mirror = mirror_of(channels)
    assert mirror.signs == signs
    twice = [mirror.places[place] for place in mirror.places]
    assert twice == list(range(len(channels)))


def test_wheels_with_numbers_and_a_side_alone_have_no_mirror():
    assert mirror_of(("current_1_a", "current_2_a")) is None
    assert mirror_of(("speed_left_mps",)) is None
    assert mirrors_of((COLUMNS[0], SampleColumns("wheels", ("motor_1_radps",), 10.0, 10))) is None


@pytest.mark.parametrize("temperature", [0.4, 1.0, 1.7, 4.0])
def test_the_temperature_is_found_again(temperature):
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(20000, 3))
    drawn = (softmax(logits).cumsum(axis=1) < rng.random((20000, 1))).sum(axis=1)
    assert fit_temperature(log_softmax(logits * temperature), drawn) == pytest.approx(temperature, rel=0.08)
