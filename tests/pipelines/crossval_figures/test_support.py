"""The heat map shows the rows of the report."""

import numpy as np

from pipelines.crossval_figures.support import support_figure
from pipelines.reporting.numbers import NOT_KNOWN
from pipelines.support.results import SupportReport, SupportRow

ROWS = (
    SupportRow("ICE", "straight at 0.1 to 0.3 m/s", 12, 3, 0.75),
    SupportRow("ICE", "spin at 0.1 to 0.3 m/s", 0, 0, None),
    SupportRow("MUD", "straight at 0.1 to 0.3 m/s", 40, 5, 0.9),
    SupportRow("MUD", "spin at 0.1 to 0.3 m/s", 4, 1, 0.0),
)


def test_cells_hold_accuracy_windows_and_runs_and_a_dash_where_nothing_was_driven():
    axes = support_figure(SupportReport(ROWS, None, ()), "moor").axes[0]
    assert [text.get_text() for text in axes.texts] == [
        "75%\n(12, 3)",
        NOT_KNOWN,
        "90%\n(40, 5)",
        "0%\n(4, 1)",
    ]
    drawn = np.ma.asarray(axes.collections[0].get_array())
    np.testing.assert_allclose(drawn.filled(np.nan), [[0.75, np.nan], [0.9, 0.0]])
