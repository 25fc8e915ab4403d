"""A trained model: the recipe, how its windows are cut, its limits, and what it is adapted by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from features.windows import Layout, SteadyMotion, WindowRule
from pipelines.report.numbers import format_value, plural
from pipelines.report.results import described
from terrain.classify.adaptation import Adaptation, adapt
from terrain.classify.answers import Answers
from terrain.classify.limits import Novelty, SupportTable
from terrain.classify.proposals import TakenOver
from terrain.classify.terrain_filter import NOVELTY_WEIGHTS, SHARE_POWERS, FilterSettings
from terrain.errors import DataError
from terrain.records import RunLog, Windows

NOTHING_TO_ADAPT = "the model knows no levels of currents or vibration that it could adapt by: train it anew"


@dataclass(frozen=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from."""

    classes: tuple[str, ...] = described("terrains, in the order of the probabilities")
    class_ratio: Mapping[str, float] = described("share of each terrain among the training windows")
    window_s: float = described("length of a window", "s")
    stride_s: float | None = described("from window to window; one length where it is none", "s")
    steady: SteadyMotion | None = described("limits of steady motion; None where all windows are kept")
    channels: Mapping[str, tuple[str, ...]] = described("channels that a log must have, by stream")
    rate_hz: Mapping[str, float] = described("their rates", "Hz")
    least_rate_hz: Mapping[str, float] = described(
        "lowest rates from which they are resampled; their own where none is shown not to matter", "Hz"
    )
    run_digests: tuple[str, ...] = described("digest of each training run")
    run_accuracy: Mapping[str, float] = described("of each training run when held out, by its digest", "1")
    package_version: str = described("of the package that trained it")
    recipe: str = described("what was trained")
    signal_sets: tuple[str, ...] = described("whose channels the features use")
    seed: int = described("deals runs into folds")
    measured_digests: tuple[str, ...] = described(
        "of what was measured in each, whatever its names, labels and estimates", default=()
    )
    data_digest: str = described("digest of the training runs", default="")
    dataset: str = described("name of the training data", default="")
    commit: str = described("of the code", default="")
    robots: tuple[str, ...] = described("robots whose runs it was trained on", default=())
    filter: str = described("filter whose estimates it uses; empty where it uses none", default="")
    own_code: tuple[str, ...] = described("MODULE.NAME of all that it needs beside the package", default=())
    conformal: float | None = described("threshold of the sets of terrains, None without", default=None)
    share_power: float | None = described(
        "power of the class ratios that the terrain filter divides by; None where single windows are better",
        default=SHARE_POWERS[0],
    )
    novelty_weight: float = described(
        "of the novelty's log-likelihood in the terrain filter", default=NOVELTY_WEIGHTS[0]
    )
    known_refused: tuple[float, float, float] | None = described(
        "part of held-out windows of learned terrains that is called unknown, and its interval of 95 % over units; "
        "None where not measured",
        "1",
        default=None,
    )
    taken_over: tuple[TakenOver, ...] = described("wrong proposals of labels for held-out runs", default=())

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz, {**self.rate_hz, **self.least_rate_hz})

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)

    def trained_on(self, run: RunLog) -> bool:
        """Whether a run was in training, by its content or by what was measured in it."""
        from terrain.logs.duplicates import measured_digest
        from terrain.logs.run_folders import data_digest

        return self.trained_on_digests(data_digest([run]), measured_digest(run).hex())

    def trained_on_digests(self, digest: str, measured: str) -> bool:
        """Whether a run of these digests was in training."""
        return digest in self.run_digests or (measured != "" and measured in self.measured_digests)

    @property
    def cut_words(self) -> str:
        """How windows must be cut, in words."""
        motion = "all motion" if self.steady is None else "steady motion"
        return f"{self.window_s:g} s every {self.rule.step_s:g} s, {motion}"


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)``, ``classes_`` and ``matrix`` of features.  ``novelty``, ``support`` and
    ``answers`` are None of training runs that give none; ``over_time`` are the settings of the filter of its outputs,
    where they are to be filtered; ``adaptation`` is what was learned of sessions, and the shift of the present one.
    """

    recipe: Any
    info: ModelInfo
    novelty: Novelty | None = None
    support: SupportTable | None = None
    over_time: FilterSettings | None = None
    adaptation: Adaptation | None = None
    answers: Answers | None = None

    @property
    def session_shift(self) -> Adaptation | None:
        """The adaptation, where it shifts the present session; None elsewhere."""
        return self.adaptation if self.adaptation is not None and self.adaptation.shift is not None else None

    def adapt(self, windows: Windows, terrain: str = "") -> TerrainModel:
        """Return the model for a session, of which there are some windows: all on one terrain, or on what is not known.

        Raises
        ------
        ConfigError
            if the terrain was not learned.
        DataError
            if the windows are too few or lack a channel, or the model has nothing to adapt by.
        """
        if self.adaptation is None:
            raise DataError(NOTHING_TO_ADAPT)
        return self._replace(adaptation=adapt(self.adaptation, windows, terrain))

    def at_start(self, terrain: str = "") -> TerrainModel:
        """Return the model as a session begins with it: its first 20 s adapt it, on a terrain or none that is known.

        Errors as :meth:`adapt`.
        """
        if self.adaptation is None:
            raise DataError(NOTHING_TO_ADAPT)
        return self._replace(adaptation=self.adaptation.of_start(terrain))


def with_start(model: TerrainModel, adapt: str, terrain: str) -> TerrainModel:
    """Return a model as sessions begin with it.

    Parameters
    ----------
    adapt : ``start``, which adapts; ``spread``, the spread of sessions throughout; ``none``; empty: ``start`` where
        that is shown to help, unless the model is one that was adapted and saved
    terrain : of each start; errors as :meth:`TerrainModel.at_start`
    """
    known = model.adaptation
    if adapt == "none" and known is not None:
        return model._replace(adaptation=known._replace(start=None, shift=None))
    unasked = not adapt and known is not None and known.shown and known.shift is None
    if adapt not in ("start", "spread") and not unasked:
        return model
    begun = model.at_start(terrain)
    if adapt != "spread":
        return begun
    assert begun.adaptation is not None
    return begun._replace(adaptation=begun.adaptation._replace(start=None))


def training_words(n_runs: int, accuracy: float | None, n_judged: int) -> str:
    """Return the accuracy of runs that were in training, and what it does not say."""
    of = plural(n_runs, "run")
    if accuracy is None:
        return f"{of} trained the model"
    right = f"{format_value(accuracy, '.1%')} of {n_judged} labelled windows are right"
    return f"of {of} that trained the model {right}, which says nothing of others"
