"""From measured slip and force to slip curves and target slips.

``forces`` gives the thrust over load at each slip of a run, its mass and its resistance; ``curve`` the slip curve of a
terrain from its runs, and the target slips from a curve; ``learn`` does both.  ``measured`` is slip by a motion that
was measured from outside, ``rollers``, ``currents`` and ``ground_changes`` what follows from it; ``soil`` is for trials
of a wheel testbed.
"""
