"""ROS 2 node of the live chain, where ROS 2 is installed: ``python examples/ros2_node.py MODEL_FOLDER [ROBOT]``.

It publishes the terrain and its target slip.  With a robot, by name or its YAML file, it drives: for each desired twist
on ``cmd_vel_desired`` it publishes the twist to drive on ``cmd_vel``, and the rates of the driven wheels on
``wheel_commands``: of motor controllers that take a twist the first is used, of those that take rates the second.
"""

import math
import sys
from pathlib import Path

import numpy as np

try:
    import rclpy
    from geometry_msgs.msg import Twist, TwistStamped
    from rclpy.node import Node
    from sensor_msgs.msg import Imu, JointState
    from std_msgs.msg import Float64, String
except ImportError as error:
    sys.exit(f"error: {error}: source the setup file of a ROS 2 installation first")

from pipelines.learn.model_file import read_model
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot, pilot_classifier
from terrain.records import Reading, Sample
from terrain.robots import load_robot

IMU = (*(f"gyro_{axis}_radps" for axis in "xyz"), *(f"accel_{axis}_mps2" for axis in "xyz"))
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
FIX = ("velocity_x_mps", "velocity_y_mps")  # east and north, of a receiver
CHANNELS = {"imu": IMU, "wheels": WHEELS}
JOINTS, WHEEL_RADIUS_M = ("left_wheel", "right_wheel"), 0.1651  # of the robot at hand, where none is named


def terrain_node(model: Path, robot_name: str = "") -> Node:
    """Return a node that publishes ``terrain`` (empty where unknown), ``target_slip`` in traction, and commands."""
    if robot_name:
        robot, channels = load_robot(robot_name), {**CHANNELS, "gnss": FIX}
        chain = LivePilot(
            robot, source=pilot_classifier(read_model(model), robot, None, channels), channels=channels
        )
    else:
        robot, chain = None, Observer(read_model(model), channels=CHANNELS)
    node, waiting = Node("terrain"), {}
    terrain = node.create_publisher(String, "terrain", 1)
    target = node.create_publisher(Float64, "target_slip", 1)
    twist = node.create_publisher(Twist, "cmd_vel", 1)
    wheels = node.create_publisher(JointState, "wheel_commands", 1)

    def publish_belief() -> None:
        terrain.publish(String(data=chain.belief.terrain))
        target.publish(Float64(data=chain.table.lookup(chain.belief.terrain)["traction"].slip_ratio))

    def take(stream: str, stamp: object, values: list[float]) -> None:
        time_s = stamp.sec + stamp.nanosec * 1e-9
        reading = Reading(np.array([time_s]), np.array([values]))
        if robot is None:
            if chain.update({stream: reading}):
                publish_belief()
            return
        earlier = waiting.get(stream)
        waiting[stream] = (
            reading if earlier is None else Reading(*map(np.concatenate, zip(earlier, reading, strict=True)))
        )

    def on_twist(message: Twist) -> None:  # fifty times a second; the newest sample tells the time
        stamps = [reading.time_s[-1] for reading in waiting.values()]
        desired = np.array([message.linear.x, message.linear.y, message.angular.z])
        done = chain.take(Sample(max(stamps, default=math.nan), desired, dict(waiting)))
        waiting.clear()
        out = Twist()
        out.linear.x, out.linear.y, out.angular.z = done.command.twist.tolist()
        twist.publish(out)
        wheels.publish(JointState(name=list(robot.wheels), velocity=done.command.wheel_radps.tolist()))
        if done.windows:
            publish_belief()

    def on_imu(message: Imu) -> None:  # axes of REP 103, as in the run logs
        turn, accel = message.angular_velocity, message.linear_acceleration
        take("imu", message.header.stamp, [turn.x, turn.y, turn.z, accel.x, accel.y, accel.z])

    def on_joints(message: JointState) -> None:  # by name; efforts are currents here
        if not set(JOINTS) <= set(message.name):  # of an arm
            return
        at = [message.name.index(joint) for joint in JOINTS]
        rates, efforts = (
            part or [math.nan] * len(message.name) for part in (message.velocity, message.effort)
        )
        speeds_mps = [rates[i] * (WHEEL_RADIUS_M if robot is None else robot.wheel_radius_m) for i in at]
        take("wheels", message.header.stamp, [*speeds_mps, *(efforts[i] for i in at)])

    def on_fix(message: TwistStamped) -> None:
        take("gnss", message.header.stamp, [message.twist.linear.x, message.twist.linear.y])

    node.create_subscription(Imu, "imu/data", on_imu, 50)
    node.create_subscription(JointState, "joint_states", on_joints, 50)
    if robot is not None:
        node.create_subscription(TwistStamped, "fix_velocity", on_fix, 10)
        node.create_subscription(Twist, "cmd_vel_desired", on_twist, 1)
    return node


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(terrain_node(Path(sys.argv[1]), *sys.argv[2:3]))
