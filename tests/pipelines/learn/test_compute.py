"""Cross-validation on workers gives the bytes of this machine."""

import json
import warnings

import pytest

from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.parallel import computing
from pipelines.report.json_file import as_json


@pytest.mark.slow
def test_a_cluster_gives_the_report_of_this_machine(make_run):
    distributed = pytest.importorskip("distributed")
    runs = [
        make_run(f"{name}_{k}", name, k + 10 * (name == "ICE"), 12.0)
        for name in ("ICE", "SNOW")
        for k in range(4)
    ]
    settings = EvaluationSettings(repeats=1, steady=False, n_jobs=2)
    here = crossval(runs, settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            distributed.LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
            ) as running,
            computing("dask:" + running.scheduler_address),
        ):
            there = crossval(runs, settings)
    assert json.dumps(as_json(there)) == json.dumps(as_json(here))
