"""``terrain reproduce``: a paper's experiments rerun in simulation, its figures beside the simulated ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from pipelines.reporting.progress import Progress, silent
from pipelines.reproduce.page import html_page
from pipelines.reproduce.papers import PAPERS, assumed_numbers
from pipelines.reproduce.results import Experiment, ExperimentRow, Picture, Reproduction, Verdict
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write, ensure_writable


def reproduce(
    paper: str, out: Path, seed: int = 0, progress: Progress = silent, *, quick: bool = False
) -> Reproduction:
    """Rerun a paper's experiments and write the page ``<paper>.html``.

    Parameters
    ----------
    paper : one of :data:`pipelines.reproduce.papers.PAPERS`
    out : folder of the page
    seed : of all runs
    progress : called after each experiment
    quick : fewer and shorter runs, to try it out

    Raises
    ------
    ConfigError
        if there is no such paper.
    TerrainError
        if the folder cannot be written.
    """
    if paper not in PAPERS:
        raise ConfigError(f"there is no paper {paper!r} to reproduce; there are {', '.join(PAPERS)}")
    known = PAPERS[paper]
    ensure_writable(out)
    experiments: Sequence[Experiment] = import_module(known.module).EXPERIMENTS
    rows: list[ExperimentRow] = []
    pictures: list[Picture] = []
    for done, experiment in enumerate(experiments):
        found = experiment.run(seed, quick)
        rows += [ExperimentRow(experiment.title, row) for row in found.rows]
        pictures += found.pictures
        progress(f"reproduce {paper}", done + 1, len(experiments))
    counts = Counter(each.row.verdict for each in rows)
    result = Reproduction(
        paper=paper,
        title=known.title,
        about=known.about,
        seed=seed,
        quick=quick,
        rows=tuple(rows),
        verdicts={verdict: counts[verdict] for verdict in Verdict},
        assumed=assumed_numbers(known.descriptions),
        command=f"terrain reproduce {paper} --seed {seed}",
        report=out / f"{paper}.html",
    )
    atomic_write(result.report, html_page(result, pictures))
    return result
