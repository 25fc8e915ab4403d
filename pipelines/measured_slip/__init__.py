"""``terrain measure-slip``: slip from an outside measurement of motion, and how well it is predicted."""
