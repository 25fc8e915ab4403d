"""A cache of features: one file a run, named by the run's digest and by how its windows are cut.

Two passes, so that memory is bounded by a run and the table: the first finds channels and rates that all runs
have in common, the second cuts, computes and writes what is not there yet; one that was interrupted goes on.  Of
a run folder whose files did not change since, only the cache is read.  Fingerprints of each run show which pairs
of runs may hold the same measurements; these are read again and compared.  Files are Parquet with a checksum of
each page.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from features.answers import answers_of
from features.extractor import FeatureExtractor
from features.motion import window_motion
from features.protocols import Samples
from features.windows import Layout, WindowCut, WindowRule, cut_windows, labelled, layout_of, wheel_stream
from pipelines.data.datasets import RunLoader, run_loaders, some_of, verdict, verdict_together
from pipelines.data.settings import AlignedRunsSettings, chosen_runs
from pipelines.learn.parallel import parallel
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import LearnSettings
from pipelines.learn.training_data import TrainingData, trained_runs
from pipelines.report.results import Progress, as_json, silent
from terrain import __version__
from terrain.classify.answers import Observed
from terrain.classify.limits import Motion
from terrain.errors import ConfigError, DataError, LogError
from terrain.files.atomic import atomic_file, ensure_writable
from terrain.logs.duplicates import RunPrint, possible_pairs, run_print, sentences, shared_stretches
from terrain.logs.motion_checks import is_short
from terrain.logs.plausibility import (
    Check,
    Doubt,
    Level,
    counted,
    doubt_sentences,
    doubts_of,
    refuse_implausible_runs,
)
from terrain.logs.run_folders import data_digest, joint_digest
from terrain.records import WINDOW_COLUMNS, Array, RunLog, Stream, Windows

FORMAT_VERSION = 10


class RunHead(NamedTuple):
    """What is known of a run without its samples."""

    #: run_id, robot, filter, digest, measured_digest: as :class:`~pipelines.learn.training_data.TrainedRun`
    run_id: str
    robot: str = ""
    filter: str = ""
    digest: str = ""
    measured_digest: str = ""
    streams: Sequence[tuple[str, Sequence[str], float]] = ()  #: name, channels and sample period in s of each
    repaired: Mapping[str, int] = {}  #: what a repairing reader dropped, as counts by kind
    fault: str = ""  #: why it was skipped; empty of one that was read
    doubts: Sequence[Sequence[Any]] = ()  #: fields of the checks that are doubtful or implausible
    session: str = ""
    is_short: bool = False  #: too short to be judged by itself in what compares two sensors

    def sketch(self) -> RunLog:
        """Return a run of two samples a stream that has these channels and rates, and nothing else."""
        streams = {
            name: Stream(np.array([0.0, period_s]), np.zeros((2, len(channels))), tuple(channels))
            for name, channels, period_s in self.streams
        }
        return RunLog(self.run_id, self.robot, streams)


def loaders_of(source: AlignedRunsSettings) -> list[RunLoader]:
    """Return what reads each run of a command, also in another process, without reading any."""
    return run_loaders(source.with_(data=source.data.resolve()))


def cached_data(
    loaders: Sequence[RunLoader], settings: LearnSettings, cache_dir: Path, progress: Progress = silent
) -> tuple[TrainingData, list[str], list[str]]:
    """Return the labelled windows of runs by their features, out of a cache as far as they are there.

    Parameters
    ----------
    loaders : one a run, as :func:`loaders_of`
    settings : recipe, how windows are cut, processes at once, and, where they have them, ``--only`` and ``--without``
    cache_dir : folder of the cache, which several data sets and rules may share
    progress : called as runs are done

    Returns
    -------
    data : with windows without their samples; its digest is over those of the runs, as that of the runs read
        whole needs all at once
    skipped : a sentence for each run that could not be read
    doubtful : a sentence for each doubt about the others

    Raises
    ------
    LogError
        if a run cannot be read or is implausible, or two runs have one id.
    DataError
        if the runs have no channels or rates in common, two hold the same measurements, or no window has a
        label.
    """
    if cache_dir.exists() and not cache_dir.is_dir():
        raise ConfigError(f"--cache {cache_dir}: is no folder")
    ensure_writable(cache_dir)
    place, rule, n_jobs = cache_dir.resolve(), settings.rule, settings.jobs
    for folder in ("runs", "features"):
        (place / folder).mkdir(parents=True, exist_ok=True)
    heads, pairs = _heads(loaders, place, n_jobs, progress)
    skipped = [f"run skipped: {head.fault}" for head in heads if head.fault]
    readable = [head for head in heads if not head.fault]
    chosen = chosen_runs(readable, settings) if isinstance(settings, AlignedRunsSettings) else readable
    doubts = [
        Doubt(head.run_id, Check(*check)._replace(level=Level(check[1])))
        for head in sorted(chosen, key=lambda head: head.run_id)
        for check in head.doubts
    ]
    load_of = dict(zip([head.run_id or str(i) for i, head in enumerate(heads)], loaders, strict=True))
    alike: defaultdict[Any, list[RunHead]] = defaultdict(list)
    for head in chosen:
        if head.is_short:
            alike[head.robot, frozenset((name, tuple(names)) for name, names, _ in head.streams)].append(head)
    for group in alike.values():
        short = [load_of[head.run_id] for head in some_of(group)]
        odd = verdict_together([load() for load in short], short[0].robot)
        doubts += [Doubt(head.run_id, check) for head in group for check in odd]
    if not any(load.repair for load in loaders):
        refuse_implausible_runs(doubts, {head.run_id: head.repaired for head in chosen})
    used = {head.run_id for head in chosen}
    each = [(load_of[a], load_of[b]) for a, b in pairs if {a, b} <= used]
    compared = parallel(_compared, (), each, n_jobs, "compare runs", progress)
    if shared := [stretch for found in compared for stretch in found]:
        raise DataError(
            f"{'; '.join(sentences(sorted(shared)))}: held out, they would be recognised and not classified; "
            "leave one of them out by --without, or merge them by --merge-duplicates without --cache"
        )
    chosen = sorted(chosen, key=lambda head: head.run_id)
    unfitted = recipe_of(settings, settings.recipes[0])
    extractor, signal_sets = unfitted[0], unfitted[0].signal_sets
    sketches, rate_hz = [head.sketch() for head in chosen], settings.reading["rate_hz"]
    layout = layout_of(sketches, signal_sets, speeds=rule.steady is not None, rate_hz=rate_hz)
    extractor.fit(cut_windows([], rule, layout=layout).windows)
    names = extractor.get_feature_names_out().tolist()
    made_of = _sha256([FORMAT_VERSION, __version__, as_json([rule, layout, signal_sets, names])])
    files = [place / "features" / f"{_sha256([head.digest, made_of])[:32]}.parquet" for head in chosen]
    found = zip(chosen, files, strict=True)
    todo = [(load_of[head.run_id], file) for head, file in found if _read(file) is None]
    list(parallel(_store_run, (rule, layout, extractor), todo, n_jobs, "features", progress))
    samples, features, moved = _table(chosen, files, rule)
    motion = None if wheel_stream(layout.channels) is None else moved
    runs = trained_runs([head[:5] for head in chosen], samples)
    digest = joint_digest([head.digest for head in chosen])
    data = TrainingData(samples, layout, unfitted, features, motion, runs, digest)
    return data, skipped, [*doubt_sentences(doubts)]


def _heads(
    loaders: Sequence[RunLoader], place: Path, n_jobs: int, progress: Progress
) -> tuple[list[RunHead], list[tuple[str, str]]]:
    """Return the head of each run, and the pairs of ids that may hold the same measurements."""
    heads: list[RunHead] = []
    each = [(load,) for load in loaders]

    def prints() -> Iterator[RunPrint]:
        for head, codes, time_s in parallel(_head, (place,), each, n_jobs, "channels", progress):
            heads.append(head)
            yield RunPrint(codes, time_s, bytes.fromhex(head.measured_digest))

    pairs = [(heads[a].run_id, heads[b].run_id) for a, b in possible_pairs(prints())]
    found = Counter(head.run_id for head in heads if not head.fault)
    if not found:
        raise LogError(f"not one run could be read, the first for this: {heads[0].fault}")
    run_id, n = found.most_common(1)[0]
    if n > 1:
        raise LogError(f"{n} runs have the id {run_id!r}")
    return heads, pairs


def _head(place: Path, load: RunLoader) -> tuple[RunHead, Array, Array]:
    """Return a run's head, and the codes and times of its fingerprints."""
    file = None
    if load.plain_folder is not None:
        parts = sorted(path for path in load.plain_folder.iterdir() if path.is_file())
        states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in parts]
        name = _sha256([str(load.plain_folder), states, repr(load.robot), __version__, FORMAT_VERSION])
        file = place / "runs" / f"{name}.parquet"
        if (found := _read(file)) is not None:
            about, arrays = found
            return RunHead(**about), arrays["code"], arrays["time_s"]
    try:
        run = load()
    except LogError as error:
        if not load.repair:
            raise
        nothing = np.zeros(0)
        return RunHead("", fault=str(error)), nothing.astype(np.int64), nothing
    prints, checks = run_print(run), verdict(run, load.robot)
    if load.repair:
        run = counted(run, checks)
    head = RunHead(
        run.run_id,
        run.robot,
        run.filter,
        data_digest([run]),
        prints.digest.hex(),
        tuple((name, stream.channels, _period_s(stream.time_s)) for name, stream in run.streams.items()),
        dict(run.dropped),
        session=run.session,
        doubts=[tuple(doubt.check) for doubt in doubts_of({run.run_id: checks})],
        is_short=is_short(run),
    )
    if file is not None:
        _write(file, head._asdict(), code=prints.codes, time_s=prints.time_s)
    return head, prints.codes, prints.time_s


def _period_s(time_s: Array) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else float("nan")


def _compared(first: RunLoader, second: RunLoader) -> Any:
    return shared_stretches(sorted((first(), second()), key=lambda run: run.run_id))


def _store_run(
    rule: WindowRule, layout: Layout, extractor: FeatureExtractor, load: RunLoader, file: Path
) -> None:
    """Cut the windows of a run, and write what is kept of them."""
    cut = cut_windows([load()], rule, layout=layout, skip_short=load.repair)
    windows = cut.windows
    moved = window_motion(windows)
    motion = Motion(*np.full((len(Motion._fields), len(windows)), np.nan)) if moved is None else moved
    observed = answers_of(windows) or Observed(
        (), np.zeros((len(windows), 0)), np.zeros((len(windows), 0, 1))
    )
    answers = np.column_stack([observed.response, observed.driving.reshape(len(windows), -1)])
    _write(
        file,
        {"dropped": dict(cut.dropped), "filled": dict(cut.filled), "quantities": observed.quantities},
        start_s=windows.start_s,
        terrain=windows.terrain,
        features=extractor.transform(windows).astype(np.float64),
        **({"answers": answers} if observed.quantities else {}),
        **motion._asdict(),
    )


def _table(
    heads: Sequence[RunHead], files: Sequence[Path], rule: WindowRule
) -> tuple[Samples, Array, Motion]:
    """Return the labelled windows of all runs, run by run and in order of time, their features and motion."""
    parts, dropped, quantities = [], Counter[str](), ()
    repaired = sum((Counter(head.repaired) for head in heads), Counter[str]())
    for head, file in zip(heads, files, strict=True):
        if (found := _read(file)) is None:
            raise LogError(f"{file}: was changed while it was used")
        about, columns = found
        dropped.update(about["dropped"])
        repaired.update(about["filled"])
        quantities = tuple(about["quantities"])
        names = {"run_id": head.run_id, "session": head.session}
        n = len(columns["terrain"])
        parts.append({**columns, **{key: np.full(n, text, dtype=object) for key, text in names.items()}})
    table = {name: np.concatenate([part.pop(name) for part in parts]) for name in list(parts[0])}
    of_windows = (table[name] for name in WINDOW_COLUMNS)
    windows = Windows({}, {}, {}, rule.length_s, *of_windows)
    cut, known = labelled(WindowCut(windows, dropped)), table["terrain"] != ""
    features = table["features"][known]
    if np.array_equal(features, np.broadcast_to(features[:1], features.shape), equal_nan=True):
        raise DataError("no feature ever varies: nothing can be learned from them")
    observed = None
    if quantities:
        answers, q = table["answers"][known], len(quantities)
        observed = Observed(quantities, answers[:, :q], answers[:, q:].reshape(len(answers), q, -1))
    parts_of = cut.windows, dict(cut.dropped), cut.windows.groups, rule.overlap
    samples = Samples(*parts_of, repaired=dict(repaired), cached=observed)
    return samples, features, Motion(*(table[name][known] for name in Motion._fields))


def _sha256(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _write(file: Path, about: Mapping[str, Any], **arrays: Array) -> None:
    """Write a file of the cache, whole or not at all; the same content gives the same bytes."""
    import pyarrow
    from pyarrow import parquet

    columns: dict[str, Any] = {name: pyarrow.array(each.ravel()) for name, each in arrays.items()}
    for name, each in arrays.items():
        if each.ndim > 1:
            row = pyarrow.list_(pyarrow.field("element", columns[name].type), each.shape[1])  # as it is read
            columns[name] = pyarrow.FixedSizeListArray.from_arrays(columns[name], type=row)
    text = json.dumps(about, sort_keys=True)
    table = pyarrow.table(columns)
    metadata = {
        "about": text,
        "sha256": _sha256([text, str(table.schema)]),
    }  # pages have checksums of their own
    with atomic_file(file) as stream:
        table = table.replace_schema_metadata(metadata)
        parquet.write_table(table, stream, compression="zstd", write_page_checksum=True)


def _read(file: Path) -> tuple[dict[str, Any], dict[str, Array]] | None:
    """Return what a file says of its arrays, and these; None where it is missing or damaged."""
    from pyarrow import parquet, types

    try:
        with file.open("rb") as stream:
            table = parquet.read_table(stream, use_threads=False, page_checksum_verification=True)
        schema, arrays = table.schema, {}
        text = schema.metadata[b"about"].decode()
        if schema.metadata[b"sha256"].decode() != _sha256([text, str(schema.remove_metadata())]):
            return None
        for name in table.column_names:
            column, shape = table[name].combine_chunks(), [table.num_rows]
            if types.is_fixed_size_list(column.type):
                column, shape = column.flatten(), [*shape, column.type.list_size]
            arrays[name] = column.to_numpy(zero_copy_only=False).reshape(shape)
        return json.loads(text), arrays
    except Exception:  # pyarrow raises whatever a damaged file leads it to
        return None
