"""Values that no sensor measures end in one sentence that names run, stream, channel and value."""

from dataclasses import replace

import numpy as np
import pytest

from features.windows import WindowRule, cut_at, layout_of
from pipelines.learn.crossval import crossval
from pipelines.learn.model_file import read_model
from pipelines.learn.predict import predict
from terrain.control.slip_table import load_slip_table
from terrain.errors import DataError
from terrain.records import Stream


def spoilt(run, change, stream="imu", channel="accel_z_mps2"):
    old = run.streams[stream]
    values = old.values.copy()
    place = old.channels.index(channel)
    values[:, place] = change(values[:, place])
    return replace(run, streams={**run.streams, stream: Stream(old.time_s, values, old.channels)})


FAULTS = {
    "scaled": (lambda x: x * 1e200, r"9\.\d+e\+200"),
    "scaled beyond its square": (lambda x: x * 1e300, r"\de\+30[01]|\d\.\d+e\+30[01]"),
    "overflown integer": (lambda x: np.full(len(x), -(2.0**63)), r"-9\.22337e\+18"),
    "one damaged value": (lambda x: np.where(np.arange(len(x)) == 400, 1e13, x), r"1e\+13 at 8\.00 s"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_value_beyond_any_quantity_is_named(runs, settings, kind, tracked):
    change, value = FAULTS[kind]
    data = [spoilt(runs[0], change), *runs[1:]]
    sentence = rf"run ASPHALT_1, stream 'imu': channel 'accel_z_mps2' is ({value}).*beyond 1e\+12"
    for work in (
        lambda: crossval(data, settings()),
        lambda: predict(data, read_model(tracked[0] / "model"), load_slip_table()),
    ):
        with pytest.raises(DataError, match=sentence) as refusal:
            work()
        assert "\n" not in str(refusal.value)


def test_what_is_missing_or_never_varies_is_named(runs, settings):
    bare = replace(runs[0], streams={"imu": runs[0].streams["imu"]})
    with pytest.raises(DataError, match="run ASPHALT_1 has no stream 'wheels', which other runs have"):
        crossval([bare, *runs[1:]], settings())
    dead = [spoilt(run, lambda x: x * np.nan) for run in runs]
    with pytest.raises(DataError, match="not one window is left: 144 not finite"):
        crossval(dead, settings())
    flat = [
        replace(
            run,
            streams={
                name: Stream(each.time_s, 0.0 * each.values + 0.5, each.channels)
                for name, each in run.streams.items()
            },
        )
        for run in runs
    ]
    with pytest.raises(DataError, match="no channel of the streams 'imu' and 'wheels' ever varies"):
        crossval(flat, settings())


def test_the_live_chain_drops_such_a_window_and_goes_on(runs):
    rule = WindowRule()
    layout = layout_of(runs)
    run = spoilt(runs[0], lambda x: np.where(np.arange(len(x)) == 400, 1e200, x))
    _, reason = cut_at(run.streams, np.arange(0.0, 20.0, 2.0), rule, layout)
    assert reason.tolist() == ["", "", "", "", "not finite", "", "", "", "", ""]
