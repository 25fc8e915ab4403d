"""Controllers whose classifier was never or hardly believed: what they show is not its effect."""

from __future__ import annotations

from pipelines.drive.controller_names import USING_CLASSIFIER, base_name
from pipelines.drive.results import DriveResult
from pipelines.reporting.numbers import format_number
from terrain.control.comparison import MeanInterval

HARDLY_BELIEVED_RATIO = 0.1
"""Below this ratio of the driving time with a known terrain, nine tenths of a drive are the fallback's."""

_UNKNOWN = MeanInterval(None, None, 0)


def is_hardly_believed(result: DriveResult, name: str) -> bool:
    """Return whether a controller uses a classifier that was never or hardly believed."""
    believed = result.controllers[name].get("believed_ratio", _UNKNOWN).mean
    return base_name(name) in USING_CLASSIFIER and believed is not None and believed < HARDLY_BELIEVED_RATIO


def belief_notes(result: DriveResult) -> tuple[str, ...]:
    """Return a sentence on each controller whose classifier was never or hardly believed."""
    return tuple(_note(result, name) for name in result.controllers if is_hardly_believed(result, name))


def _note(result: DriveResult, name: str) -> str:
    metrics = result.controllers[name]
    believed = metrics["believed_ratio"].mean or 0.0
    how = f"in {100.0 * believed:.1f} % of the driving time only" if believed else "at no time"
    outputs = ", ".join(
        f"{format_number(mean)} {text}"
        for key, text in (
            ("n_accepted", "accepted"),
            ("n_below_threshold", "below the threshold"),
            ("n_refused", "refused"),
        )
        if (mean := metrics.get(key, _UNKNOWN).mean) is not None
    )
    return (
        f"{name} knew the terrain {how} (outputs of its classifier in a drive: {outputs or 'unknown'}): it "
        "drove on the targets of the table's fallback, and no difference to another controller is a gain of "
        "the classifier."
    )
