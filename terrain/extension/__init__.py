"""Extended robots: a description with effects, and what filters make of it.

The catalogue (:mod:`terrain.effects`) states of each effect where it goes.  It has a home in the description,
as a wheel's radius has, or an inverse on samples, as a gyro's scale has, or neither, as those of the ground
and of turning, which filters do not model.  Whoever reads a run and its robot corrects both, once::

    run, robot = correct(run, robot)

and filters take what is corrected.  A live chain gives its estimator the robot and the
:class:`Correction` of :func:`correct_live`.  Where a description lacks the section of a home, samples are
corrected instead if the effect has an inverse.
"""

from terrain.extension.basis import Basis, Origin, basis_of
from terrain.extension.description import apply_homes, check_corrected, corrected
from terrain.extension.region import RegionMonitor, region_of, warn_outside
from terrain.extension.samples import Correction, correct, correct_live, corrected_log
from terrain.extension.writing import extended_yaml, write_extended

__all__ = [
    "Basis",
    "Correction",
    "Origin",
    "RegionMonitor",
    "apply_homes",
    "basis_of",
    "check_corrected",
    "correct",
    "correct_live",
    "corrected",
    "corrected_log",
    "extended_yaml",
    "region_of",
    "warn_outside",
    "write_extended",
]
