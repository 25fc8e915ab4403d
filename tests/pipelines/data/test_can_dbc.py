"""Any DBC with the signals that are used is read, whatever its frames; else there is one sentence."""

import math
import re
import sys

import can
import cantools
import numpy as np
import pytest

from pipelines.data.can_codec import Frame, decode, encode, load_layout
from pipelines.data.can_logs import Receiver
from terrain.errors import ConfigError
from terrain.files.resources import data_folder

TEXT = (data_folder("can") / "agrimaro.dbc").read_text()


@pytest.fixture
def changed(tmp_path):
    """Return a function that writes the packaged DBC with texts replaced."""

    def write(*pairs):
        text = TEXT
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "robot.dbc"
        path.write_text(text)
        return path

    return write


MOTORS = 'SG_ MotorRate1 : 0|18@1- (0.002,0) [-262.142|262.142] "rad/s"'


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (" SG_ MotorRate1 ", " SG_ Speed1 ", "lacks the signal 'MotorRate1'"),
        (MOTORS, MOTORS.replace('"rad/s"', '"m/s"'), "unit 'm/s', which does not fit motor_1_radps"),
        (MOTORS, MOTORS.replace('"rad/s"', '""'), "unit '', which does not fit motor_1_radps"),
        (MOTORS, MOTORS.replace("(0.002,0)", "(0,0)"), "scale"),
        (" SG_ CameraConfidence ", " SG_ MotorRate1 ", "'MotorRate1' is in the messages"),
        ("BO_ 288 MotorRates: 8", "BO_ 288 MotorRates: 4", "is no DBC"),
        ("BO_ 288 MotorRates: 8", "BO_ 288 MotorRates: 64", "64 bytes"),
        ("BO_ 288", "BO_ two", "is no DBC"),
        (' SG_ DesiredSpeedX : 0|16@1- (0.0001,0) [-3.2767|3.2767] "m/s" OnboardPC\n', "", "DesiredSpeedX"),
        (" SG_ Gyro", " SG_ Rate", "lacks the signal 'GyroX' and 2 more"),
    ],
)
def test_a_dbc_that_does_not_fit_is_one_sentence(changed, old, new, sentence):
    with pytest.raises(ConfigError, match=re.escape(sentence)) as raised:
        load_layout(changed((old, new)))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe" * 99, b"VERSION", TEXT[: len(TEXT) // 3].encode()])
def test_a_damaged_dbc_is_one_sentence(tmp_path, content):
    (tmp_path / "damaged.dbc").write_bytes(content)
    with pytest.raises(ConfigError) as raised:
        load_layout(tmp_path / "damaged.dbc")
    assert "\n" not in str(raised.value)


def test_no_dbc_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="cannot be opened"):
        load_layout(tmp_path / "none.dbc")


def test_what_no_controller_needs_may_lack(changed):
    layout = load_layout(changed((" SG_ CameraPosition", " SG_ Place"), (" SG_ TargetSlip", " SG_ Slip")))
    assert layout.lacking("odometry") == [*(f"position_{axis}_m" for axis in "xyz"), "quaternion_w_ratio"]
    assert "CameraPosition" not in {plan.message.name for plan in layout.by_stream["odometry"]}
    assert layout.lacking("status") == ["target_ratio"]


OWN = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 2566844926 Fast: 8 ECU
 SG_ MotorRate1 : 7|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ MotorRate2 : 23|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ MotorRate3 : 39|16@0+ (0.5,-3000) [-3000|3000] "rpm" ECU
 SG_ Alive : 55|4@0+ (1,0) [0|15] "" ECU
BO_ 513 Multiplexed: 8 ECU
 SG_ Which M : 0|8@1+ (1,0) [0|2] "" ECU
 SG_ MotorCurrent1 m0 : 8|16@1- (1,0) [0|0] "mA" ECU
 SG_ MotorCurrent2 m1 : 8|16@1- (1,0) [0|0] "mA" ECU
 SG_ MotorCurrent3 m2 : 8|16@1- (1,0) [0|0] "mA" ECU
BO_ 514 Angles: 8 ECU
 SG_ SteeringAngle1 : 0|32@1- (1,0) [-180|180] "deg" ECU
 SG_ SteeringAngle2 : 32|16@1- (0.01,0) [-180|180] "deg" ECU
 SG_ SteeringAngle3 : 48|16@1- (0.01,0) [-180|180] "deg" ECU
SIG_VALTYPE_ 514 SteeringAngle1 : 1;
"""


def test_another_dbc_with_units_and_layouts_of_its_own_is_read(tmp_path):
    """Big-endian, an offset, rpm, an extended identifier, multiplexed currents in mA, a float in degrees."""
    (tmp_path / "own.dbc").write_text(OWN)
    layout = load_layout(tmp_path / "own.dbc", ("wheels", "steering"))
    receiver = Receiver(layout, ("wheels", "steering"))
    database = cantools.database.load_file(tmp_path / "own.dbc")
    sent = [("Fast", {"MotorRate1": 600, "MotorRate2": -1200.5, "MotorRate3": 0, "Alive": 0})]
    sent += [("Multiplexed", {"Which": i, f"MotorCurrent{i + 1}": 1000 * (i - 1)}) for i in range(3)]
    sent += [("Angles", {"SteeringAngle1": 90.0, "SteeringAngle2": -45.0, "SteeringAngle3": 200.0})]
    for name, values in sent:
        data = database.encode_message(name, values, strict=False)
        message = can.Message(arbitration_id=database.get_message_by_name(name).frame_id, data=data)
        extended = database.get_message_by_name(name).is_extended_frame
        receiver.take(Frame(2.0, message.arbitration_id, bytes(message.data), extended))
    readings = receiver.readings(3.0)
    rpm = 2 * math.pi / 60
    np.testing.assert_allclose(
        readings["wheels"].values, [[600 * rpm, -1200.5 * rpm, 0.0, -1.0, 0.0, 1.0]], rtol=1e-9
    )
    np.testing.assert_allclose(readings["steering"].values[0, :2], [math.pi / 2, -math.pi / 4], rtol=1e-6)
    assert math.isnan(readings["steering"].values[0, 2]), "200 degrees are beyond the bounds"
    assert receiver.dropped == {"steering: out of range": 1}
    frame, *_ = encode(layout, "steering", [math.nan, 99.0, -99.0], 0)
    part = decode(layout, frame)
    assert math.isnan(part.values[0])
    assert part.values[1:] == pytest.approx([math.pi, -math.pi])


def test_without_the_packages_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cantools", None)
    with pytest.raises(ConfigError, match=r"terrain-slip\[can\]"):
        load_layout()
