import numpy as np
import pytest

from pipelines.data.simulate import Settings
from pipelines.data.simulate import run as simulate_with
from pipelines.report.results import silent
from terrain.errors import ConfigError, LogError
from terrain.files.names import data_folder
from terrain.logs.run_folders import find_runs, read_run
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

ROBOT, HUSKY = load_robot("agrimaro"), load_robot("husky")
RUNS = ("tiles_survey_01", "tiles_straight_01", "tiles_straight_01")


def simulate_runs(robot, terrain, scenario, out, progress=silent, **options):
    return simulate_with(
        Settings(robot=robot, terrain=terrain, scenario=scenario, out=out, **options), progress
    )


def bytes_of(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def values_of(run):
    return {name: stream.values.tobytes() for name, stream in run.streams.items()}


def test_a_run_is_the_same_whatever_is_simulated_beside_it(tmp_path):
    options, name = {"duration_s": 4.0, "vary": True}, "grass_straight_01"
    alone = simulate_runs("agrimaro", "grass", "straight", tmp_path / "alone", runs=2, **options)
    beside = simulate_runs("agrimaro", "all", "straight", tmp_path / "all", **options)
    assert alone.run_ids == (name, "grass_straight_02")
    assert beside.n_runs == len(soil_names()) == len(set(beside.run_ids))
    assert bytes_of(tmp_path / "alone" / name) == bytes_of(tmp_path / "all" / name)
    assert beside.duration_s == pytest.approx(len(soil_names()) * 4.01, abs=0.01)
    by_terrain = {run.terrains: run for run in (read() for read in find_runs(tmp_path / "all"))}
    assert set(by_terrain) == {(terrain,) for terrain in soil_names()}

    simulate_runs("agrimaro", "grass", "straight", tmp_path / "b", seed=1, **options)
    simulate_runs("agrimaro", "grass", "straight", tmp_path / "c", runs=2, duration_s=4.0)
    second = read_run(tmp_path / "alone" / "grass_straight_02")
    assert values_of(second) == values_of(simulate_run(ROBOT, "grass", "straight", 0, 2, **options))
    others = [read_run(tmp_path / place) for place in (f"b/{name}", f"c/{name}", "c/grass_straight_02")]
    different = [*by_terrain.values(), second, *others]
    assert len({run.streams["truth"].values.tobytes() for run in different}) == len(different)


def test_conditions_scatter_more_than_noise_where_runs_vary():
    slips = {}
    for vary in (False, True):
        runs = [
            simulate_run(ROBOT, "grass", "straight", 0, k, duration_s=4.0, vary=vary) for k in range(1, 7)
        ]
        truths = [run.streams["truth"] for run in runs]
        slips[vary] = [np.mean(truth.channel("slip_1_ratio")[truth.time_s > 3.0]) for truth in truths]
    assert np.std(slips[True]) > 5 * np.std(slips[False])


def test_options_reach_the_run(tmp_path):
    """A slope of 0.1 pitches the robot and pulls at it, a load adds to that, and the camera is lost for 2 s."""
    steps = []
    slope = {"grade_deg": float(np.degrees(np.arctan(0.1))), "duration_s": 8.5, "camera_lost": ("2:4",)}
    for robot, scenario, options in (
        ("agrimaro", "survey", slope | {"gnss": True}),
        ("husky", "straight", slope | {"payload_kg": 25.0}),
        ("husky", "straight", {"duration_s": 8.5}),
    ):
        out = tmp_path / str(len(steps))
        simulate_runs(robot, "tiles", scenario, out, lambda *step: steps.append(step), seed=3, **options)
    assert steps == [("simulate", 1, 1)] * 3
    swerve, loaded, bare = (read_run(tmp_path / n / name) for n, name in zip("012", RUNS, strict=True))
    for run in (swerve, loaded):
        time_s = run.streams["odometry"].time_s
        assert not ((time_s >= 2.0) & (time_s < 4.0)).any()
    assert "gnss" in swerve.streams
    assert swerve.streams["imu"].channel("accel_x_mps2")[:50].mean() == pytest.approx(0.976, abs=0.1)
    assert loaded.streams["imu"].channel("pitch_rad").mean() == pytest.approx(-0.1, abs=0.01)
    current, level = (log.streams["wheels"].values[250:, 2:].sum(axis=1).mean() for log in (loaded, bare))
    amps_per_n = HUSKY.wheel_radius_m / (0.044 * 78.71 * 0.7)
    slope_n = 75.0 * 9.80665 * np.sin(np.arctan(0.1))
    assert (current - level) / amps_per_n == pytest.approx(slope_n, rel=0.1)


def test_a_soil_of_ones_own_goes_by_its_name_and_a_run_that_is_there_is_left_alone(tmp_path):
    own, out = tmp_path / "field 7.yaml", tmp_path / "runs"
    text = (data_folder("soils") / "grass.yaml").read_text(encoding="utf-8")
    own.write_text(text.replace("name: grass", "name: orchard"))
    result = simulate_runs("agrimaro", str(own), "straight", out, duration_s=4.0)
    assert result.run_ids == ("orchard_straight_01",)
    assert read_run(out / "orchard_straight_01").terrains == ("orchard",)
    (out / "orchard_straight_01").rename(out / "orchard_straight_02")
    with pytest.raises(LogError, match="orchard_straight_02: is there already"):
        simulate_runs("agrimaro", str(own), "straight", out, runs=3, duration_s=4.0)
    assert [path.name for path in out.iterdir()] == ["orchard_straight_02"]


COMMANDS = "time_s,speed_x_mps,speed_y_mps,yaw_rate_radps\n"


@pytest.mark.parametrize("robot", ["agrimaro", "husky", "marmotte"])
def test_commands_of_a_file_are_driven(tmp_path, robot):
    (tmp_path / "turn.csv").write_text(
        COMMANDS + "5,0,0,0\n6,0.4,0,0\n8,0.4,0,0\n9,0.4,0,0.2\n12,0.4,0,0.2\n"
    )
    made = simulate_runs(robot, "grass", str(tmp_path / "turn.csv"), tmp_path / "out", runs=2)
    assert made.run_ids == ("grass_turn_01", "grass_turn_02")
    run = read_run(tmp_path / "out" / "grass_turn_01")
    truth = run.streams["truth"]
    name = "speed_x_mps" if "speed_x_mps" in truth.channels else "speed_mps"
    speed, turn = (np.interp(6.5, truth.time_s, truth.channel(each)) for each in (name, "yaw_rate_radps"))
    assert 0.15 < speed < 0.41
    assert 0.05 < turn < 0.21
    assert run.streams["wheels"].duration_s == pytest.approx(7.0, abs=0.1)


@pytest.mark.parametrize(
    ("rows", "options", "says"),
    [
        ("0,0,0,0\n", {}, "two rows or more"),
        ("0,0,0,0\n0,1,0,0\n", {}, "rising times"),
        ("0,0,0,0\n1,,0,0\n", {}, "finite numbers"),
        ("0,0,0,0\n1,0.5,0.1,0\n", {}, "does not drive sideways"),
        ("0,0,0,0\n1,50,0,0\n", {}, "50 m/s in row 2: robot husky drives up to"),
        ("0,0,0,0\n9000,0.5,0,0\n", {}, "at most 3600 s"),
        ("0,0,0,0\n9,0.5,0,0\n", {"duration_s": 4.0}, "leave the duration out"),
    ],
)
def test_commands_that_cannot_be_driven_are_refused(tmp_path, rows, options, says):
    (tmp_path / "turn.csv").write_text(COMMANDS + rows)
    with pytest.raises(ConfigError, match=says):
        simulate_runs("husky", "grass", str(tmp_path / "turn.csv"), tmp_path / "out", **options)


FOUR = """\
name: mine
drive: skid_steer
wheel_radius_m: {value: 0.165, unit: m, source: mine}
track_m: {value: 0.57, unit: m, source: mine}
wheelbase_m: {value: 0.512, unit: m, source: mine}
mass_kg: {value: 50.0, unit: kg, source: mine}
"""


def test_what_runs_cannot_show_is_stated(tmp_path):
    (tmp_path / "mine.yaml").write_text(FOUR)
    mine = str(tmp_path / "mine.yaml")

    def limits(robot, terrain, out, **options):
        return simulate_runs(robot, terrain, "straight", tmp_path / out, duration_s=6.0, **options).limits

    assumed, blind = limits(mine, "grass", "a")
    assert assumed.startswith("Of robot mine body, motors and sensors are assumed from its geometry and mass")
    assert blind.startswith("Nothing on board measures the speed over ground")
    assert limits(mine, "grass", "b", gnss=True) == limits(mine, "grass", "c", pose=True) == (assumed,)
    assert limits("husky", "grass", "d") == ()
    (planar,) = limits("husky", "grass", "e", effect=("payload=0.3",))
    assert planar.startswith("With effects, the planar plant is used")
    little, stuck = limits("robotino", "dry_sand", "f")
    assert little.endswith("carry little of the terrain for a classifier.")
    assert stuck.startswith("On dry_sand it hardly moves")


def test_poses_and_satellites_are_on_board_of_every_drive(tmp_path):
    for robot in ("agrimaro", "husky", "marmotte", "robotino", "omnirobot", "adap2e", "pallet_truck"):
        simulate_runs(robot, "asphalt", "straight", tmp_path / robot, gnss=True, pose=True)
        (read,) = find_runs(tmp_path / robot)
        assert {"gnss", "pose"} <= read().streams.keys()
