"""``terrain quickstart``: the whole job in one command, and its report."""
