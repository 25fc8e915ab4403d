import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from terrain.angles import wrapped
from terrain.kernels import njit


@njit
def compiled(angle_rad):
    return wrapped(angle_rad)


def test_the_end_of_the_circle_is_plus_pi_and_angles_on_it_stay_as_they_are():
    for angle, same in ((math.pi, math.pi), (-math.pi, math.pi), (0.0, 0.0), (1e-300, 1e-300)):
        assert wrapped(angle) == same
    assert math.isnan(wrapped(math.nan))


@given(st.floats(-1e3, 1e3), st.integers(-100, 100))
def test_whole_turns_do_not_matter(angle, turns):
    once, again = wrapped(angle), wrapped(angle + 2 * math.pi * turns)
    assert -math.pi < once <= math.pi + 1e-12
    assert math.isclose(math.cos(once), math.cos(again), abs_tol=1e-9)
    assert math.isclose(math.sin(once), math.sin(again), abs_tol=1e-9)
    assert compiled(angle) == once
    assert wrapped(np.array([angle]))[0] == once
