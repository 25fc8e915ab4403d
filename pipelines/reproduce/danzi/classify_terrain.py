"""Section 8.1 of Danzi, AgriMaRo thesis: recognition of eight terrains from 208 windows of 2 s."""

from __future__ import annotations

from pipelines.reproduce.danzi.runs import FEW_RUNS, ROBOT, RUNS
from pipelines.reproduce.results import Finding, Row, Verdict, holds
from pipelines.stiffness.protocol import N_WINDOWS, classify_soils, level_result, soil_responses
from terrain.robots import load_robot


def classify_terrain(seed: int, quick: bool) -> Finding:
    """Cross-validate on windows of all soils, dealt at random and with whole runs held out."""
    robot = load_robot(ROBOT)
    responses = soil_responses(robot)
    found = classify_soils(robot, seed, FEW_RUNS if quick else RUNS)
    level, recall = level_result(found.by_run, responses), found.by_run.recall()
    difficulty = {name: each.difficulty_ratio for name, each in responses.items()}
    order = sorted(difficulty, key=lambda name: difficulty[name])
    weakest, where, no_figure = min(recall, key=lambda name: recall[name]), "8.1", '"excellent", no figure'
    random_why = (
        f"{found.n_windows} windows in steady motion, as many of each terrain ({N_WINDOWS} in the thesis), "
        "windows of one run on both sides of a split. The thesis names neither classes nor folds nor "
        "features: the eight described soils, five folds and the features of this project are assumed."
    )
    accuracy = float(found.by_run.correct.mean())
    interval = found.by_run.interval(seed)
    return Finding(
        [
            Row(
                "Accuracy on eight terrains, windows dealt at random",
                *(where, no_figure, float(found.at_random.correct.mean()), "ratio", Verdict.NOT_PRINTED),
                random_why,
            ),
            Row(
                "Accuracy on eight terrains, whole runs held out",
                *(where, no_figure, accuracy, "ratio", Verdict.NOT_PRINTED),
                "The same windows. Soil, load and slope differ from run to run; the interval is over runs.",
                spread=(min(interval[0], accuracy), max(interval[1], accuracy)),
            ),
            Row(
                f"Fraction of right windows on the weakest terrain ({weakest}), whole runs held out",
                *(where, '"solid and consistent" on all eight', recall[weakest], "ratio"),
                holds(recall[weakest] > 0.5),
                "The claim is taken to hold where most windows of each terrain are right.",
                beside=recall,
            ),
            Row(
                "Accuracy of the stiffness level (soft, firm, hard), whole runs held out",
                *(where, "clusters by stiffness, no figure", level.accuracy, "ratio", Verdict.NOT_PRINTED),
                "To confuse soft with hard costs 1, two terrains of one level 0.25.",
                beside={
                    "soft and hard confused": level.soft_hard_ratio,
                    "cost a window": level.cost,
                    "cost a window, terrain of least expected cost": level.least_cost,
                },
            ),
            Row(
                "Part of the largest thrust that resistance takes on dry sand",
                *(where, "least on paved ground, most on sand", difficulty["dry_sand"], "ratio"),
                holds(set(order[:2]) == {"asphalt", "tiles"} and order[-1] == "dry_sand"),
                "The order of the described soils by their own numbers, at a third of the robot's weight.",
                beside=difficulty,
            ),
        ]
    )
