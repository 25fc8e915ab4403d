"""A polynomial of slip and angle: how well a fit without any mechanics predicts, for reference."""

from __future__ import annotations

import numpy as np

from terrain.records import Array
from terrain.soil_identification.laws import Prediction
from terrain.soil_identification.trials import Trials

DEGREE = 4


def polynomial_predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
    """Return forces over the load and sinkage by ridge regression on a polynomial of slip and angle.

    The strength of the ridge is chosen by leave-one-out on the training part.

    Parameters
    ----------
    training : means of settings
    tested : trials
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    targets = np.column_stack(
        [training.pull_n / training.load_n, training.side_n / training.load_n, training.sinkage_m * 10.0]
    )
    model = make_pipeline(
        StandardScaler(),
        PolynomialFeatures(DEGREE),
        StandardScaler(),
        RidgeCV(alphas=np.logspace(-4, 3, 29), alpha_per_target=True),
    )
    model.fit(_features(training), targets)
    pull, side, depth = model.predict(_features(tested)).T
    unknown = np.full(len(tested), np.nan)
    return {"load": Prediction(pull * tested.load_n, side * tested.load_n, depth / 10.0, unknown)}


def _features(trials: Trials) -> Array:
    return np.column_stack([trials.slip_ratio, trials.slip_angle_rad])
