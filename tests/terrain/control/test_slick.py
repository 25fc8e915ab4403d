import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.control.aims import DECELERATION_RATIO, LOCKED_RATIO, SLICK_RATIO, braking_by_slip
from terrain.control.slip_table import CurveEntry
from terrain.slip_learning.curve import LAW_PARAMETERS, traction_ratio


def curve(law, *parameters, resistance=0.02):
    named = dict(zip(LAW_PARAMETERS[law], parameters, strict=True))
    numbers = (0.1, (0.05, 0.15), "peak", (0.0, 0.8), resistance, 0.01, 0.01, 0.1, None, 0.9, 1.0, 1.0, 1.0)
    return CurveEntry(law, named, *numbers, 5)


def test_slick_terrain_with_falling_thrust_is_braked_at_its_peak():
    """D sin(C atan(B s)) without curvature has its peak D where C atan(B s) is a right angle."""
    b, c, d = 25.0, 1.5, 0.3
    slip_ratio, mps2 = braking_by_slip(curve("magic", b, c, d, 0.0))
    assert slip_ratio == pytest.approx(np.tan(np.pi / 2 / c) / b, abs=0.002)
    assert mps2 == pytest.approx(DECELERATION_RATIO * (d + 0.02) * GRAVITY_MPS2, rel=1e-3)


@pytest.mark.parametrize(
    ("law", "parameters", "why"),
    [
        ("janosi", (0.3, 0.05), "rises up to the locked wheel"),
        ("magic", (25.0, 1.0, 0.3, 0.0), "rises up to the locked wheel"),
        ("magic", (25.0, 1.5, SLICK_RATIO + 0.01, 0.0), "grips"),
        ("magic", (25.0, 1.2, 0.3, 0.0), "hardly falls"),
    ],
)
def test_where_locked_wheels_stop_as_soon_there_is_no_braking_by_slip(law, parameters, why):
    ends = traction_ratio(law, parameters, np.linspace(0, 1, 501))
    if why == "hardly falls":
        assert LOCKED_RATIO < ends[-1] / ends.max() < 1
    assert braking_by_slip(curve(law, *parameters)) is None
