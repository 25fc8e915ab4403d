"""Layouts of logs: what a folder of them may be, and what is written."""

from typing import Literal, get_args

Layout = Literal[
    "auto", "runs", "borealtc", "csv", "drive", "drive-recording", "robotino", "testbed", "can", "bag"
]
"""``auto``: found out; ``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping
file; ``drive``: the files ``samples.csv.gz`` of DRIVE, one a session; ``drive-recording``: its whole
recordings; ``robotino``: files of three motors and a camera above; ``testbed``: ``smooth.csv`` and
``grouser.csv`` of a wheel in a box of sand, a trial a row; ``can``: logs of a CAN bus, by a DBC; ``bag``: MCAP
files and bags of ROS, by a mapping or by the types of their topics."""

LAYOUTS: tuple[str, ...] = get_args(Layout)

ACCEPTED = (
    "accepted are run folders (run.json), the BorealTC layout (<CLASS>/imu_N.csv and pro_N.csv), "
    "the DRIVE layout (samples.csv.gz, or folders of sessions with one each), its whole recordings "
    "(<robot>_<terrain>/*.csv.gz), the Robotino layout (camera_params.json over folders of .csv.gz), "
    "the wheel testbed's (smooth.csv, grouser.csv), MCAP files and ROS 2 bags, and "
    "any CSV with a mapping file"
)
"""What a refusal lists."""

Target = Literal["runs", "mcap", "ros2", "ros2-mcap", "csv"]
"""``runs``: run folders; ``mcap``: a file a run; ``ros2``, ``ros2-mcap``: a bag a run; ``csv``: tables a run."""
