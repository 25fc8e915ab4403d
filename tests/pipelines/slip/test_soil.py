"""``terrain calibrate --what soil``: from two files of trials to a soil file, pictures and JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from pipelines.cli.main import app
from terrain.slip_learning.soil import LAWS, SINKAGES, WHEELS, Trials, forces_of, sinkage_of
from terrain.terramechanics.inflow_wheel import FORCE
from terrain.terramechanics.soil import load_soil

HEADER = (
    "trial_num,beta,slip,Vry,avg_Vx,std_Vx,avg_Vry,std_Vry,avg_Fx,std_Fx,avg_Fy,std_Fy,avg_Fz,std_Fz,"
    "avg_angle,avg_Z,std_Z"
)
SPEEDS_MMPS, ANGLES_DEG = (0.0, 5.0, 10.0, 20.0, 40.0), (0.0, 20.0, 40.0, 60.0, 90.0)
"""Without a speed or an angle there are just as many settings as a fit takes."""


def write_trials(path, seed=0):
    """Trials of a smooth wheel that Wong and Reece's law describes, with noise of 2 % of the load."""
    law, wheel = LAWS["wong_reece"], WHEELS["testbed_smooth"]
    speed, angle = (grid.ravel() for grid in np.meshgrid(SPEEDS_MMPS, ANGLES_DEG))
    n = speed.size
    slip, blank = (speed - 10.0) / np.maximum(speed, 10.0), np.zeros(n)
    trials = Trials(
        *(speed * 1e-3 / wheel.radius_m, np.full(n, 0.01), np.radians(angle), slip, np.full(n, 20.0)),
        *(blank, blank, blank, speed, angle, np.ones(n)),
    )
    start = np.array([value for value, _ in SINKAGES[law.sinkage].values()])
    depth = sinkage_of(law, start, trials, wheel)
    found = forces_of(law, np.array([FORCE[name][0] for name in law.free]), trials, wheel, depth)
    noise = 0.4 * np.random.default_rng(seed).standard_normal((2, n))
    rows = [
        f"1,{angle[i]},{slip[i]:.6f},{speed[i]},10,0.1,{speed[i]},0.1,"
        f"{found.side_n[i] + noise[0, i]:.4f},0.5,"
        f"{-found.pull_n[i] + noise[1, i]:.4f},0.5,-20,0.2,{angle[i]},{-depth[i] * 1e3:.4f},0.1"
        for i in range(n)
    ]
    path.mkdir()
    (path / "smooth.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    return path


def test_the_law_that_made_the_trials_holds_on_what_was_left_out(tmp_path):
    """The command over trials that are also those to check on."""
    data, out = str(write_trials(tmp_path / "bed")), tmp_path / "out"
    words = ["--data", data, "--check", data, "--out", str(out), "--figures", str(out), "--draws", "2"]
    words += ["--laws", "simulator,wong_reece", "--json", str(tmp_path / "soil.json")]
    done = CliRunner().invoke(app, ["calibrate", "--what", "soil", *words])
    assert done.exception is None, done.output
    result, screen = json.loads((tmp_path / "soil.json").read_text()), done.output
    (wheel,) = result["wheels"]
    simulator, wong_reece = wheel["laws"]
    assert (wheel["wheel"], wheel["n_trials"], wheel["n_settings"]) == ("smooth", 25, 25)
    assert wong_reece["angle"]["load"]["pull_ratio"] < 0.06
    assert wong_reece["angle"]["reached"]
    assert simulator["angle"]["load"]["pull_ratio"] > wong_reece["angle"]["load"]["pull_ratio"]
    assert wheel["checked"]["load"]["pull_ratio"] < 0.06
    true = FORCE["tan_friction"][0]
    assert wheel["parameters"]["tan_friction"]["value"] == pytest.approx(true, abs=0.1)
    assert "Cohesion against friction" in wheel["not_identified"][0]
    assert "25 further trials" in screen
    assert sorted(map(str, out.iterdir())) == sorted(result["files"])
    # the soil is one that the simulator takes
    soil, kphi = load_soil(out / "testbed_sand_smooth.yaml"), wheel["soil"]["fit"]["values"]["kphi_npmn2"]
    assert (soil.name, soil.kphi_npmn2) == ("testbed_sand_smooth", pytest.approx(kphi, rel=1e-3))
    text = (out / "testbed_sand_smooth.yaml").read_text()
    assert (text.count("assumed"), text.count("95 %")) == (5, 4)
