"""`terrain drive`: what cannot be driven is refused in one sentence, and nothing is written."""

import numpy as np
import pytest

from pipelines.drive.comparison import DriveInputs, drive_once
from terrain.control.controllers import CONTROLLERS, make_controller
from terrain.control.situations import make_situation
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError
from terrain.robots import load_robot

COMPARISON = [
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
    ("--delay is nan: ", "--delay nan"),
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
]
FAULTS = [
    ("fault 'lost' is unknown: use a kind (loss, freeze, step", "--faults lost"),
    ("clock) or one fault of a kind, as loss_wheels", "--faults lost"),
    ("fault 'x' is unknown", "--faults all --draw x"),
    ("--draw has 'loss_imu', which is not among", "--faults step --draw loss_imu"),
    ("situation 'go' is unknown: use start, stop, steady", "--faults all --situations go"),
    ("soil 'moon' is unknown", "--faults all --terrain moon"),
    ("soil 'moon' is unknown", "--faults all --stop-terrain moon"),
    ("--durations is 0: input should be greater than 0", "--faults all --durations 0"),
    ("--durations is 'long'", "--faults all --durations long"),
    ("--situations is empty; one at least", "--faults all --situations ,"),
    ("only 'swerve' has", "--faults all --robot husky"),
]
PATH = [
    ("only 'bicycle' can", "--path path.csv --robot husky"),
    ("at most 8 m/s", "--path path.csv --robot adap2e --speed 30"),
    ("--speed is 0", "--path path.csv --robot adap2e --speed 0"),
    ("--observer is 'x'", "--path path.csv --robot adap2e --observer x"),
    ("--slope is 60", "--path path.csv --robot adap2e --slope 60"),
    ("--stop is 5.0,3.0; rising", "--path path.csv --robot adap2e --stop 5,3"),
    ("--terrain is accepted without --path", "--path path.csv --robot adap2e --terrain snow"),
]


@pytest.mark.parametrize(("sentence", "words"), [*COMPARISON, *FAULTS, *PATH])
def test_what_cannot_be_driven_is_one_sentence(refused, place, sentence, words):
    np.savetxt(place / "path.csv", [[0, 0], [5, 0], [9, 1]], delimiter=",", header="x_m,y_m", comments="")
    refused(sentence, "drive", *words.split())


def test_a_controller_that_needs_a_classifier_is_not_driven_without():
    robot, table = load_robot("agrimaro"), load_slip_table()
    situation = make_situation("straight", robot, "grass", 0)
    for name in ("classified", "classified+track", "thesis:classified"):
        with pytest.raises(ConfigError, match=f"'{name.replace('+', '.')}' needs a classifier"):
            drive_once(DriveInputs(robot, table), make_controller(name, table, 0.05), situation)
