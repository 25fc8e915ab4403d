"""``terrain reproduce``: one folder a paper."""
