"""Heat map of held-out accuracy by terrain and regime of driving."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import FAINT_INK, INK, finished, new_figure, styled
from pipelines.reporting.numbers import NOT_KNOWN, percent, shorten
from pipelines.support.results import SupportReport, SupportRow


def support_figure(found: SupportReport, dataset: str | None = None) -> Figure:
    """Draw the accuracy of each terrain (down) in each regime (across).

    A cell has the percentage and below it windows and runs; a regime in which a terrain was never driven has
    a dash.
    """
    classes = list(dict.fromkeys(row.terrain for row in found.rows))
    regimes = list(dict.fromkeys(row.regime for row in found.rows))
    cells = {(row.terrain, row.regime): row for row in found.rows}
    accuracy = np.full((len(classes), len(regimes)), np.nan)
    for i, j in np.ndindex(accuracy.shape):
        known = cells[classes[i], regimes[j]].accuracy
        accuracy[i, j] = np.nan if known is None else known
    with styled():
        figure = new_figure(2.4 + 0.78 * len(regimes), 2.2 + 0.5 * len(classes))
        axes = figure.add_subplot()
        axes.pcolormesh(
            np.ma.masked_invalid(accuracy), cmap="Blues", vmin=0, vmax=1, edgecolors="white", lw=1.5
        )
        axes.set(xlim=(0, len(regimes)), ylim=(len(classes), 0))
        for i, j in np.ndindex(accuracy.shape):
            row = cells[classes[i], regimes[j]]
            dark = row.accuracy is not None and row.accuracy > 0.55
            colour = FAINT_INK if row.accuracy is None else "white" if dark else INK
            text = _cell_text(row)
            axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=7.5, color=colour)
        axes.set_xticks(np.arange(len(regimes)) + 0.5, [name.replace(" at ", "\n") for name in regimes])
        axes.set_yticks(np.arange(len(classes)) + 0.5, [shorten(name, 18) for name in classes])
        axes.tick_params(axis="x", labelsize=6.5, rotation=90)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_xlabel("driving")
        below = "accuracy when held out;\nin brackets windows and runs"
        axes.set_title(below, loc="left", fontsize=8, color=FAINT_INK)
        title = "Support" if dataset is None else f"Support, {shorten(dataset, 28)}"
        return finished(figure, title)


def _cell_text(row: SupportRow) -> str:
    if row.accuracy is None:
        return NOT_KNOWN
    return f"{percent(row.accuracy, 0)}\n({row.windows}, {row.n_runs})"
