"""``terrain track``: a car-like robot follows a path of the user in simulation."""
