"""A fitted network as an ONNX file, which is the one form it is stored in: windows in, probabilities out.

The graph has one input a stream, ``(windows, channels, samples)`` as they were measured, missing ones NaN,
and one output, ``(windows, classes)``.  Channels, rates, length and classes are in the file's metadata.  It
is the computation of :mod:`terrain.classify.network_numbers`, step by step; this package reads the numbers
back from it, and other programs run it as it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from terrain.classify.network_numbers import (
    CLIP_STD,
    BranchNumbers,
    NetworkNumbers,
    SampleColumns,
    fourier_kernel,
)
from terrain.errors import ConfigError, DataError
from terrain.records import Array, Windows

OPSET = 17
IR_VERSION = 8
OUTPUT = "probabilities"


def require_onnx() -> Any:
    """Return onnx; a :class:`~terrain.errors.ConfigError` where it is not installed."""
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise ConfigError("a network is stored as ONNX: pip install 'terrain-slip[cnn]'") from error
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
    numbers: NetworkNumbers, classes: Sequence[str], length_s: float, centred: Mapping[str, Sequence[bool]]
) -> bytes:
    """Return the content of an ONNX file.

    Parameters
    ----------
    numbers : of the fitted network
    classes : (k,) names in the order of the output
    length_s : of a window
    centred : of each stream, which of its channels lose their mean over the window

    Raises
    ------
    ConfigError
        if onnx is not installed.
    """
    onnx, graph = require_onnx(), _Graph()
    helper = onnx.helper
    n_members, k = numbers.head_bias.shape
    inputs, pooled, place = [], [], 0
    for columns, branch in zip(numbers.columns, numbers.branches, strict=True):
        shape = ["windows", len(columns.channels), columns.n_samples]
        inputs.append(helper.make_tensor_value_info(columns.stream, onnx.TensorProto.FLOAT, shape))
        fill = numbers.fill[place : place + columns.width].reshape(len(columns.channels), -1)
        place += columns.width
        filled = _filled(graph, columns.stream, centred[columns.stream], fill)
        pooled += _branch(graph, columns, branch, filled)
    joined = graph.step("Concat", *pooled, axis=2)
    column = graph.step("Unsqueeze", joined, graph.constant(np.array([3])))
    product = graph.step("MatMul", graph.constant(numbers.head_weight, "head_weight"), column)
    flat = graph.step("Squeeze", product, graph.constant(np.array([3])))
    logits = graph.step("Add", flat, graph.constant(numbers.head_bias, "head_bias"))
    mean = graph.step("ReduceMean", graph.step("LogSoftmax", logits, axis=2), axes=[1], keepdims=0)
    tempered = graph.step("Div", mean, graph.constant(np.array(numbers.temperature)))
    graph.step("Softmax", tempered, output=OUTPUT, axis=1)
    output = helper.make_tensor_value_info(OUTPUT, onnx.TensorProto.FLOAT, ["windows", k])
    model = helper.make_model(
        helper.make_graph(graph.nodes, "terrain", inputs, [output], graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="terrain-slip",
    )
    streams = {
        each.stream: {"channels": each.channels, "rate_hz": each.rate_hz, "n_samples": each.n_samples}
        for each in numbers.columns
    }
    metadata = {
        "classes": json.dumps([str(name) for name in classes]),
        "streams": json.dumps(streams),
        "length_s": json.dumps(length_s),
        "members": json.dumps(n_members),
        "temperature": repr(float(numbers.temperature)),
    }
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def _filled(graph: _Graph, stream: str, centred: Sequence[bool], fill: Array) -> str:
    """Subtract the mean over the window of some channels, and fill what is missing."""
    mask = graph.constant(np.array(centred)[:, None])
    mean = graph.step("Where", mask, graph.mean(stream, 2), graph.constant(np.array(0.0)))
    values = graph.step("Sub", stream, mean)
    return graph.step("Where", graph.step("IsNaN", values), graph.constant(fill, f"{stream}.fill"), values)


def _branch(graph: _Graph, columns: SampleColumns, branch: BranchNumbers, values: str) -> list[str]:
    """Return what a branch passes on, each (windows, K, p)."""
    c, frame = len(columns.channels), columns.frame
    n_members, hidden = branch.bias_1.shape
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
    for number, weight, bias, groups in (
        (1, branch.weight_1, branch.bias_1, 1),
        (2, branch.weight_2, branch.bias_2, n_members),
    ):
        kernel = graph.constant(
            weight.reshape(n_members * hidden, *weight.shape[2:]), f"{columns.stream}.weight_{number}"
        )
        offset = graph.constant(bias.ravel(), f"{columns.stream}.bias_{number}")
        found = graph.step("Conv", found, kernel, offset, pads=[1, 1], group=groups)
        found = graph.step("Relu", found)
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


def numbers_of_onnx(content: bytes, columns: Sequence[SampleColumns]) -> NetworkNumbers:
    """Return the numbers of a network out of the ONNX file that it is stored in.

    Parameters
    ----------
    content : as :func:`network_onnx` returns it
    columns : that the network was fitted to

    Raises
    ------
    ConfigError
        if onnx is not installed.
    DataError
        if it is no such file; shapes are compared by :func:`terrain.classify.network_numbers.check_network`.
    """
    onnx = require_onnx()
    try:
        model = onnx.load_from_string(content)
        found = {each.name: onnx.numpy_helper.to_array(each) for each in model.graph.initializer}
        described = {each.key: each.value for each in model.metadata_props}
        n_members = int(described["members"])
        branches, fill = [], []
        for each in columns:
            named = {name: found.get(f"{each.stream}.{name}") for name in ("fill", *BranchNumbers._fields)}
            if not each.frame:  # of samples, which have no spectrum
                named["floor"] = np.zeros(len(each.channels), np.float32)
            part = {name: np.asarray(array) for name, array in named.items()}
            fill.append(part["fill"].ravel())
            of_members = [
                part[name].reshape(n_members, -1, *part[name].shape[1:]) for name in BranchNumbers._fields[3:]
            ]
            branches.append(
                BranchNumbers(part["floor"].ravel(), part["mean"][..., 0], part["std"][..., 0], *of_members)
            )
        return NetworkNumbers(
            tuple(columns),
            np.concatenate(fill).astype(float),
            tuple(branches),
            found["head_weight"],
            found["head_bias"],
            float(described["temperature"]),
        )
    except Exception as error:  # whatever a damaged file leads protobuf and numpy to
        raise DataError(str(error) or type(error).__name__) from error


def time_of_onnx(content: bytes, window: Windows, n: int) -> Array | None:
    """Return how long (n,) in s one window takes on one core; None where onnxruntime is not installed.

    Parameters
    ----------
    content : of the file
    window : a single one, with the channels of the file
    n : repetitions, after a first one
    """
    try:
        import onnxruntime
    except ModuleNotFoundError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    streams = json.loads(session.get_modelmeta().custom_metadata_map["streams"])
    inputs = {}
    for stream, described in streams.items():
        rows = [window.channels[stream].index(name) for name in described["channels"]]
        inputs[stream] = window.values[stream][:, rows].astype(np.float32)
    times_s = np.empty(n + 1)
    for number in range(n + 1):
        began_s = time.perf_counter()
        session.run(None, inputs)
        times_s[number] = time.perf_counter() - began_s
    return times_s[1:]
