"""How long features and the answer for a window take, beside tsfel and scikit-learn on the same windows.

Run by ``pytest tests/benchmarks --benchmark-enable``.  Calls of one group do the same windows, so that their
times can be divided; all of it runs on one core.
"""

import numpy as np
import pytest
import tsfel
from sklearn.impute import SimpleImputer
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from features.answers import answers_of
from features.extractor import FeatureExtractor
from features.motion import window_motion
from features.recipes import make_recipe
from features.windows import cut_windows
from pipelines.data.datasets import load_runs
from pipelines.live.assess import assess
from pipelines.live.model import TerrainModel
from terrain.classify.answers import learn_answers
from terrain.classify.limits import learn_novelty, learn_support

N_COMPARED = 8  #: tsfel takes about a tenth of a second a window


@pytest.fixture(scope="module")
def borealtc_windows(datasets_dir):
    return cut_windows(load_runs(datasets_dir / "borealtc")).windows


@pytest.fixture(scope="module")
def compared(borealtc_windows):
    """Windows to compare on."""
    return borealtc_windows[np.linspace(0, len(borealtc_windows) - 1, N_COMPARED).astype(int)]


COMPARED = pytest.mark.benchmark(group=f"{N_COMPARED} windows of borealtc")


def warmed_up(windows):
    extractor = FeatureExtractor().fit(windows)
    extractor.transform(windows[:1])
    return extractor


def report(benchmark, n_windows, n_features):
    benchmark.extra_info["n_features"] = n_features
    if benchmark.stats:  # absent where benchmarks are off
        benchmark.extra_info["ms_per_window"] = 1e3 * benchmark.stats.stats.median / n_windows


@COMPARED
def test_transform_of_all_windows_at_once(benchmark, compared):
    table = benchmark(warmed_up(compared).transform, compared)
    report(benchmark, *table.shape)


@COMPARED
def test_transform_of_windows_one_by_one(benchmark, compared):
    extractor = warmed_up(compared)
    rows = benchmark(lambda: [extractor.transform(compared[i]) for i in range(len(compared))])
    report(benchmark, len(rows), rows[0].shape[1])


@COMPARED
@pytest.mark.filterwarnings("ignore:Precision loss occurred in moment calculation:RuntimeWarning")
def test_tsfel_statistical_and_spectral(benchmark, compared):
    domains = tsfel.get_features_by_domain()
    chosen = {name: domains[name] for name in ("statistical", "spectral")}
    arrays = [
        (values[i].T, compared.rate_hz[name])
        for name, values in compared.values.items()
        for i in range(len(compared))
    ]

    def extract():
        return [
            tsfel.time_series_features_extractor(chosen, array, fs=rate_hz, verbose=0)
            for array, rate_hz in arrays
        ]

    tables = benchmark.pedantic(extract, rounds=3)
    report(benchmark, len(compared), sum(table.shape[1] for table in tables) // len(compared))


@pytest.mark.benchmark(group="all windows of borealtc, bar 0.5 s")
def test_all_windows_of_borealtc(benchmark, borealtc_windows):
    table = benchmark(warmed_up(borealtc_windows).transform, borealtc_windows)
    report(benchmark, *table.shape)
    assert len(table) > 1600


@pytest.mark.benchmark(group="one window, bar 2 ms")
def test_one_window_with_features_and_champion_in_its_thread(benchmark, borealtc_windows):
    model = champion(borealtc_windows)
    assessed = benchmark(assess, model, borealtc_windows[:1])
    assert np.isfinite(assessed.novelty).all()


@pytest.mark.benchmark(group="one window, bar 2 ms")
def test_one_window_with_features_and_scikit_learns_own_scaling_and_svm(benchmark, borealtc_windows):
    peer = make_pipeline(FeatureExtractor(), SimpleImputer(), StandardScaler(), SVC())
    peer.fit(borealtc_windows, borealtc_windows.terrain.astype(str))
    assert len(benchmark(peer.predict, borealtc_windows[:1])) == 1


def champion(windows):
    """Return the default recipe with all that a live window is asked, fitted on some windows."""
    terrain = windows.terrain.astype(str)
    recipe = make_recipe(candidates=[(10.0, 1.0, 80.0)]).fit(windows, terrain)
    features, motion = recipe[0].features_of(windows), window_motion(windows)
    moved = motion.speed_mps, motion.yaw_rate_radps
    support = learn_support(*moved, terrain, windows.run_id.astype(str), np.unique(terrain).tolist())
    novelty = learn_novelty(features, terrain, windows.run_id)
    end_s = windows.start_s + windows.length_s
    answers = learn_answers(answers_of(windows), terrain, windows.run_id, end_s)
    return TerrainModel(recipe, None, novelty, support, answers=answers)
