"""`terrain explain --against`: what changed to another folder of runs, and what it refuses."""

import json

import pytest

from pipelines.explain.explain import PAGE_FILE
from terrain.logs.run_folders import write_run


@pytest.fixture(scope="module")
def folders(a_run, tmp_path_factory):
    """Return a folder of runs, and one of the same robot with tyres that lost air."""
    first, second = (tmp_path_factory.mktemp(name) for name in ("full", "flat"))
    for i in range(7):
        write_run(a_run(i), first)
        write_run(a_run(20 + i, effects={"camera_yaw_rad": 0.04, "wheel_radius_ratio": -0.06}), second)
    return first, second


def test_what_changed_to_the_other_folder_stands_first_and_in_json(terrain, folders, place):
    first, second = folders
    words = ("explain", "--data", first, "--against", second, "--robot", "husky", "--out", "compared")
    code, out, err = terrain(*words, "--effects", "camera_yaw,wheel_radius", "--json", "compared.json")
    assert code == 0, err
    against = json.loads((place / "compared.json").read_text())["against"]
    (changed,) = against["differences"]
    assert changed["name"] == "wheel_radius"
    assert changed["parameters"][0]["value"] == pytest.approx(-0.06, abs=0.012)
    assert against["ci"][0] > 0.0
    assert out.startswith(f"From these runs to {second.name} changed: wheel radius by")
    assert f"What changed to {second.name}" in (place / "compared" / PAGE_FILE).read_text()


def test_a_folder_does_not_differ_from_itself(terrain, folders):
    code, _, err = terrain(
        *("explain", "--data", folders[0], "--against", folders[0], "--robot", "husky", "--out", "same")
    )
    assert code == 2
    assert "--against is the folder of --data" in err
