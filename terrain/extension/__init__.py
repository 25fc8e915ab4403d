"""Extended robots: a description with effects, and what filters make of it.

The catalogue (:mod:`terrain.effects`) states of each effect where it goes.  It has a home in the description,
as a wheel's radius has, or an inverse on samples, as a gyro's scale has, or neither, as those of the ground
and of turning, which filters do not model.  :func:`corrected` applies the homes, :class:`Correction` the
inverses; together they give a robot and a log without those effects::

    run, robot = corrected_log(run, robot), corrected(robot)

Where a description lacks the section of a home, samples are corrected instead if the effect has an inverse.
"""

from terrain.extension.description import apply_homes, corrected
from terrain.extension.samples import Correction, corrected_log
from terrain.extension.writing import extended_yaml, write_extended

__all__ = ["Correction", "apply_homes", "corrected", "corrected_log", "extended_yaml", "write_extended"]
