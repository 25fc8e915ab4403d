"""From measured slip and force to slip curves and target slips.

``forces`` and ``samples`` compute the thrust over load at each slip of a run, ``balance`` its mass and its
resistance; ``laws``, ``fit``, ``peak`` and ``curve`` compute the slip curve of a terrain from its runs,
``targets`` the target slips from a curve; ``learn`` does all of it.
"""
