"""Settings of ``terrain quickstart``."""

from __future__ import annotations

from pathlib import Path

from pipelines.crossval.settings import CrossvalSettings
from pipelines.learn.train import TrainingSettings
from pipelines.report.settings import Settings, setting


class QuickstartSettings(Settings):
    """Which runs are used, where the report goes, and under which name the model is registered."""

    data: Path | None = setting(None, "Folder of labelled runs; without, runs are simulated.")
    out: Path = setting(Path("terrain-report"), "Folder of the runs and the report.")
    name: str = setting("quickstart", "Name of the registered model.")
    seed: int = setting(0, "Deals runs into folds; of the simulation, too.", ge=0)
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    merge_duplicates: bool = setting(
        False, "Treat runs that hold the same measurements as one run instead of refusing them."
    )

    @property
    def evaluation(self) -> CrossvalSettings:
        """How the recipe is evaluated: by the defaults of ``terrain crossval``."""
        return CrossvalSettings(seed=self.seed, n_jobs=self.n_jobs)

    def training(self, evaluation: CrossvalSettings) -> TrainingSettings:
        """Return how the recipe of an evaluation is trained."""
        return TrainingSettings(name=self.name, **evaluation.shared())
