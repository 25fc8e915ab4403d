"""What is assumed of a robot is what the described ones are about, and is known to be assumed."""

import pytest

from terrain.files.names import packaged
from terrain.robots import KIND_OF_SECTION, load_robot
from terrain.simulation.assumed import SECTIONS, with_assumed
from terrain.simulation.contacts import contacts_of
from terrain.simulation.plants.dynamic import MAX_CONTACTS, MAX_WHEELS, make_plant
from terrain.simulation.scenario import Conditions

ABOUT = {
    "body": (
        *(
            "yaw_inertia_kgm2",
            "wheel_inertia_kgm2",
            "tyre_width_m",
            "contact_length_m",
            "relaxation_length_m",
        ),
        "tyre_stiffness_npm",
    ),
    "motors": ("torque_max_nm", "speed_max_radps", "nm_per_a"),
}
ROUGHLY = {"body": ("tyre_damping_nspm",), "motors": ("friction_nm", "speed_gain_nmspr")}


@pytest.mark.parametrize("name", ["agrimaro", "husky", "robotino"])
def test_described_robots_are_about_what_would_be_assumed_of_them(name):
    robot = load_robot(name)
    assumed = with_assumed(robot.without(*SECTIONS))
    for names, factor in ((ABOUT, 2.05), (ROUGHLY, 3.0)):
        for section, keys in names.items():
            for key in keys:
                ratio = getattr(assumed.parts[section], key) / getattr(robot.parts[section], key)
                assert 1 / factor < ratio < factor, key


@pytest.mark.parametrize("name", packaged("robots"))
def test_every_robot_is_complete_and_what_was_added_is_marked(name):
    robot = load_robot(name)
    whole = with_assumed(robot)
    added = whole.parts.keys() - robot.parts.keys()
    assert whole.describes(*(section for section in SECTIONS if section != "steering" or robot.steered))
    of_added = {
        f"{section}.{key}" for section in added for key in KIND_OF_SECTION[section].__dataclass_fields__
    }
    assert whole.assumed == robot.assumed | of_added
    assert all(whole.parts[section] == part for section, part in robot.parts.items())
    assert with_assumed(whole) is whole


@pytest.mark.parametrize("name", packaged("robots"))
def test_contacts_carry_the_robot_and_fit_the_records(name):
    robot = with_assumed(load_robot(name))
    plant, contacts = make_plant(robot, Conditions())[0], contacts_of(robot)
    assert len(robot.wheels) <= MAX_WHEELS
    assert len(contacts) <= MAX_CONTACTS
    of = plant["contacts"][: len(contacts)]
    assert of["load_fraction"].sum() == pytest.approx(1.0)
    assert (of["load_fraction"] * of["x_m"]).sum() == pytest.approx(robot.body.com_x_m, abs=1e-9)
    assert (of["load_fraction"] * of["y_m"]).sum() == pytest.approx(robot.body.com_y_m, abs=1e-9)
    assert of["ride_ratio"].sum() == pytest.approx(1.0)  # a heave of all corners is one of the body
    assert (of["ride_pitch_1pm"].sum(), of["ride_roll_1pm"].sum()) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("name", packaged("robots"))
def test_speed_loops_damp_the_robot_as_a_maker_would_have_them(name):
    """The damping of ``J w' = K (w* - w) + K_I int (w* - w)``, with each motor's share of the robot's mass in J."""
    robot = with_assumed(load_robot(name))
    inertia_kgm2 = robot.mass_kg * robot.wheel_radius_m**2 / len(robot.logged_wheels)
    gain, integral = robot.motors.speed_gain_nmspr, robot.motors.speed_integral_nmpr
    assert 0.7 < gain / (2.0 * (integral * inertia_kgm2) ** 0.5) < 1.25
