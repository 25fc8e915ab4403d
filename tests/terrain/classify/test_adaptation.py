"""What shifted between sessions is found within its stated error, and is nothing where nothing shifted."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.classify import adaptation
from terrain.classify.adaptation import (
    COMMON,
    GAIN_STD,
    MIN_GAIN,
    START_S,
    adapt,
    check_adaptation,
    corrected,
    corrections,
    learn_adaptation,
    start_of,
)
from terrain.errors import ConfigError, DataError
from terrain.records import Windows

LEVELS = {"mud": np.array([2.0, 3.0]), "ice": np.array([0.8, 1.1])}
SHAKES = {"mud": 0.5, "ice": 1.5}
LEVELLED = (("wheels", "current_left_a"), ("wheels", "current_right_a"), ("imu", "accel_z_mps2"))
SPEEDS = (("wheels", "speed_left_mps"), ("wheels", "speed_right_mps"))
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")


def drives(terrains, seed=0, n_runs=6, n_windows=10, gain=1.0, offset_a=0.0, shaking=1.0, session=""):
    """Runs of windows of 2 s; each run scatters by 3 %, each window by 2 %, and drives at a speed of its own."""
    rng, parts = np.random.default_rng(seed), []
    for terrain in terrains:
        for k in range(n_runs):
            of_run, speed = 1.0 + 0.03 * rng.standard_normal(2), rng.uniform(0.4, 0.6)
            of_window = of_run + 0.02 * rng.standard_normal((n_windows, 2))
            current = gain * LEVELS[terrain] * of_window * (1.0 + speed) + offset_a
            wheels = np.empty((n_windows, 4, 10))
            wheels[:, :2] = speed + 0.001 * rng.standard_normal((n_windows, 2, 10))
            wheels[:, 2:] = current[:, :, None] + 0.01 * rng.standard_normal((n_windows, 2, 10))
            imu = 9.81 + shaking * SHAKES[terrain] * of_run[0] * rng.standard_normal((n_windows, 1, 100))
            name = np.full(n_windows, f"{session}{terrain}_{k}_{seed}", dtype=object)
            parts.append((wheels, imu, 2.0 * np.arange(n_windows), name, np.full(n_windows, terrain, object)))
    wheels, imu, start_s, run, terrain = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Windows(
        {"wheels": wheels, "imu": imu},
        {"wheels": WHEELS, "imu": ("accel_z_mps2",)},
        {"wheels": 5.0, "imu": 50.0},
        2.0,
        start_s,
        run,
        terrain,
        np.full(len(run), session, dtype=object),
    )


@pytest.fixture(scope="module")
def learned():
    return learn_adaptation(drives(["mud", "ice"]), LEVELLED, SPEEDS)


@pytest.mark.parametrize(
    ("gain", "offset_a", "shaking"), [(1.0, 0.0, 1.0), (1.3, 0.0, 1.0), (0.85, 0.2, 0.8), (1.2, -0.2, 1.25)]
)
@pytest.mark.parametrize("terrain", ["mud", "ice"])
def test_what_is_hidden_in_a_drive_on_a_known_ground_is_found_within_its_error(
    learned, terrain, gain, offset_a, shaking
):
    drive = drives([terrain], 7, 1, gain=gain, offset_a=offset_a, shaking=shaking)
    found = adapt(learned, drive, terrain)
    c = found.classes.index(terrain)
    truth = np.array([gain - 1.0, offset_a / found.scale[0], shaking - 1.0])
    assert found.parameters == ("gain of currents", "offset of currents", "gain of vibration")
    apart = found.shift.mean[c] - truth
    assert apart @ np.linalg.solve(found.shift.cov[c], apart) < 14.2  # 99.7 % of a chi-square of 3
    assert found.shift.cov[c][0, 0] < 0.7 * learned.prior_std[0] ** 2
    other = 1 - c  # of which half of the variance between sessions is known
    assert found.shift.mean[other] == pytest.approx(COMMON * found.shift.mean[c])
    assert np.linalg.eigvalsh(found.shift.cov[other] - found.shift.cov[c]).min() > 0.0
    prior = np.diag(learned.prior_std**2)
    assert found.shift.cov[other] == pytest.approx(prior - COMMON**2 * (prior - found.shift.cov[c]))
    assert f"times those of training, from 20 s on {terrain}" in found.found


def test_a_ground_without_a_name_is_found_where_no_gain_makes_one_of_the_other(learned):
    plain = adapt(learned, drives(["mud"], 8, 1))
    heavy = adapt(learned, drives(["mud"], 8, 1, gain=1.3))
    assert heavy.shift.mean[0][0] > plain.shift.mean[0][0] + 0.05
    assert (heavy.shift.mean[0] == heavy.shift.mean[1]).all()
    named = adapt(learned, drives(["mud"], 8, 1, gain=1.3), "mud")
    assert heavy.shift.cov[1][0, 0] > named.shift.cov[1][0, 0]
    assert "on a ground that was not named" in heavy.found
    own = (1.0 - COMMON) * np.diag(learned.prior_std**2)  # what the ground itself became is not known
    assert np.linalg.eigvalsh(heavy.shift.cov[0] - own).min() > 0.0
    repeated = adapt(learned, drives(["mud"], 8, 1, gain=1.3)[np.tile(np.arange(10), 4)]).shift
    assert repeated.mean == pytest.approx(heavy.shift.mean, rel=1e-6)  # a run is one observation


def test_nothing_shifted_changes_nothing_and_a_shift_is_corrected(learned):
    windows = drives(["mud"], 3, 1)
    theta, weight = corrections(learned)
    assert weight.tolist() == [[1.0, 1.0]]
    same = corrected(learned, windows, theta)
    assert all(np.allclose(same.values[name], windows.values[name], rtol=1e-14) for name in windows.values)
    shifted = drives(["mud"], 3, 1, gain=1.0, shaking=1.4)
    shifted.values["wheels"][:, 2:] = shifted.values["wheels"][:, 2:] * 1.25 + 0.1
    back = corrected(learned, shifted, np.array([0.25, 0.1 / learned.scale[0], 0.4]))
    for name in windows.values:
        assert np.allclose(back.values[name], windows.values[name], atol=0.15 if name == "imu" else 1e-9)
    less = corrected(learned, shifted, np.array([0.0, 9.0 / learned.scale[0], 0.0]))
    assert (less.values["wheels"][:, 2:] == 0.0).all()  # a magnitude stays one
    signed = replace(shifted, values={**shifted.values, "wheels": -shifted.values["wheels"]})
    least = [corrected(learned, windows, np.array([a, 0.0, a])).values for a in (-0.99, MIN_GAIN - 1.0)]
    assert all(np.array_equal(least[0][name], least[1][name]) for name in windows.values)
    mirrored = corrected(learned, signed, np.array([0.25, 0.1 / learned.scale[0], 0.4]))
    assert np.allclose(mirrored.values["wheels"][:, 2:], -back.values["wheels"][:, 2:])


def test_the_corrections_of_a_terrain_have_the_mean_and_the_covariance_of_its_shift(learned):
    for found in (adapt(learned, drives(["ice"], 4, 2), "ice"), learned.of_start()):
        points, weights = corrections(found)
        assert weights.sum(axis=0) == pytest.approx([1.0, 1.0])
        for c in range(2):
            mean = weights[:, c] @ points
            apart = points - mean
            assert mean == pytest.approx(found.shift.mean[c], abs=1e-12)
            assert (apart * weights[:, c, None]).T @ apart == pytest.approx(found.shift.cov[c], abs=1e-12)


def test_the_spread_of_sessions_is_learned_where_a_terrain_has_several():
    def learn(gains):
        parts = [
            drives(["mud", "ice"], k, 3, 6, gain=gain, session=f"session {k}") for k, gain in enumerate(gains)
        ]
        join = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("start_s", "run_id", "terrain", "session")
        }
        values = {name: np.concatenate([part.values[name] for part in parts]) for name in parts[0].values}
        return learn_adaptation(replace(parts[0], values=values, **join), LEVELLED, SPEEDS)

    same, apart = learn([1.0] * 4), learn([0.6, 0.9, 1.2, 1.5])
    assert same.n_sessions == apart.n_sessions == 8
    assert same.prior_std[0] < 0.8 * GAIN_STD < 1.5 * GAIN_STD < apart.prior_std[0]


def test_the_scatter_of_runs_is_that_of_runs_that_are_compared_with_others(learned):
    of_run = 0.03 * np.sqrt(
        np.mean([np.square(learned.level[learned.of == c].mean(axis=0)) for c in (0, 1)], 0)
    )
    assert learned.run_std[:2].sum() > of_run[:2].sum()


def test_the_start_of_a_session_goes_over_its_runs():
    one, two = drives(["mud"], 1, 2, 6, session="session 1"), drives(["ice"], 2, 1, 15)
    assert start_of(one).sum() == START_S / 2.0
    assert start_of(one).tolist() == [True] * 10 + [False] * 2
    assert start_of(two).tolist() == [True] * 10 + [False] * 5


def test_what_is_no_reference_is_refused_in_one_sentence(learned):
    drive = drives(["mud"], 5, 1)
    lacking = replace(drive, channels={**drive.channels, "imu": ("accel_x_mps2",)})
    for windows, terrain, kind, sentence in (
        (drive[:2], "mud", DataError, "the reference holds 4 s of windows; 5 s at least are needed to adapt"),
        (
            drive,
            "tar",
            ConfigError,
            "the model has not learned 'tar', so that it is no reference; it knows ice, mud",
        ),
        (lacking, "mud", DataError, "no channel 'accel_z_mps2' of stream 'imu', which adapting needs"),
    ):
        with pytest.raises(kind, match=sentence):
            adapt(learned, windows, terrain)
    with pytest.raises(ConfigError, match="has not learned 'tar'"):
        learned.of_start("tar")
    with pytest.raises(DataError, match="neither motor currents nor an IMU"):
        learn_adaptation(drive, (), SPEEDS)
    with pytest.raises(DataError, match="no terrain has two runs, so that"):
        learn_adaptation(drives(["mud", "ice"], 1, 1), LEVELLED, SPEEDS)


def test_what_a_file_holds_is_checked(learned):
    classes = ("ice", "mud")
    check_adaptation(learned, classes)
    check_adaptation(learned.of_start("mud"), classes)
    for spoilt in (
        learned._replace(classes=("ice", "tar")),
        learned._replace(scale=learned.scale[:2]),
        learned._replace(prior_std=np.array([0.2, np.nan, 0.1])),
        learned._replace(run_std=np.zeros(3)),
        learned._replace(width=0.0),
        learned._replace(parameters=("gain of wheels",)),
        learned._replace(of=np.zeros(len(learned.of), dtype=int)),
    ):
        with pytest.raises(DataError):
            check_adaptation(spoilt, classes)


def test_many_windows_are_compared_in_blocks_and_sessions_of_one_run_by_a_part_of_them(learned, monkeypatch):
    drive = drives(["mud"], 7, 1, gain=1.2)
    whole = adapt(learned, drive, "mud").shift
    monkeypatch.setattr(adaptation, "AT_ONCE_VALUES", 3 * learned.motion.size)
    blocks = adapt(learned, drive, "mud").shift
    np.testing.assert_allclose(blocks.mean, whole.mean, rtol=1e-9)
    windows, sizes, law = drives(["mud", "ice"]), [], adaptation._law
    monkeypatch.setattr(adaptation, "MAX_ROWS", 30)
    monkeypatch.setattr(adaptation, "_law", lambda *args: sizes.append(len(args[0])) or law(*args))
    of_runs = learn_adaptation(replace(windows, session=windows.run_id), LEVELLED, SPEEDS)
    assert max(sizes) <= 30
    np.testing.assert_allclose(of_runs.run_std, learned.run_std, rtol=0.5)


def test_a_run_is_known_better_by_more_windows_and_two_runs_better_than_by_one(learned):
    short, long, two = (
        adapt(learned, drives(["mud"], 7, n_runs, n), "mud").shift.cov
        for n_runs, n in ((1, 3), (1, 40), (2, 3))
    )
    c = learned.classes.index("mud")
    sizes = [np.sqrt(each[c][2, 2]) for each in (short, long, two)]
    assert sizes[0] > 1.02 * sizes[1] > sizes[2]
