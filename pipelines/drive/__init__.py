"""``terrain drive``: closed-loop comparisons."""
