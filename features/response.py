"""Windows to wheel speeds and what the wheels answer: means of each wheel's current, or of its slip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from features.extractor import FeatureExtractor
from features.windows import WindowRule, cut_windows, layout_of
from terrain.classify.response import ResponseColumns
from terrain.errors import DataError
from terrain.logs.regimes import regime_of
from terrain.records import Array, RunLog, Windows
from terrain.slip_learning.currents import Cases
from terrain.slip_learning.measured import MeasuredSlip

#: Quantity and unit of the channels that are responses, by signal set.
RESPONSES: Mapping[str, tuple[str, str]] = {"currents": ("current", "a"), "slip": ("slip", "ratio")}
#: Share of the median speed of a window below which its wheels do not turn yet, or no longer: such samples are left
#: out of its means.
MIN_TURNING = 0.5


class ResponseExtractor(FeatureExtractor):
    """Turn windows into means of wheel speeds and of responses, wheel by wheel.

    A current that has a sign counts as positive where it drives the wheel on, so that it compares with one
    that a logger stores as a magnitude.

    Responses are those of :data:`RESPONSES` among the signal sets; wheel speeds are always used.

    Attributes
    ----------
    columns_ : :class:`~terrain.classify.response.ResponseColumns` of the matrix

    Examples
    --------
    >>> values = np.array([[[0.1] * 8, [0.2] * 8, [3.0] * 8, [4.0] * 8]])
    >>> names = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
    >>> windows = Windows({"wheels": values}, {"wheels": names}, {"wheels": 4.0}, 2.0, np.zeros(1),
    ...                   np.array(["a"]), np.array(["grass"]))
    >>> ResponseExtractor().fit_transform(windows)
    array([[0.1, 0.2, 3. , 4. ]])
    """

    def fit(self, X: Windows, y: Any = None) -> ResponseExtractor:
        """Learn which wheels and responses the windows have; ``DataError`` where one of the two is missing."""
        super().fit(X, y)
        wheels, quantities = self._responses()
        self.columns_ = ResponseColumns(len(wheels), len(wheels) * len(quantities))
        return self

    @property
    def uses_features(self) -> bool:
        """Whether the matrix holds the features: it does not."""
        return False

    def matrix(self, windows: Windows, features: Array) -> Array:
        """Return the matrix (n_windows, n_wheels + n_responses); NaN where a window has no sample."""
        values, (wheels, quantities) = self.selected(windows), self._responses()
        rows = {
            name: values[stream][:, i]
            for stream, names in self.layout_.channels.items()
            for i, name in enumerate(names)
        }
        speeds = np.stack([rows[f"speed_{wheel}_mps"] for wheel in wheels], axis=1)
        norm = np.linalg.norm(speeds, axis=1)
        turning = norm >= MIN_TURNING * np.median(norm, axis=1, keepdims=True)
        columns = [_mean(speeds, turning)]
        sign = np.where(columns[0] < 0.0, -1.0, 1.0)
        for quantity, unit in quantities:
            each = np.stack([rows[f"{quantity}_{wheel}_{unit}"] for wheel in wheels], axis=1)
            beside = each.shape[2] == turning.shape[1]
            mean = _mean(each, turning if beside else np.ones((len(each), each.shape[2]), dtype=bool))
            columns.append(mean if quantity == "current" and not (each < 0.0).any() else mean * sign)
        return np.concatenate(columns, axis=1)

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column with its unit."""
        wheels, quantities = self._responses()
        names = [f"wheels.speed_{wheel}.mean [m/s]" for wheel in wheels]
        for quantity, _ in quantities:
            stream, unit = ("wheels", "A") if quantity == "current" else ("slip", "1")
            names += [f"{stream}.{quantity}_{wheel}.mean [{unit}]" for wheel in wheels]
        return np.array(names, dtype=object)

    def _responses(self) -> tuple[list[str], list[tuple[str, str]]]:
        """Return the wheels, and quantity and unit of each response that all of them have."""
        speeds = self.layout_.channels.get("wheels", ())
        wheels = [name[6:-4] for name in speeds if name.startswith("speed_") and name.endswith("_mps")]
        if not wheels:
            raise DataError("responses are compared at the speeds of the wheels, and the windows have none")
        present = {name for names in self.layout_.channels.values() for name in names}
        found = [
            (quantity, unit)
            for name, (quantity, unit) in RESPONSES.items()
            if name in self.signal_sets and {f"{quantity}_{wheel}_{unit}" for wheel in wheels} <= present
        ]
        if not found:
            raise DataError(
                "the windows have no response of each wheel: a current or a slip (signal sets "
                f"{' and '.join(RESPONSES)}) is needed beside the wheel speeds"
            )
        return wheels, found


def slip_cases(measured: Sequence[RunLog], slips: Sequence[MeasuredSlip], window_s: float) -> Cases:
    """Return the windows of runs whose slip was measured in steady motion, with what may predict it.

    ``DataError`` where the runs have no currents, or no window has a slip.
    """
    steady = {each.run_id: each for each in slips if each.known.size}
    runs = [run for run in measured if run.run_id in steady]
    if not runs:
        raise DataError(
            f"no window of {window_s:g} s has a measured slip in steady motion that could be predicted; a "
            "shorter --window may"
        )
    sets, rule = ("wheels", "currents"), WindowRule(window_s, None, None)
    starts = {name: each.start_s[each.known] for name, each in steady.items()}
    layout = layout_of(runs, sets, speeds=True)
    windows = cut_windows(runs, rule, layout=layout, starts_s=starts, skip_short=True).windows
    places = {
        (name, round(float(each.start_s[k]), 6)): each.body_slip[k]
        for name, each in steady.items()
        for k in each.known
    }
    found = [
        places[name, round(float(s), 6)] for name, s in zip(windows.run_id, windows.start_s, strict=True)
    ]
    about = {
        run.run_id: (run.terrains[0] if len(run.terrains) == 1 else "", run.session, regime_of(run))
        for run in runs
    }
    terrain, session, regime = zip(*(about[name] for name in windows.run_id), strict=True)
    extractor = ResponseExtractor(sets).fit(windows)
    return Cases(
        extractor.transform(windows),
        extractor.columns_,
        np.array(found),
        windows.run_id.astype(str),
        *(np.array(each) for each in (terrain, session, regime)),
    )


def _mean(values: Array, used: Array) -> Array:
    """Return means (n, c) over the samples (n, c, s) that are used (n, s) and finite; NaN without any."""
    known = np.isfinite(values) & used[:, None, :]
    n = known.sum(axis=2)
    total = np.where(known, values, 0.0).sum(axis=2)
    return np.asarray(np.divide(total, n, out=np.full(n.shape, np.nan), where=n > 0))
