"""What a wheel carries, what README promises, and that help loads nothing heavy."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "pandas", "sklearn", "scipy", "numba", "mlflow", "torch", "matplotlib", "pyarrow")


def test_help_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['terrain', '--help']\n"
        "from pipelines.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "import json; print('LOADED', json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "inspect" in done.stdout
    loaded = json.loads(done.stdout.rpartition("LOADED ")[2])
    assert not set(HEAVY) & set(loaded)


@pytest.fixture(scope="module")
def installed_wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    target = folder / "site"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target), str(wheel)],
        check=True,
        capture_output=True,
    )
    return target


@pytest.mark.slow
def test_the_wheel_runs_elsewhere_with_its_yaml(installed_wheel, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(installed_wheel)}
    code = (
        "import terrain, pipelines.cli.main\n"
        "from terrain.robots import load_robot\n"
        "from terrain.control.slip_table import load_slip_table\n"
        "print(terrain.__file__, load_robot('husky').track_m, load_slip_table().fallback)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    place, track_m, fallback = done.stdout.split()
    assert Path(place).is_relative_to(installed_wheel)
    assert (float(track_m), fallback) == (0.5708, "unknown")
    assert (installed_wheel / "pipelines" / "report" / "templates" / "page.html.j2").is_file()
    assert (installed_wheel / "terrain" / "_data" / "can" / "agrimaro.dbc").is_file()
    page = {file.name for file in (ROOT / "pipelines" / "serve" / "page").iterdir()}
    assert page == {file.name for file in (installed_wheel / "pipelines" / "serve" / "page").iterdir()}
    assert {"index.html", "page.js", "page.css"} <= page
    assets = {file.name for file in (installed_wheel / "pipelines" / "report" / "assets").iterdir()}
    assert {"uplot.js", "uplot.css", "report.js", "report.css"} <= assets
    packaged = {file.name for file in (installed_wheel / "terrain" / "_data").rglob("*.yaml")}
    assert packaged == {file.name for file in (ROOT / "data").rglob("*.yaml")}

    for number, spread in (("a", 0.1), ("b", 0.5)):
        lines = [f"{i / 50},{','.join([str(spread * ((i * 7919) % 13 - 6))] * 6)}" for i in range(200)]
        run = tmp_path / "logs" / number.upper()
        run.mkdir(parents=True)
        (run / "imu_1.csv").write_text("time,wx,wy,wz,ax,ay,az\n" + "\n".join(lines))
        pro = [f"{i / 10},1,1,0.5,0.5" for i in range(40)]
        (run / "pro_1.csv").write_text("time,curL,curR,velL,velR\n" + "\n".join(pro))
    terrain = str(installed_wheel / "bin" / "terrain")
    command = [terrain, "convert", "logs", "--out", "runs", "--json", "out.json"]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    assert json.loads((tmp_path / "out.json").read_text())["run_ids"] == ["A_1", "B_1"]


def test_readme_names_every_command_that_there_is():
    from pipelines.cli.table import COMMANDS

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [each.name for each in COMMANDS if f"terrain {each.name}" not in readme] == []
    assert len(readme.splitlines()) <= 120


def test_every_number_in_the_yaml_has_a_source():
    import yaml

    def bare_numbers(node: object, path: str) -> list[str]:
        if isinstance(node, dict):
            if node.get("source"):
                return []
            return [found for key, child in node.items() for found in bare_numbers(child, f"{path}/{key}")]
        if isinstance(node, list):
            return [found for i, child in enumerate(node) for found in bare_numbers(child, f"{path}/{i}")]
        return [path] if isinstance(node, int | float) and not isinstance(node, bool) else []

    files = sorted((ROOT / "data").rglob("*.yaml"))
    assert files
    content = {file.name: yaml.safe_load(file.read_text()) for file in files}
    assert [found for name, node in content.items() for found in bare_numbers(node, name)] == []


def test_the_first_mapping_of_its_page_is_accepted(tmp_path):
    from terrain.logs.mapping import find_runs, load_mapping

    page = (ROOT / "docs" / "mapping.md").read_text(encoding="utf-8")
    (tmp_path / "mapping.yaml").write_text(re.search(r"```yaml\n(.*?)```", page, flags=re.DOTALL)[1])
    (tmp_path / "ICE").mkdir()
    (tmp_path / "ICE" / "imu 1.csv").write_text("stamp,yaw rate,az\n0,90,1\n20,180,1\n")
    wheels = "logger 7\n\nt;vl;vr\ns;km/h;km/h\n0;3,6;7,4\n0,02;3,6;7,4\n"
    (tmp_path / "ICE" / "wheels 1.csv").write_text(wheels)
    (read,) = find_runs(tmp_path, load_mapping(tmp_path / "mapping.yaml"))
    run = read(repair=False)
    assert run.terrains == ("ICE",)
    assert run.streams["imu"].values[:, 0] == pytest.approx([-1.5708, -3.1416], abs=1e-4)
    assert run.streams["wheels"].values[0] == pytest.approx([1.0, 2.0])


def test_links_between_pages_lead_somewhere():
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    links = [
        (page, link)
        for page in pages
        for link in re.findall(r"\]\(([^)#:]+\.\w+)\)", page.read_text(encoding="utf-8"))
    ]
    assert len(links) > 8
    assert [(page.name, link) for page, link in links if not (page.parent / link).exists()] == []


def test_files_that_pages_name_are_there():
    pages = [ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    named = {
        (page.name, path)
        for page in pages
        for path in re.findall(r"`((?:terrain|pipelines|features|tests|data)/[\w/.]+)`", page.read_text())
    }
    assert len(named) > 30
    assert sorted(each for each in named if not (ROOT / each[1]).exists()) == []
