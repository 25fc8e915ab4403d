"""The page on a recipe of one's own, run as it stands: compared, trained, registered, predicted and served live."""

import json
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from joblib.externals.loky import get_reusable_executor

from pipelines.data.datasets import load_runs
from pipelines.learn.model_file import read_files, read_model
from pipelines.learn.predict import predict
from pipelines.learn.trust import trust_file
from pipelines.live.observer import Observer
from terrain.control.slip_table import load_slip_table
from terrain.logs.replay import replay
from terrain.logs.run_folders import write_run

PAGE = Path(__file__).resolve().parents[3] / "docs" / "add_a_recipe.md"


@pytest.mark.slow
def test_the_page_runs_as_it_stands(terrain, place, drive_all, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(place / "configuration"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    get_reusable_executor().shutdown()  # processes of other tests, which know other paths
    python = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    shell = re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    estimator, feature, compare = python
    assert max(len(part.split("\n\n\n")[-1].splitlines()) for part in (estimator, feature)) <= 14
    (place / "field_code.py").write_text(f"{estimator}\n\n{feature}", encoding="utf-8")
    (place / "compare.py").write_text(compare, encoding="utf-8")
    for run in drive_all(n_runs=6):
        write_run(run, place / "runs")
    commands = [line for part in shell for line in part.splitlines()]
    assert [line.split()[1] for line in commands] == ["crossval", "train", "predict", "serve", "predict"]

    def do(line):
        code, _, err = terrain(*shlex.split(line)[1:], "--json", "found.json")
        assert code == 0, err
        return json.loads(Path("found.json").read_text())

    found = do(commands[0])
    assert [each["recipe"] for each in found["contenders"]] == ["svm", "field_code:Discriminant", "plain"]
    sys.path.insert(0, str(place))
    runpy.run_path("compare.py")
    assert not trust_file().exists()
    code, _, err = terrain("predict", "--data", "runs", "--model", "field")
    assert (code, err.count("\n")) == (2, 1)
    assert "field_code.Discriminant, which is run only where you trust it: --trust field_code, once" in err
    shutil.copytree("field", "of_another_machine")
    do(commands[1])  # trains, and trusts
    assert "field_code" in json.loads(trust_file().read_text())
    predicted = do(commands[2])
    assert (predicted["accuracy"], predicted["training_accuracy"] > 0.5) == (
        None,
        True,
    )  # all were in training
    live = do(commands[3])
    windows = [window for run in live["runs"] for window in run["windows"]]
    assert [(each["terrain"], each["probability"]) for each in windows] == [
        (each["terrain"] if each["terrain"] != "unknown" else "", pytest.approx(each["probability"]))
        for each in predicted["windows"]
    ]
    trust_file().unlink()
    assert terrain("inspect", "field")[0] == 2
    do(commands[4])
    assert "field_code.roughness" in terrain("inspect", "of_another_machine", "--details")[1]
    assert (
        terrain("predict", "--data", "runs", "--model", "of_another_machine")[0] == 0
    )  # trusted once, and for all

    model, runs = read_model("field"), load_runs(Path("runs"))
    assert read_files(Path("field"))[0].own_code == ("field_code.Discriminant", "field_code.roughness")
    observer = Observer(model)
    outputs = [output for sample in replay(runs[0]) for output in observer.update(sample.readings)]
    rows = predict(runs[:1], model, load_slip_table()).windows
    assert len(outputs) == len(rows) > 5
    np.testing.assert_allclose(
        [max(output.probabilities.values()) for output in outputs],
        [row.probability for row in rows],
        rtol=1e-9,
    )
