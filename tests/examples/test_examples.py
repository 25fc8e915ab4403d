"""The examples run: a robot's program against a service, the ROS 2 node on what it uses of ROS."""

import importlib.util
import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from pipelines.learn.model_file import write_model
from pipelines.learn.training_data import fitted_model
from pipelines.live.pilot import LivePilot
from pipelines.live.session import NO_WHEELS
from pipelines.serve.serve import Settings
from pipelines.serve.service import Service
from terrain.control.robot_control import PilotSettings
from terrain.control.situations import make_situation, simulate_situation
from terrain.logs.run_folders import write_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.assumed import with_assumed
from terrain.simulation.faults import FaultyBus, fault_catalogue

IMU = tuple(
    f"{quantity}_{axis}_{unit}" for quantity, unit in (("gyro", "radps"), ("accel", "mps2")) for axis in "xyz"
)
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")


def run_on(terrain, shaking, number):
    rng = np.random.default_rng([number, int(100 * shaking)])
    time_s, wheels_s = np.arange(0, 12, 0.02), np.arange(0, 12, 0.1)
    wheels = np.column_stack([np.full((120, 2), 0.5), 2.0 + rng.normal(0, 0.1, (120, 2))])
    streams = {
        "imu": Stream(time_s, rng.normal(0, shaking, (600, 6)), IMU),
        "wheels": Stream(wheels_s, wheels, WHEELS),
    }
    return RunLog(f"{terrain}{number}", "husky", streams, ((0.0, 12.0, terrain),))


@pytest.fixture(scope="module")
def runs():
    return [run_on(terrain, shaking, n) for terrain, shaking in (("a", 0.1), ("b", 2.0)) for n in range(3)]


@pytest.fixture(scope="module")
def model_folder(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    write_model(folder, fitted_model(runs))
    return folder


def example(name):
    """The module of an example."""
    path = Path(__file__).parents[2] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def url(model_folder):
    """The address of a service."""
    service, ready = Service(Settings(model=str(model_folder), port=0)), threading.Event()
    thread = threading.Thread(target=service.run, args=(lambda url: ready.set(),))
    thread.start()
    try:
        assert ready.wait(30.0)
        yield service.url.replace("http", "ws")
    finally:
        service.stop()
        thread.join(30.0)


def test_a_robots_program_gets_its_terrain(runs, url, tmp_path, capsys):
    folder = write_run(runs[4], tmp_path)
    assert example("live_robot").drive(str(folder), url, speed=6.0) == "b"
    assert "b" in capsys.readouterr().out


@pytest.mark.parametrize("by_twist", [False, True])
def test_a_robot_drives_by_the_served_commands_and_slips_less_than_by_plain_ones(url, by_twist):
    moving, robot = example("moving_robot"), with_assumed(load_robot("husky"))
    log, answers = moving.drive("husky", "grass", url, by_twist=by_twist, real_time=False, seed=80000)
    made = make_situation("starts", robot, "grass", 80000)
    pilot = LivePilot(robot, settings=PilotSettings("plain"))
    plain = simulate_situation(robot, made, pilot.step, moving.DELAY_S)
    assert {answer["command"]["status"] for answer in answers} == {"ok"}
    assert answers[-1]["observation"]["slip_unknown"] == "the wheels stand"
    assert moving.largest_slip(log) < 0.9 * moving.largest_slip(plain)
    reached_m, plain_m = (run.streams["truth"].channel("position_x_m")[-1] for run in (log, plain))
    assert reached_m > 0.9 * plain_m


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("loss_gnss", {"gnss_position": "lost", "gnss_speed": "lost"}),
        ("loss_imu", {"gyro": "lost", "accel": "lost", "tilt": "lost"}),
        ("loss_wheels", {"wheel_left": "lost", "wheel_right": "lost"}),
        ("freeze_speed_left", {"wheel_left": "frozen"}),
    ],
)
@pytest.mark.parametrize("start_s", [10.0, 13.0])  # before a start, and in motion
def test_a_sensor_that_is_lost_on_a_driven_robot_is_named_it_alone_and_the_robot_drives_on(
    url, fault, named, start_s
):
    lost = fault_catalogue(with_assumed(load_robot("husky")))[fault]
    log, answers = example("moving_robot").drive(
        "husky",
        "grass",
        url,
        real_time=False,
        seed=80000,
        bus=lambda controller: FaultyBus(controller, lost, start_s, start_s + 3.5, 0),
    )
    seen = {round(answer["time_s"], 2): answer["observation"] for answer in answers if answer["time_s"]}
    for time_s in (start_s + 2.0, start_s + 3.0):
        given = seen[time_s]
        assert {name: health for name, health in given["sensors"].items() if health != "fresh"} == named
        if fault == "loss_wheels":
            assert (given["slip_unknown"], given["slip_ratio"]) == (NO_WHEELS, [None, None])
    truth = log.streams["truth"]
    drives = (truth.time_s > 14.0) & (truth.time_s < 16.0)
    assert truth.channel("speed_x_mps")[drives].min() > 0.5
    assert answers[-1]["command"]["traction"] == "ok"
    assert set(seen[24.0]["sensors"].values()) == {"fresh"}
    assert None not in seen[24.0]["slip_ratio"]


class Publisher:
    def __init__(self):
        self.messages = []

    def publish(self, message):
        self.messages.append(getattr(message, "data", message))


class Node:
    """What the example uses of a ROS 2 node."""

    def __init__(self, name):
        self.publishers, self.callbacks = {}, {}

    def create_publisher(self, kind, topic, depth):
        return self.publishers.setdefault(topic, Publisher())

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = callback


@pytest.fixture
def ros(monkeypatch):
    def module(name, **content):
        found = ModuleType(name)
        vars(found).update(content)
        monkeypatch.setitem(sys.modules, name, found)
        return found

    module("rclpy", node=module("rclpy.node", Node=Node))
    for package, kinds in (("sensor_msgs", ("Imu", "JointState")), ("std_msgs", ("Float64", "String"))):
        module(package, msg=module(f"{package}.msg", **dict.fromkeys(kinds, SimpleNamespace)))
    module(
        "geometry_msgs", msg=module("geometry_msgs.msg", Twist=twist_message, TwistStamped=SimpleNamespace)
    )


def twist_message():
    return SimpleNamespace(linear=vector([0.0] * 3), angular=vector([0.0] * 3))


def stamp(time_s):
    return SimpleNamespace(stamp=SimpleNamespace(sec=int(time_s), nanosec=round((time_s % 1.0) * 1e9)))


def vector(values):
    return SimpleNamespace(**dict(zip("xyz", values, strict=True)))


def test_the_ros_node_publishes_terrain_and_target_slip(ros, runs, model_folder):
    node = example("ros2_node").terrain_node(model_folder)
    imu, wheels = runs[4].streams["imu"], runs[4].streams["wheels"]
    samples = [("imu/data", t, row) for t, row in zip(imu.time_s, imu.values, strict=True)]
    samples += [("joint_states", t, row) for t, row in zip(wheels.time_s, wheels.values, strict=True)]
    for topic, time_s, row in sorted(samples, key=lambda one: one[1]):
        if topic == "imu/data":
            message = SimpleNamespace(
                header=stamp(time_s), angular_velocity=vector(row[:3]), linear_acceleration=vector(row[3:])
            )
        else:
            radius_m = 0.1651
            message = SimpleNamespace(
                header=stamp(time_s),
                name=["arm", "right_wheel", "left_wheel"],
                velocity=[9.0, row[1] / radius_m, row[0] / radius_m],
                effort=[0.0, row[3], row[2]],
            )
            other = SimpleNamespace(header=stamp(time_s), name=["arm"], velocity=[], effort=[])
            node.callbacks[topic](other)
        node.callbacks[topic](message)
    terrain, target = node.publishers["terrain"].messages, node.publishers["target_slip"].messages
    assert len(terrain) == len(target) >= 5
    assert terrain[-1] == "b"
    assert all(0.0 < slip < 1.0 for slip in target)


def test_the_ros_node_of_a_robot_publishes_the_twist_to_drive_and_its_wheels(ros, model_folder):
    node = example("ros2_node").terrain_node(model_folder, "husky")
    desired = SimpleNamespace(linear=vector([0.5, 0.0, 0.0]), angular=vector([0.0, 0.0, 0.3]))
    for k in range(200):
        time_s, turn = 0.02 * k, vector([0.0, 0.0, 0.1])  # it turns by a third of what is desired
        imu = SimpleNamespace(
            header=stamp(time_s), angular_velocity=turn, linear_acceleration=vector([0.0, 0.0, 9.8])
        )
        rates = [0.4 / 0.165, 0.6 / 0.165]
        joints = SimpleNamespace(
            header=stamp(time_s), name=["left_wheel", "right_wheel"], velocity=rates, effort=[]
        )
        moves = SimpleNamespace(header=stamp(time_s), twist=SimpleNamespace(linear=vector([0.49, 0.0, 0.0])))
        for topic, message in (("imu/data", imu), ("joint_states", joints), ("fix_velocity", moves)):
            node.callbacks[topic](message)
        node.callbacks["cmd_vel_desired"](desired)
    driven, wheels = node.publishers["cmd_vel"].messages[-1], node.publishers["wheel_commands"].messages[-1]
    assert driven.linear.x == pytest.approx(0.5)
    assert driven.angular.z > 0.31  # more than desired
    assert wheels.name == ["left", "right"]
    assert wheels.velocity[0] < wheels.velocity[1]


def test_slip_changes_with_the_ground_sample_by_sample():
    found = example("observe_slip").observe()
    assert [terrain for terrain, _, _ in found] == ["grass"] * 3 + ["dry_sand"] * 3
    assert found[2][1] == pytest.approx(0.033, abs=0.01)
    assert found[5][1] == pytest.approx(0.014, abs=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::terrain.errors.OutsideRegionWarning")  # of these few runs
def test_the_tour_goes_through_the_whole_chain(tmp_path, monkeypatch, capsys):
    import terrain

    husky = terrain.load_robot("husky")
    for name in ("grass", "tiles"):
        for number in range(1, 7):
            run = terrain.simulate(husky, name, "survey", seed=7, number=number, duration_s=16.0, vary=True)
            write_run(run, tmp_path / "logs")
    monkeypatch.chdir(tmp_path)
    found = example("tour")
    assert "whole runs held out, within runs without a session" in capsys.readouterr().out
    assert (tmp_path / "explained.html").read_text().count("<details>") >= 3
    assert (tmp_path / "field" / "terrain_model.json").is_file()
    assert found.live.belief is not None
    assert set(found.table.targets) >= {"grass", "tiles"}
    source = Path(found.__file__).read_text().splitlines()
    code = [line for line in source if line and not line.startswith(('"""', "import"))]
    assert len(code) <= 15
    assert [line for line in source if line.startswith(("import", "from"))] == ["import terrain"]


def test_readme_has_the_tour():
    root = Path(__file__).parents[2]
    code = (root / "examples" / "tour.py").read_text().partition("import terrain")[2].split()
    assert " ".join(code) in " ".join((root / "README.md").read_text().split())
