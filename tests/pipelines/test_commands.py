"""Every command: its help, and what it refuses, in one sentence and before anything is written."""

import shlex
from typing import get_args

import pytest

from features import recipes
from features.protocols import PROTOCOLS
from pipelines.cli.table import COMMANDS
from pipelines.learn import settings as learn_settings
from pipelines.learn.settings import ProtocolName
from pipelines.slip.estimate import Filter, Tuning
from terrain.control.controllers import CONTROLLERS
from terrain.estimation.estimate import FILTERS, TUNINGS
from terrain.estimation.models.choice import OBSERVERS
from terrain.logs.run_folders import write_run
from terrain.robots import description_file, load_robot
from terrain.simulation.run import simulate_run

LAUGHS = "0: &a0 [x, x]\n" + "".join(f"{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 9))
MAPPING = """robot: husky
streams:
  imu: {file: "{run}.csv", time: {column: t, unit: s}, channels: {gyro_z_radps: {column: wz, unit: furlong}}}
"""


@pytest.fixture
def files(place, drive):
    """The folder to work in, with a run in ``data`` and files that are none of what commands read."""
    write_run(drive("r", "GRASS", 0, duration_s=4.0), place / "data")
    (place / "empty").mkdir()
    rover = description_file("agrimaro").read_text(encoding="utf-8").replace("name: agrimaro", "name: rover")
    written = {"file": "an obstacle", "laughs.yaml": LAUGHS, "map.yaml": MAPPING, "evil.yaml": "secret: 1\n"}
    written |= {"a.csv": "t,wz\n0,1\n0.1,2\n", "mine.yaml": "name: mine\ndrive: swerve\nwheels: 3\n"}
    written |= {"path.csv": "x_m,y_m\n0,0\n5,0\n9,1\n", "rover.yaml": rover}
    for name, text in written.items():
        (place / name).write_text(text)
    return place


LAUGHED = "those of aliases counted each time"
REFUSED = {
    "inspect": [
        ("furlong", ". --format csv --mapping map.yaml"),
        (LAUGHED, "data --format csv --mapping laughs.yaml"),
    ],
    "convert data": [
        ("cannot be written", "--out file/out"),
        ("--to is 'bag': input should be 'runs', 'mcap'", "--to bag --out other"),
    ],
    "quickstart --data data": [("cannot be written", "--out file/out")],
    "label data --run r": [
        ("there is no run 'SNOW_03'", "--run SNOW_03 --all --terrain ICE"),
        ("is from 0 to 4 s: 3 to 4.5 s is not within", "--from 3 --to 4.5 --terrain ICE"),
        ("is not within", "--from -1 --to 2 --terrain ICE"),
        ("ends before it starts", "--from 2 --to 2 --terrain ICE"),
        ("--to is nan", "--from 2 --to nan --terrain ICE"),
        ("a label needs --from and --to in s, or --all", "--from 2 --terrain ICE"),
        ("leave out --from", "--from 2 --all --terrain ICE"),
        ("a label needs --from and --to in s, or --all", "--from 2 --to 3 --all --terrain ICE"),
        ("a label needs --from and --to in s, or --all", "--terrain ICE"),
        ("needs --terrain NAME, or --remove", "--all"),
        ("use letters", "--all --terrain ../ICE"),
        ("give one of the two", "--all --terrain ICE --remove"),
        ("--model proposes labels", "--model a --answers b --out c"),
        ("--model proposes labels", "--model a --terrain ICE --all"),
        ("sets labels in the new folder --out", "--answers b"),
        ("sets labels in the new folder --out", "--out c"),
    ],
    "label data": [("needs --run", "--all --terrain ICE")],
    "train --data data --name m": [
        *((f"model name '{name}'", f"--name '{name}'") for name in ("", "a/b", "a:b", "a@b", "a b", "a.b")),
        ("empty: holds no run; accepted are", "--data empty"),
        ("--cache is for recipe 'svm'", "--cache c --recipe cnn"),
        ("--search is for recipe 'svm'", "--search 4 --feature a:b"),
        ("--search is for recipe 'svm'", "--search 4 --recipe cnn"),
        ("--search and --params do not go together", "--search 4 --params best.json"),
        ("--params has hyper-parameters of the SVM", "--recipe cnn --params best.json"),
        ("--cache keeps each run by itself", "--cache c --merge-duplicates"),
        ("--register trains nothing", "--register model"),
    ],
    "train --name m": [("--data is missing", "")],
    "crossval --data data": [
        ("all windows are 'GRASS': a classifier needs at least two classes", ""),
        ("run r lasts 4.00 s, shorter than a window of 5 s", "--window 5"),
        ("window length_s is 0.0; it must be positive and finite", "--window 0"),
        ("no signal set is named", "--signals ,"),
        ("unknown signal set 'sonar'; there are imu, wheels", "--signals imu,sonar"),
        ("--protocol is 'lucky': input should be 'grouped', 'grouped-by-run', ", "--protocol lucky"),
        ("--repeats is 0: input should be greater than or equal to 1", "--repeats 0"),
        ("'fast-slow' has a single fold assignment", "--protocol fast-slow --repeats 3"),
        ("--model and --recipe do not go together", "--recipe svm --model models:/field/1"),
        ("there is no recipe 'oracle'; there are svm", "--recipe oracle"),
        ("unknown signal set 'radar'", "--recipe svm@radar,svm"),
        *(("LOW:HIGH", f"--speed {text}") for text in ("fast", "0.3:0.1", "-1:2", "0:inf")),
        ("--cache is for recipe 'svm' on", "--cache c --recipe cnn"),
        ("--cache holds features of windows", "--cache c --protocol published"),
        ("--cache keeps each run by itself", "--cache c --merge-duplicates"),
        ("cannot be written", "--json file/report.json"),
        ("is a folder; --json names a file", "--json data"),
    ],
    "predict --data data": [
        ("neither a folder nor a model URI", "--model nothing"),
        ("cannot be written", "--model m --json file/p.json"),
        ("--model is missing", ""),
        ("--model and --changes do not go together", "--model m --changes x"),
        ("--out is p.xlsx: a name that ends in .parquet or .csv is", "--model m --out p.xlsx"),
    ],
    "estimate --data data --filter": [
        ("filter 'vio15' is not for robot husky, whose drive is skid_steer: use slip", "vio15"),
        ("--tuning is for filters, not for --filter tracked", "tracked --tuning thesis"),
        ("--slip-model is for observers, not for --filter vio15", "vio15 --slip-model m.yaml"),
        ("--window is for --filter pose, not for --filter vio15", "vio15 --window 0.5"),
        ("filter 'tracked' takes no slip model", "tracked --slip-model m.yaml --robot orchard_ugv"),
        ("--delay is 6: input should be less than or equal to 5", "pose --delay 6"),
    ],
    "calibrate --data data --robot agrimaro": [
        ("is one of robot 'husky'", ""),
        ("is there already, and is left as it is", "--out mine.yaml"),
        ("a name that ends in .yaml or .yml is required", "--out robot.json"),
        ("no run has what measures its motion", "--robot husky"),
        ("--laws is for --what soil, not for --what robot", "--laws bekker"),
        ("--figures is for --what soil", "--figures data"),
        ("--robot is not for --what soil", "--what soil"),
    ],
    "calibrate --data data": [
        ("--robot is missing: --what robot starts from one", ""),
        ("--laws is 'mud': input should be 'simulator', 'bekker'", "--what soil --laws mud"),
        ("--laws ends in 'simulator'", "--what soil --laws inflow,simulator"),
        ("--draws is 1: input should be greater than or equal to 2", "--what soil --draws 1"),
        ("none of 1 runs is a trial of a wheel testbed", "--what soil --out new"),
        ("has no tracks; --what odometry is for 'tracked'", "--what odometry --robot husky"),
        ("file: cannot be written", "--what soil --out file"),
    ],
    "simulate --out runs --terrain grass --scenario straight --robot agrimaro": [
        ("driven without eff", "--robot husky --terrain course --scenario course --effect payload=0.1"),
        ("leave duration, gra", "--robot husky --scenario slip --gnss"),
        ("with effects no rec", "--robot husky --gnss --effect payload=0.1"),
        ("does not apply to", "--robot husky --effect steering_backlash=0.1"),
        ("effect 'magic' is unknown", "--robot husky --effect magic=1"),
        ("-0.3 to 0.3 is accepted", "--effect wheel_radius=9"),
        ("effect 'encoder_scale' is given twice", "--effect wheel_radius=0.1 --effect encoder_scale=0.1"),
        ("without effects", "--scenario slip --effect wheel_radius=0.1"),
        ("robot 'ghost' is unknown", "--robot ghost"),
        ("soil 'lava' is unknown", "--terrain lava"),
        (LAUGHED, "--terrain laughs.yaml"),
        ("scenario 'dance' is unknown", "--scenario dance"),
        ("go together", "--terrain course"),
        ("go together", "--terrain all --scenario course"),
        ("duration_s is 0.5, too short for 'straight'", "--duration 0.5"),
        ("duration_s is nan", "--duration nan"),
        ("--grade is 31", "--grade 31"),
        ("--camera-lost is '9:4'; START:END", "--camera-lost 9:4"),
        ("give the terrain 'bench', not 'grass'", "--scenario six_positions"),
    ],
    "drive": [
        ("--controllers is empty; one at least is required", "--controllers ,"),
        ("--controllers is plain,plain; one at least is required, and none twice", "--controllers plain,plain"),
        ("'oracle' is unknown", "--controllers oracle"),
        (f"'best' is unknown: use {', '.join(CONTROLLERS)}", "--controllers best"),
        ("'thesis:fallback' is unknown", "--controllers thesis:fallback"),
        ("no entry 'mars'", "--controllers known:mars"),
        ("0 to below 1", "--controllers target:1.5"),
        ("estimates no pose", "--controllers plain+track"),
        ("above zero", "--controllers ramp --ramp 0"),
        ("--seeds is 0", "--seeds 0"),
        ("--delay is -0.1: ", "--delay -0.1"),
        ("leave the grade out", "--scenario slope --grade 5"),
        ("--grade is 40", "--grade 40"),
        ("--radius is '1,2': value should have at least 3 items", "--radius 1,2"),
        ("--radius is 2.1: input should be less than or equal to 2", "--radius 1,2.1,1"),
        ("not among the controllers", "--controllers plain --model models:/m"),
        ("--observer is accepted with --path FILE", "--observer none"),
        ("--situations is accepted with --faults NAME", "--situations stop"),
        ("--controllers is accepted without --faults", "--faults all --controllers plain"),
        ("give one of them", "--faults all --path path.csv"),
        ("does not go with", "--controllers plain --terrain course"),
        ("speed", "--controllers plain --speed 99"),
    ],
    "drive --faults": [
        ("fault 'lost' is unknown: use a kind (loss, freeze, step", "lost"),
        ("clock) or one fault of a kind, as loss_wheels", "lost"),
        ("fault 'x' is unknown", "all --draw x"),
        ("--draw has 'loss_imu', which is not among", "step --draw loss_imu"),
        ("situation 'go' is unknown: use start, stop, steady", "all --situations go"),
        ("soil 'moon' is unknown", "all --terrain moon"),
        ("soil 'moon' is unknown", "all --stop-terrain moon"),
        ("--durations is 0: input should be greater than 0", "all --durations 0"),
        ("--durations is 'long'", "all --durations long"),
        ("--situations is empty; one at least", "all --situations ,"),
    ],
    "drive --path path.csv --robot adap2e": [
        ("at most 8 m/s", "--speed 30"),
        ("--speed is 0", "--speed 0"),
        ("--observer is 'x'", "--observer x"),
        ("--slope is 60", "--slope 60"),
        ("--stop is 5.0,3.0; rising", "--stop 5,3"),
        ("--terrain is accepted of robots that are not car-like", "--terrain snow"),
    ],
    "serve": [
        ("--can and --replay are two modes: one of them is accepted", "--can can0 --replay runs"),
        ("--port is an option of the WebSocket service, not of --can", "--can can0 --port 1"),
        ("--duration is an option of --can, not of --replay", "--replay runs --duration 1"),
        ("--speed is an option of --replay, not of the WebSocket service", "--speed 4"),
        *(("--speed is", f"--replay runs --speed {text}") for text in ("0", "-1", "inf", "nan", "fast", "''")),
    ],
}  # fmt: skip


@pytest.mark.parametrize("command", REFUSED)
def test_a_mistake_is_one_sentence(refused, files, command):
    for sentence, words in REFUSED[command]:
        refused(sentence, *shlex.split(command), *shlex.split(words))


def test_what_says_nothing_of_a_robot_calibrates_none(refused, files):
    write_run(simulate_run(load_robot("agrimaro"), "grass", "straight", 1, duration_s=4.0), files / "logs")
    for words, sentence in (
        ("--robot agrimaro --out new.yaml", "nothing of robot agrimaro can be calibrated from this: no run"),
        ("--robot rover.yaml", "is one of robot 'agrimaro', and 'rover' is calibrated"),
    ):
        refused(sentence, "calibrate", "--data", "logs", *words.split())


def test_help_has_every_command_on_one_screen_and_an_example_of_each(terrain, refused):
    _, screen, _ = terrain("--help")
    assert len(screen.splitlines()) <= 40
    for name in (command.name for command in COMMANDS):
        assert f"\n  {name} " in screen
        code, out, err = terrain(name, "--help")
        assert (code, err) == (0, "")
        assert out.startswith(f"terrain {name} ")
        assert all(option in out for option in ("--json", "--report", "--details"))
        refused("No such option '--nothing'", name, "--nothing", "1")


def test_the_choices_of_the_command_line_are_those_that_there_are():
    """They are written twice, so that help need not load what offers them."""
    assert get_args(Filter) == (*FILTERS, *OBSERVERS, "pose")
    assert get_args(Tuning) == TUNINGS
    assert get_args(ProtocolName) == tuple(PROTOCOLS)
    assert learn_settings.RECIPES == recipes.RECIPES
