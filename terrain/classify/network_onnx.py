"""A fitted network as an ONNX graph: the one form that it has, here, in a model's folder and in other programs.

The graph has one input a stream, ``(windows, channels, samples)``, missing ones NaN, and two outputs ``(windows,
classes)``: probabilities, and their logarithms.  It computes

- what :mod:`terrain.classify.network_input` describes of each stream;
- two convolutions over time, each with a rectifier; then the mean and the largest value over time; of the
  samples of a slow stream also the mean and standard deviation of each channel;
- one linear layer that joins all branches.  Several members, fitted with other runs held out, share the
  standardisation; the mean of their log probabilities, divided by a temperature, gives the probabilities.

In the file of a model channels lose their mean over the window first, where training windows had lost it, so that
other programs give what was measured.  Channels, rates, length and classes are in its metadata.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from terrain.classify.network_input import (
    CLIP_STD,
    Branch,
    SampleColumns,
    fourier_kernel,
    log_softmax,
    streams_of,
)
from terrain.errors import ConfigError, DataError
from terrain.records import Array, Windows

OPSET = 17
IR_VERSION = 8
OUTPUT, LOG_OUTPUT = "probabilities", "log_probabilities"
ROWS_AT_ONCE = 256

OPERATORS = frozenset(
    (
        *("Add", "Clip", "Concat", "Conv", "Div", "IsNaN", "Log", "LogSoftmax", "MatMul", "Mul", "ReduceMax"),
        *(
            "ReduceMean",
            "Relu",
            "Reshape",
            "Slice",
            "Softmax",
            "Sqrt",
            "Squeeze",
            "Sub",
            "Unsqueeze",
            "Where",
        ),
    )
)
"""Of the graph; none of them repeats or reads anything, so that a stranger's file cannot either."""


class MemberWeights(NamedTuple):
    """Weights of a member, with h hidden channels.

    Parameters
    ----------
    branches : of each stream the weights (h, c f, 3) and (h, h, 3) and biases (h,) of both convolutions, in order
    head_weight, head_bias : (k, p), (k,) of the layer that joins the branches
    """

    branches: Sequence[tuple[Array, Array, Array, Array]]
    head_weight: Array
    head_bias: Array


def require_onnx() -> Any:
    """Return onnx; a :class:`~terrain.errors.ConfigError` where it is not installed."""
    try:
        import onnx
        import onnxruntime  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError("a network is an ONNX graph: pip install 'terrain-slip[cnn]'") from error
    return onnx


class _Graph:
    """Nodes and constants of a graph; each step returns the name of its output."""

    def __init__(self) -> None:
        self.helper = require_onnx().helper
        self.numpy_helper = require_onnx().numpy_helper
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, array: Any, name: str = "") -> str:
        values = np.asarray(array)
        values = values.astype(np.float32) if values.dtype.kind == "f" else values
        name = name or f"c{len(self.constants)}"
        self.constants.append(self.numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def step(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        name = output or f"n{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def mean(self, values: str, axis: int) -> str:
        return self.step("ReduceMean", values, axes=[axis], keepdims=1)

    def shaped(self, values: str, shape: Sequence[int]) -> str:
        return self.step("Reshape", values, self.constant(np.array(shape, dtype=np.int64)))


def network_onnx(
    columns: Sequence[SampleColumns],
    branches: Sequence[Branch],
    members: Sequence[MemberWeights],
    fill: Array,
    temperature: float,
    classes: Sequence[str],
) -> bytes:
    """Return the graph of a fitted network.

    Parameters
    ----------
    columns, branches : of each stream
    members : with equal shapes
    fill : (n_columns,) what a missing sample is taken for
    temperature : that log probabilities are divided by
    classes : (k,) names in the order of the output
    """
    onnx, graph = require_onnx(), _Graph()
    helper = onnx.helper
    inputs, pooled, place = [], [], 0
    for number, (each, branch) in enumerate(zip(columns, branches, strict=True)):
        shape = ["windows", len(each.channels), each.n_samples]
        inputs.append(helper.make_tensor_value_info(each.stream, onnx.TensorProto.FLOAT, shape))
        missing = fill[place : place + each.width].reshape(len(each.channels), -1)
        place += each.width
        weights = [
            np.stack(part) for part in zip(*(member.branches[number] for member in members), strict=True)
        ]
        pooled += _branch(graph, each, branch, weights, _filled(graph, each, missing))
    joined = graph.step("Concat", *pooled, axis=2)
    column = graph.step("Unsqueeze", joined, graph.constant(np.array([3])))
    head = graph.constant(np.stack([member.head_weight for member in members]), "head_weight")
    flat = graph.step("Squeeze", graph.step("MatMul", head, column), graph.constant(np.array([3])))
    bias = graph.constant(np.stack([member.head_bias for member in members]), "head_bias")
    each_log = graph.step("LogSoftmax", graph.step("Add", flat, bias), axis=2)
    mean = graph.step("ReduceMean", each_log, axes=[1], keepdims=0)
    tempered = graph.step("Div", mean, graph.constant(np.array(temperature), "temperature"))
    graph.step("Softmax", tempered, output=OUTPUT, axis=1)
    graph.step("LogSoftmax", tempered, output=LOG_OUTPUT, axis=1)
    outputs = [
        helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["windows", len(classes)])
        for name in (OUTPUT, LOG_OUTPUT)
    ]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "terrain", inputs, outputs, graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="terrain-slip",
    )
    streams = {
        each.stream: {"channels": each.channels, "rate_hz": each.rate_hz, "n_samples": each.n_samples}
        for each in columns
    }
    metadata = {"classes": json.dumps([str(name) for name in classes]), "streams": json.dumps(streams)}
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def _filled(graph: _Graph, columns: SampleColumns, fill: Array) -> str:
    """Subtract the mean over the window of some channels, at first of none, and fill what is missing."""
    stream = columns.stream
    mask = graph.constant(np.zeros((len(columns.channels), 1), bool), f"{stream}.centred")
    mean = graph.step("Where", mask, graph.mean(stream, 2), graph.constant(np.array(0.0)))
    values = graph.step("Sub", stream, mean)
    return graph.step("Where", graph.step("IsNaN", values), graph.constant(fill, f"{stream}.fill"), values)


def _branch(
    graph: _Graph, columns: SampleColumns, branch: Branch, weights: Sequence[Array], values: str
) -> list[str]:
    """Return what a branch passes on, each (windows, K, p)."""
    c, frame = len(columns.channels), columns.frame
    n_members, hidden = weights[1].shape
    half = frame // 2
    if frame:
        values = graph.step("Sub", values, graph.mean(values, 2))
        waves = graph.step(
            "Conv",
            graph.shaped(values, (-1, 1, columns.n_samples)),
            graph.constant(fourier_kernel(frame).T[:, None]),
            strides=[columns.hop],
        )
        squares = graph.step("Mul", waves, waves)
        parts = [graph.constant(np.array([at])) for at in (0, half, 2 * half)]
        axis = graph.constant(np.array([1]))
        cosine, sine = (graph.step("Slice", squares, parts[i], parts[i + 1], axis) for i in (0, 1))
        n_frames = (columns.n_samples - frame) // columns.hop + 1
        power = graph.shaped(graph.step("Add", cosine, sine), (-1, c, half, n_frames))
        floor = graph.constant(branch.floor[:, None, None], f"{columns.stream}.floor")
        values = graph.step("Log", graph.step("Add", power, floor))
    else:
        values = graph.shaped(values, (-1, c, 1, columns.n_samples))
    scaled = graph.step("Sub", values, graph.constant(branch.mean[:, :, None], f"{columns.stream}.mean"))
    scaled = graph.step("Div", scaled, graph.constant(branch.std[:, :, None], f"{columns.stream}.std"))
    limits = [graph.constant(np.array(limit)) for limit in (-CLIP_STD, CLIP_STD)]
    rows = graph.shaped(
        graph.step("Clip", scaled, *limits),
        (0, branch.mean.size, n_frames if frame else columns.n_samples),
    )
    found = rows
    for number, groups in ((1, 1), (2, n_members)):
        weight, bias = weights[2 * number - 2 : 2 * number]
        kernel = graph.constant(
            weight.reshape(n_members * hidden, *weight.shape[2:]), f"{columns.stream}.weight_{number}"
        )
        offset = graph.constant(bias.ravel(), f"{columns.stream}.bias_{number}")
        found = graph.step("Relu", graph.step("Conv", found, kernel, offset, pads=[1, 1], group=groups))
    each = (-1, n_members, hidden)
    pooled = [
        graph.shaped(graph.mean(found, 2), each),
        graph.shaped(graph.step("ReduceMax", found, axes=[2], keepdims=1), each),
    ]
    if not frame:
        mean = graph.mean(rows, 2)
        offset = graph.step("Sub", rows, mean)
        spread = graph.step("Sqrt", graph.mean(graph.step("Mul", offset, offset), 2))
        ones = graph.constant(np.ones((1, n_members, 1)))
        pooled += [graph.step("Mul", graph.shaped(part, (-1, 1, c)), ones) for part in (mean, spread)]
    return pooled


def with_centred(content: bytes, centred: Mapping[str, Sequence[bool]], length_s: float) -> bytes:
    """Return a graph that subtracts the mean over the window of some channels of each stream.

    Parameters
    ----------
    content : of a graph
    centred : of each stream, which of its channels; of one that is not named, none
    length_s : of a window, for the metadata
    """
    onnx = require_onnx()
    model = onnx.load_from_string(content)
    for each in model.graph.initializer:
        stream, _, kind = each.name.rpartition(".")
        if kind == "centred":
            mask = np.zeros(tuple(each.dims), bool)
            mask[:] = np.array(centred.get(stream, False)).reshape(-1, 1)
            each.CopyFrom(onnx.numpy_helper.from_array(mask, each.name))
    metadata = {each.key: each.value for each in model.metadata_props}
    onnx.helper.set_model_props(model, metadata | {"length_s": json.dumps(length_s)})
    return bytes(model.SerializeToString())


@lru_cache(maxsize=8)
def _session(content: bytes) -> Any:
    """Return what runs a graph, on one core."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def log_probabilities(content: bytes, columns: Sequence[SampleColumns], samples: Array) -> Array:
    """Return the logarithms of the calibrated probabilities (n, k), in the order of the classes.

    Parameters
    ----------
    content : of the network's graph
    columns : that it was fitted to
    samples : (n, n_columns), NaN where a sample is missing

    Raises
    ------
    ConfigError
        if onnxruntime is not installed.
    DataError
        if there are not as many columns, or a sample is infinite.
    """
    require_onnx()
    if np.isinf(samples).any():
        raise DataError("a sample is infinite")
    streams = {
        each.stream: np.ascontiguousarray(values, dtype=np.float32)
        for each, values in zip(columns, streams_of(columns, samples), strict=True)
    }
    blocks = [
        _session(content).run(
            [LOG_OUTPUT], {name: rows[at : at + ROWS_AT_ONCE] for name, rows in streams.items()}
        )[0]
        for at in range(0, max(len(samples), 1), ROWS_AT_ONCE)
    ]
    return log_softmax(np.concatenate(blocks).astype(np.float64))


def check_network(content: bytes, columns: Sequence[SampleColumns], n_classes: int) -> None:
    """Refuse what is no graph of a network for these columns and classes.

    Raises
    ------
    ConfigError
        if onnx is not installed.
    DataError
        if it is none, or a number in it is not finite.
    """
    onnx = require_onnx()
    width = sum(each.width for each in columns)
    try:
        model = onnx.load_from_string(content)
        if not {node.op_type for node in model.graph.node} <= OPERATORS:
            raise DataError("the graph has other operators than a network")
        for each in model.graph.initializer:
            if len(each.external_data) or not np.isfinite(onnx.numpy_helper.to_array(each)).all():
                raise DataError(f"the network's {each.name} are not finite numbers")
        for samples in (np.full((1, width), np.nan), np.random.default_rng(0).standard_normal((2, width))):
            found = log_probabilities(content, columns, samples)
            if found.shape != (len(samples), n_classes) or not np.isfinite(found).all():
                raise DataError(
                    f"it gives log probabilities of the shape {found.shape}, or none that are finite"
                )
    except Exception as error:  # whatever a damaged file leads protobuf and its runtime to
        raise DataError(str(error) or type(error).__name__) from error


def time_of_onnx(content: bytes, window: Windows, n: int) -> Array:
    """Return how long (n,) in s one window takes on one core.

    Parameters
    ----------
    content : of the file
    window : a single one, with the channels of the file
    n : repetitions, after a first one
    """
    session = _session(content)
    streams = json.loads(session.get_modelmeta().custom_metadata_map["streams"])
    inputs = {}
    for stream, described in streams.items():
        rows = [window.channels[stream].index(name) for name in described["channels"]]
        inputs[stream] = window.values[stream][:, rows].astype(np.float32)
    times_s = np.empty(n + 1)
    for number in range(n + 1):
        began_s = time.perf_counter()
        session.run([OUTPUT], inputs)
        times_s[number] = time.perf_counter() - began_s
    return times_s[1:]
