"""What is known of a trained model, and what registering it gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from features.windows import Layout, SteadyMotion, WindowRule


class Registered(NamedTuple):
    """A registered version of a model, and whether the alias ``champion`` moved to it."""

    model_uri: str
    version: str
    run_id: str
    alias_moved: bool
    alias_reason: str


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from.

    Parameters
    ----------
    classes : in the order of the probabilities
    window_s, stride_s, steady : the rule of the windows
    channels, rate_hz : by stream, which a log must have
    run_digests : of each training run
    recipe, signal_sets, seed : what was trained
    data_digest, dataset : of the training runs
    commit, package_version : of the code
    robots : whose runs the training runs were, by name
    filter : that made the streams ``estimator`` and ``slip``; empty where the model uses neither
    evaluation : figures on held-out runs by name, as ``accuracy``; empty where it was not evaluated
    class_ratio : share of each class among the training windows; empty of models of earlier releases
    run_accuracy : of the windows of each training run when it was held out, by its digest
    support : training runs of each terrain by motion, a :class:`~terrain.classify.support.SupportTable`
    conformal : threshold of the sets of classes; None, as ``support``, where there is none
    """

    classes: tuple[str, ...]
    window_s: float
    stride_s: float | None
    steady: SteadyMotion | None
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    run_digests: tuple[str, ...]
    recipe: str = ""
    signal_sets: tuple[str, ...] = ()
    seed: int = 0
    data_digest: str = ""
    dataset: str = ""
    commit: str = ""
    package_version: str = ""
    robots: tuple[str, ...] = ()
    filter: str = ""
    evaluation: Mapping[str, float] = field(default_factory=dict)
    class_ratio: Mapping[str, float] = field(default_factory=dict)
    run_accuracy: Mapping[str, float] = field(default_factory=dict)
    support: Mapping[str, Any] | None = None
    conformal: float | None = None

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Return the record of a JSON document; ``TypeError`` or ``KeyError`` where it is no such."""
        steady = document.get("steady")
        changed: dict[str, Any] = {
            "steady": None if steady is None else SteadyMotion(**steady),
            "class_ratio": {
                name: float(ratio) for name, ratio in dict(document.get("class_ratio", {})).items()
            },
            "channels": {stream: _texts(names) for stream, names in document["channels"].items()},
        }
        conformal = document.get("conformal")
        changed["conformal"] = None if conformal is None else float(conformal)
        for name in ("classes", "run_digests", "signal_sets", "robots"):
            changed[name] = _texts(document.get(name, ()))
        return cls(**{**document, **changed})

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz)

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)


def _texts(given: Any) -> tuple[str, ...]:
    texts = tuple(given)
    if isinstance(given, str) or not all(isinstance(text, str) for text in texts):
        raise TypeError(f"{given!r:.40} is no list of texts")
    return texts
