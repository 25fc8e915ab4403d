"""From measurements to a state and how well it is known: one Kalman step, and the filters that use it."""
