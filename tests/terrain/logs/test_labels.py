"""Labels that are set one after another."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.logs.run_folders import relabelled

times = st.integers(0, 20).map(float)
intervals = st.tuples(times, times).filter(lambda each: each[0] < each[1])


@settings(max_examples=50)
@given(st.lists(st.tuples(intervals, st.sampled_from(["a", "b", ""])), max_size=6))
def test_the_last_label_of_an_instant_holds(changes):
    """Two routes to the label of an instant: the labels after all changes, and the last change over it."""
    labels = ()
    for (start_s, end_s), terrain in changes:
        labels = relabelled(labels, start_s, end_s, terrain)
    assert all(one.end_s <= other.start_s for one, other in pairwise(labels))
    for instant in np.arange(0.5, 20.0):
        last = [t for (start_s, end_s), t in changes if start_s <= instant < end_s]
        holds = [label.terrain for label in labels if label.start_s <= instant < label.end_s]
        assert holds == [t for t in last[-1:] if t]
    joined = [one for one, other in pairwise(labels) if one[1:] == (other[0], other[2])]
    assert joined == []
