"""Statistics of a slip track over a window; slip is NaN where it is undefined, and so are they."""

from __future__ import annotations

import numpy as np

from terrain.records import Array

MIN_DEFINED_FRACTION = 0.5  #: With a smaller fraction of the window defined, its slip statistics are NaN

SLIP_STATISTICS: tuple[str, ...] = ("mean", "std", "min", "max", "mean_abs", "median")


def slip_statistics(slip_ratio: Array) -> Array:
    """Return statistics of the defined slip samples of each wheel in each window.

    Parameters
    ----------
    slip_ratio : (n_windows, wheels, n_samples), not finite where undefined

    Returns
    -------
    (n_windows, wheels, len(SLIP_STATISTICS)), all NaN where over half of the samples are undefined

    Examples
    --------
    >>> slip_statistics(np.array([[[0.1, np.nan, 0.3]], [[np.nan, np.nan, 0.3]]]))[:, 0, 0].round(3)
    array([0.2, nan])
    """
    slip_ratio = np.where(np.isfinite(slip_ratio), slip_ratio, np.nan)
    out = np.full((*slip_ratio.shape[:2], len(SLIP_STATISTICS)), np.nan)
    known = (~np.isnan(slip_ratio)).mean(axis=2) >= MIN_DEFINED_FRACTION
    if known.any():
        samples = slip_ratio[known]
        out[known] = np.stack(
            [
                np.nanmean(samples, axis=1),
                np.nanstd(samples, axis=1),
                np.nanmin(samples, axis=1),
                np.nanmax(samples, axis=1),
                np.nanmean(np.abs(samples), axis=1),
                np.nanmedian(samples, axis=1),
            ],
            axis=1,
        )
    return out
