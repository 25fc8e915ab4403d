"""What ``import terrain`` offers: lazily, in one place, as tables, and with one sentence where a folder hides it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import terrain
from features.windows import WindowRule, cut_windows
from terrain.records import RunLog, Stream

ROOT = Path(terrain.__file__).resolve().parents[1]
HEAVY = ("numpy", "scipy", "pandas", "sklearn", "numba", "torch", "mlflow", "matplotlib", "pyarrow")


def python(code, folder):
    words = [sys.executable, "-c", code]
    return subprocess.run(
        words, capture_output=True, text=True, cwd=folder, check=False, env={"PYTHONPATH": str(ROOT)}
    )


def test_importing_loads_nothing_heavy_and_lists_the_names(tmp_path):
    code = f"import sys, terrain; print([name for name in {HEAVY} if name in sys.modules], 'explain' in dir(terrain))"
    assert python(code, tmp_path).stdout == "[] True\n"


def test_every_name_is_there_and_another_lists_them():
    for name in terrain.FACE:
        found = getattr(terrain, name)
        assert callable(found)
        assert found.__doc__
    with pytest.raises(AttributeError, match="has no attribute 'nothing'; it has load_runs"):
        terrain.nothing  # noqa: B018


@pytest.mark.parametrize("name", ["features", "pipelines"])
def test_a_folder_that_hides_a_package_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    code = f"import sys; sys.path[:0] = ['', {str(ROOT)!r}]; import terrain; terrain.load_runs"
    done = python(code, tmp_path)
    assert (
        f"ImportError: the package '{name}' of terrain cannot be imported: {tmp_path / name} comes before"
        in done.stderr
    )


def made_run():
    time_s = np.arange(0.0, 5.0, 0.1)
    wheels = Stream(time_s, np.column_stack([time_s, 1.0 + time_s]), ("speed_left_mps", "speed_right_mps"))
    imu = Stream(time_s + 0.05, time_s[:, None], ("gyro_z_radps",))
    return RunLog("a", "husky", {"wheels": wheels, "imu": imu}, ((0.0, 5.0, "grass"),))


def test_runs_streams_and_windows_are_tables():
    run = made_run()
    table = run.streams["wheels"].to_pandas()
    assert table.loc[0.5].to_dict() == pytest.approx({"speed_left_mps": 0.5, "speed_right_mps": 1.5})
    whole = run.to_pandas()
    assert whole.shape == (100, 3)
    assert whole["imu"]["gyro_z_radps"].count() == 50
    windows = cut_windows([run], WindowRule(2.0, steady=None)).windows
    assert windows.to_pandas()["run_id"].tolist() == ["a", "a"]
    samples = windows.to_pandas("wheels")
    assert samples.shape == (40, 2)
    assert samples.loc[1, "speed_left_mps"].iloc[0] == windows.values["wheels"][1, 0, 0]
    assert repr(windows) == "2 windows of 2 s from 1 runs: grass"
    assert terrain.Runs([run]).to_pandas()["terrain"].tolist() == ["grass"]
    assert "1 run of husky on grass" in terrain.Runs([run])._repr_html_()
