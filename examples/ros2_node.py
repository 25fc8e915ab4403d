"""ROS 2 node of the live observer: ``python examples/ros2_node.py MODEL_FOLDER`` where ROS 2 is installed."""

import math
import sys
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64, String

from pipelines.learn.model_file import read_model
from pipelines.live.observer import Observer
from terrain.records import Reading

IMU = (*(f"gyro_{axis}_radps" for axis in "xyz"), *(f"accel_{axis}_mps2" for axis in "xyz"))
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
JOINTS, WHEEL_RADIUS_M = ("left_wheel", "right_wheel"), 0.1651  # of the robot at hand


def terrain_node(model: Path) -> Node:
    """Return a node that publishes ``terrain`` (empty where unknown) and ``target_slip`` in traction."""
    observer = Observer(read_model(model), channels={"imu": IMU, "wheels": WHEELS})
    node = Node("terrain")
    terrain = node.create_publisher(String, "terrain", 1)
    target = node.create_publisher(Float64, "target_slip", 1)

    def take(stream: str, stamp: object, values: list[float]) -> None:
        reading = Reading(np.array([stamp.sec + stamp.nanosec * 1e-9]), np.array([values]))
        if observer.update({stream: reading}):
            believed = observer.belief.terrain
            terrain.publish(String(data=believed))
            target.publish(Float64(data=observer.table.lookup(believed)["traction"].slip_ratio))

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
        speeds_mps = [rates[i] * WHEEL_RADIUS_M for i in at]
        take("wheels", message.header.stamp, [*speeds_mps, *(efforts[i] for i in at)])

    node.create_subscription(Imu, "imu/data", on_imu, 50)
    node.create_subscription(JointState, "joint_states", on_joints, 50)
    return node


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(terrain_node(Path(sys.argv[1])))
