import numpy as np
import pytest

from pipelines.classify.importance import channel_importance, channel_of
from pipelines.crossval.evaluation import Examples
from pipelines.crossval.splits import Fold
from terrain.classify.folds import split_runs
from terrain.classify.svm import GroupedSVC

NAMES = [
    f"{stream}.{channel}.{statistic} [1]"
    for stream, channel in (("imu", "accel_z"), ("imu", "gyro_x"), ("wheels", "current_left"))
    for statistic in ("std", "rms", "crest")
]


def importance(hidden, seed=0):
    """Return drops by channel; only the features of channel ``hidden`` depend on the terrain, all alike."""
    rng = np.random.default_rng(4)
    run = np.repeat(np.arange(12), 30)
    y = np.array(["ice", "mud", "snow"])[run % 3]
    features = rng.standard_normal((len(y), len(NAMES)))
    if hidden is not None:
        columns = [i for i, name in enumerate(NAMES) if channel_of(name) == hidden]
        signal = 3.0 * (run % 3) + 0.3 * rng.standard_normal(len(y))
        features[:, columns] = signal[:, None] + 0.01 * features[:, columns]
    folds = [Fold(0, k, *rows) for k, rows in enumerate(split_runs(y, run, 4, np.random.default_rng(0)))]
    rows = channel_importance(
        GroupedSVC(((10.0, 0.4, 100.0),)), Examples(features, y, run), NAMES, folds, seed, 1
    )
    assert [row.drop for row in rows] == sorted((row.drop for row in rows), reverse=True)
    return {row.feature: (row.drop, row.std) for row in rows}


@pytest.mark.parametrize("hidden", ["imu.accel_z", "imu.gyro_x", "wheels.current_left"])
def test_the_channel_that_depends_on_the_terrain_is_named(hidden):
    """Its features repeat each other: shuffled one by one, none would be missed."""
    drops = importance(hidden)
    assert next(iter(drops)) == hidden
    assert drops[hidden][0] > 0.5  # from nearly all right to one in three
    assert all(abs(drop) < 0.1 for channel, (drop, _) in drops.items() if channel != hidden)


def test_where_no_channel_depends_on_it_none_is_named():
    assert all(abs(drop) < 0.1 for drop, _ in importance(None).values())


def test_shuffles_repeat_with_their_seed():
    assert importance("imu.gyro_x") == importance("imu.gyro_x") != importance("imu.gyro_x", seed=1)
