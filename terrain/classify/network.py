"""Networks over the streams of a window: what they see, how torch fits them, and the graph that predicts.

Each stream has a branch of its own; nothing is resampled.  Of a stream that is fast enough for a spectrum, the
branch sees the spectrogram of each channel, of a slow one the samples:

- ``S_cft = log(|sum_u w_u (x_c,ht+u - m_c) exp(-2 pi i f u / F)|^2 + e_c)`` with frames of ``F`` samples
  every ``h``, a Hann window w, the window's mean m and a floor e, which keeps a channel at rest from
  deciding by its rounding;
- both are standardised by training windows and clipped.

Two convolutions over time, each with a rectifier; then the mean and the largest value over time, of the samples of a
slow stream also the mean and standard deviation of each channel; and one linear layer that joins all branches.

Steps of ``fit``: standardise by all rows; on all inner folds of whole runs choose the augmentation; fit one
network an inner fold, stopped where its held-out runs are most likely; their held-out probabilities give the
temperature; fit the members anew on all runs, for the mean number of epochs of these networks: with few runs,
each one counts.  The mean of the members' log probabilities, divided by the temperature, gives the probabilities.

Training windows are varied as the physics allows: a window might have begun earlier, the ground might shake the
robot more, it might have driven the mirror image of its path, a sensor might have failed.

What is fitted is kept as an ONNX graph: it predicts without torch, here, in a model's folder and in other programs.
It has one input a stream, ``(windows, channels, samples)``, missing ones NaN, and two outputs ``(windows, classes)``:
probabilities, and their logarithms.  In the file of a model channels lose their mean over the window first, where
training windows had lost it, so that other programs give what was measured.  Channels, rates, length and classes are
in its metadata.  This is the one module that imports torch.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from terrain.classify.folds import TOO_FEW, inner_splits, run_of
from terrain.classify.grouped import GroupedClassifier
from terrain.errors import ConfigError, DataError
from terrain.records import Array, Windows

FRAME_S, HOP_S = 0.4, 0.1
#: A stream with fewer samples in a frame is slow: the network sees its samples, not their spectrum.
MIN_FRAME = 16
#: The floor of a spectrogram as a fraction of the channel's mean power in training windows.
FLOOR_RATIO = 1e-4
CLIP_STD = 5.0

BATCH = 64
MIN_BATCHES, SMALL_BATCH = 4, 8  #: Few windows make so many batches an epoch, of at least so many windows.
LEARNING_RATE, WEIGHT_DECAY, LABEL_SMOOTHING = 3e-3, 1e-2, 0.05
DROPOUT, INPUT_DROPOUT = 0.4, 0.1
HIDDEN_SPECTRUM, HIDDEN_SAMPLES = 48, 16

LOG_TEMPERATURE_BOUNDS = (-3.0, 3.0)

GAIN_STD = 0.5  #: Standard deviation of the logarithm of the amplitude of vibration: assumed.
DROPOUT_RATIO = 0.1  #: How often a stream is taken for failed.
#: Axes along which a quantity changes its sign in the mirror; x points ahead, y to the left.
TURNED = {"gyro": "xz", "accel": "y", "speed": "y", "position": "y", "velocity": "y", "odometry": "y"}
TURNED_WORDS = frozenset({"roll", "yaw", "lateral"})

OPSET, IR_VERSION = 17, 8
OUTPUT, LOG_OUTPUT = "probabilities", "log_probabilities"
ROWS_AT_ONCE = 256

#: Of the graph; none of them repeats or reads anything, so that a stranger's file cannot either.
OPERATORS = frozenset(
    (
        *("Add", "Clip", "Concat", "Conv", "Div", "IsNaN", "Log", "LogSoftmax", "MatMul", "Mul", "ReduceMax"),
        *("ReduceMean", "Relu", "Reshape", "Slice", "Softmax", "Sqrt", "Squeeze", "Sub", "Unsqueeze"),
        "Where",
    )
)


class SampleColumns(NamedTuple):
    """Consecutive columns of a matrix: the samples of a stream in a window, channel by channel."""

    stream: str
    channels: tuple[str, ...]
    rate_hz: float
    n_samples: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.channels) * self.n_samples

    @property
    def frame(self) -> int:
        """Samples in a frame of the spectrogram; 0 where the stream is too slow, or the window too short."""
        frame = 2 * round(FRAME_S * self.rate_hz / 2)
        return frame if MIN_FRAME <= frame <= self.n_samples else 0

    @property
    def hop(self) -> int:
        """Samples from frame to frame."""
        return max(1, round(HOP_S * self.rate_hz))


def streams_of(columns: Sequence[SampleColumns], samples: Array) -> list[Array]:
    """Return each stream's samples (n, channels, samples); ``DataError`` where there are not as many columns."""
    width = sum(each.width for each in columns)
    if samples.ndim != 2 or samples.shape[1] != width:
        raise DataError(f"samples have the shape {samples.shape}, (n, {width}) is needed")
    parts = np.split(samples, np.cumsum([each.width for each in columns])[:-1], axis=1)
    return [
        part.reshape(len(samples), len(each.channels), each.n_samples)
        for each, part in zip(columns, parts, strict=True)
    ]


def power_spectrogram(values: Array, frame: int, hop: int) -> Array:
    """Return the power (n, c, f, frames) of frequencies 1 to ``frame / 2`` of samples (n, c, samples)."""
    centred = values - values.mean(axis=2, keepdims=True)
    frames = np.ascontiguousarray(sliding_window_view(centred, frame, axis=2)[:, :, ::hop])
    squares = frames @ fourier_kernel(frame).astype(values.dtype)
    np.square(squares, out=squares)
    half = frame // 2
    return np.asarray((squares[..., :half] + squares[..., half:]).swapaxes(2, 3))


@cache
def fourier_kernel(frame: int) -> Array:
    """Return the windowed cosines and sines (frame, frame) of frequencies 1 to ``frame / 2``."""
    angle = 2 * np.pi * np.outer(np.arange(frame), np.arange(1, frame // 2 + 1)) / frame
    waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.hanning(frame)[:, None] * waves)


def _seen(columns: SampleColumns, values: Array, floor: Array) -> Array:
    """Return what a branch sees before it is standardised (n, c, f, t): the spectrogram, or the samples."""
    if not columns.frame:
        return values[:, :, None]
    power = power_spectrogram(values, columns.frame, columns.hop)
    return np.asarray(np.log(power + floor[:, None, None]))


class Augmentation(NamedTuple):
    """Which variations are used."""

    shift: bool = False  #: of the window, its end continued by its beginning
    #: of the vibration in a window, log-normal, one for all channels of a stream that is fast enough to hold it:
    #: speed, load and tyres shake all axes; what a slow stream measures stays as it is
    gain: bool = False
    mirror: bool = False  #: half of the windows, left for right
    dropout: bool = False  #: a stream at its training mean, in a window out of ten


#: Where each channel's mirror image is among the channels, and its sign.
Mirror = tuple[tuple[int, ...], tuple[float, ...]]


def mirror_of(channels: Sequence[str]) -> Mirror | None:
    """Return the left-right mirror of a stream's channels; None where names do not give it.

    Wheels with numbers have places that only the robot's description knows.

    Examples
    --------
    >>> mirror_of(("gyro_z_radps", "accel_x_mps2", "accel_y_mps2"))
    ((0, 1, 2), (-1.0, 1.0, -1.0))
    >>> mirror_of(("speed_left_mps", "speed_right_mps")), mirror_of(("motor_1_radps",))
    (((1, 0), (1.0, 1.0)), None)
    """
    places, signs = [], []
    for name in channels:
        words = name.split("_")
        image = "_".join({"left": "right", "right": "left"}.get(word, word) for word in words)
        if image not in channels or any(word.isdigit() for word in words):
            return None
        turned = bool(TURNED_WORDS & set(words)) or any(
            axis in words[1:] for axis in TURNED.get(words[0], "")
        )
        places.append(list(channels).index(image))
        signs.append(-1.0 if turned else 1.0)
    return tuple(places), tuple(signs)


def mirrors_of(columns: Sequence[SampleColumns]) -> tuple[Mirror, ...] | None:
    """Return the mirror of all streams; None where one of them has none."""
    mirrors = [mirror_of(each.channels) for each in columns]
    return None if None in mirrors else tuple(each for each in mirrors if each is not None)


def augmented(
    streams: Sequence[Array],
    means: Sequence[Array],
    used: Augmentation,
    columns: Sequence[SampleColumns],
    rng: np.random.Generator,
) -> list[Array]:
    """Return varied windows (n, channels, samples) of each stream, each with its own draw.

    The draw is the same in all streams where time or sides are; ``means`` (channels,) are of training windows.
    """
    n = len(streams[0])
    found = list(streams)
    if used.shift:
        fraction = rng.random(n)
        for i, values in enumerate(found):
            length = values.shape[2]
            begins = sliding_window_view(np.concatenate([values, values], axis=2), length, axis=2)
            found[i] = begins[np.arange(n), :, (fraction * length).astype(int)]
    if used.gain:
        for i, values in enumerate(found):
            vibrates = columns[i].frame > 0
            gain = np.exp(GAIN_STD * vibrates * rng.standard_normal((n, 1, 1)))
            found[i] = values * gain.astype(values.dtype)
    if used.mirror and (mirrors := mirrors_of(columns)) is not None:
        turned = np.flatnonzero(rng.random(n) < 0.5)
        for i, (values, (places, signs)) in enumerate(zip(found, mirrors, strict=True)):
            found[i] = values.copy()
            found[i][turned] = values[turned][:, list(places)] * np.array(signs, values.dtype)[:, None]
    if used.dropout and len(found) > 1:
        failed = rng.random(n) < DROPOUT_RATIO
        which = rng.integers(len(found), size=n)
        for i, (values, mean) in enumerate(zip(found, means, strict=True)):
            found[i] = values.copy()
            found[i][failed & (which == i)] = mean[:, None]
    return found


def require_torch() -> Any:
    """Return torch; a :class:`~terrain.errors.ConfigError` where it is not installed."""
    try:
        import torch
    except ModuleNotFoundError as error:
        raise ConfigError(
            "the recipes 'cnn', 'stack' and 'best' train with torch: pip install 'terrain-slip[cnn]'"
        ) from error
    return torch


@contextmanager
def reproducible() -> Iterator[None]:
    """One thread, and the generator of all others left as it was: the same bytes whatever runs beside."""
    torch = require_torch()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)


class Training:
    """What all members share: training samples by stream, classes by number, and their branches.

    A window of a run of ``n`` weighs ``1/sqrt(n)``: the windows of a run resemble each other, so a long run
    tells more than a short one, but not as much more as it is longer.

    Parameters
    ----------
    columns, samples : of the streams, (n, n_columns) without gaps
    class_index, groups : (n,) class by number, and run
    """

    def __init__(
        self, columns: Sequence[SampleColumns], samples: Array, class_index: Array, groups: Array
    ) -> None:
        self.columns, self.class_index = columns, class_index
        self.streams = streams_of(columns, samples)
        #: of each stream its floor (c,), and mean and deviation (c, f) in training; f = 1 of samples
        self.branches: list[tuple[Array, Array, Array]] = []
        for each, values in zip(columns, self.streams, strict=True):
            floor = np.zeros(len(each.channels), np.float32)
            if each.frame:
                floor = FLOOR_RATIO * power_spectrogram(values, each.frame, each.hop).mean(axis=(0, 2, 3))
                floor = np.maximum(floor, np.finfo(np.float32).tiny * 1e8)  # of a channel at rest
            found = _seen(each, values, floor)
            mean, std = found.mean(axis=(0, 3)), found.std(axis=(0, 3))
            std = np.where(std > 1e-6 * np.maximum(1.0, np.abs(mean)), std, 1.0)
            self.branches.append((floor, mean, std))
        self.means = [values.mean(axis=(0, 2)) for values in self.streams]
        _, run, count = np.unique(groups, return_inverse=True, return_counts=True)
        weight = 1.0 / np.sqrt(count[run])
        self.weight = (weight / weight.mean()).astype(np.float32)

    def rows(self, streams: Sequence[Array]) -> list[Array]:
        """Return what the branches see, standardised and clipped, as rows of a convolution (n, c f, t)."""
        rows = []
        for columns, (floor, mean, std), values in zip(self.columns, self.branches, streams, strict=True):
            scaled = _seen(columns, values, floor) - mean[:, :, None]
            scaled /= std[:, :, None]
            clipped = np.clip(scaled, -CLIP_STD, CLIP_STD, out=scaled)
            rows.append(clipped.reshape(len(scaled), -1, scaled.shape[3]))
        return rows

    def member(
        self, split: tuple[Array, Array], used: Augmentation, epochs: int, seed: int
    ) -> tuple[Array, float, int]:
        """Fit one network on the first rows of a split, stopped where the others are most likely.

        Returns
        -------
        log probabilities (m, k) of the others, their mean loss, and the epoch, of at most so many
        """
        torch = require_torch()
        functional = torch.nn.functional
        train, test = split
        held_out = [torch.from_numpy(rows) for rows in self.rows([values[test] for values in self.streams])]
        truth = torch.from_numpy(self.class_index[test])
        best: tuple[Array, float, int] | None = None
        for epoch, net in enumerate(self.epochs(train, used, epochs, seed)):
            with torch.no_grad():
                logits = net(held_out)
                loss = float(functional.cross_entropy(logits, truth))
                if best is None or loss < best[1]:
                    best = functional.log_softmax(logits, dim=1).numpy().astype(float), loss, epoch
        assert best is not None
        return best

    def epochs(self, train: Array, used: Augmentation, epochs: int, seed: int) -> Iterator[Any]:
        """Yield the network, ready to predict, after each epoch on some rows; ``seed`` is of all that is drawn."""
        torch = require_torch()
        functional = torch.nn.functional
        torch.manual_seed(seed)
        rng = np.random.default_rng((seed, 1))
        net = self._network()
        streams = [values[train] for values in self.streams]
        plain = self.rows(streams) if used == Augmentation() else []
        truth = torch.from_numpy(self.class_index[train])
        weight = torch.from_numpy(self.weight[train])
        n_batches = max(len(train) // BATCH, min(MIN_BATCHES, len(train) // SMALL_BATCH), 1)
        optimizer = torch.optim.AdamW(net.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, LEARNING_RATE, total_steps=epochs * n_batches, pct_start=0.15
        )
        for _ in range(epochs):
            net.train()
            for batch in np.array_split(rng.permutation(len(train)), n_batches):
                if plain:
                    rows = [part[batch] for part in plain]
                else:
                    drawn = [values[batch] for values in streams]
                    rows = self.rows(augmented(drawn, self.means, used, self.columns, rng))
                logits = net([torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in rows])
                places = torch.from_numpy(batch)
                losses = functional.cross_entropy(
                    logits, truth[places], label_smoothing=LABEL_SMOOTHING, reduction="none"
                )
                loss = (losses * weight[places]).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
            net.eval()
            yield net

    def _network(self) -> Any:
        """Return an untrained network: a branch for each stream, and the layer that joins them."""
        torch = require_torch()
        nn = torch.nn
        of_samples = [not each.frame for each in self.columns]
        branches, pooled_width = nn.ModuleList(), 0
        for slow, (_, mean, _) in zip(of_samples, self.branches, strict=True):
            rows, hidden = mean.size, HIDDEN_SAMPLES if slow else HIDDEN_SPECTRUM
            layers = (
                nn.Identity() if slow else nn.Dropout1d(INPUT_DROPOUT),
                nn.Conv1d(rows, hidden, 3, padding=1),
                nn.BatchNorm1d(hidden),
                nn.ReLU(),
                nn.Dropout(0.0 if slow else DROPOUT / 2),
                nn.Conv1d(hidden, hidden, 3, padding=1),
                nn.BatchNorm1d(hidden),
                nn.ReLU(),
            )
            branches.append(nn.Sequential(*layers))
            pooled_width += 2 * hidden + (2 * rows if slow else 0)
        n_classes = int(self.class_index.max()) + 1

        class Network(nn.Module):  # type: ignore[name-defined]
            """Branches over the standardised rows (n, c f, t) of each stream, pooled and joined."""

            def __init__(self) -> None:
                super().__init__()
                self.branches = branches
                self.head = nn.Sequential(nn.Dropout(DROPOUT), nn.Linear(pooled_width, n_classes))

            def forward(self, streams: Sequence[Any]) -> Any:
                pooled = []
                for branch, rows, slow in zip(self.branches, streams, of_samples, strict=True):
                    hidden = branch(rows)
                    pooled += [hidden.mean(-1), hidden.amax(-1)]
                    if slow:
                        pooled += [rows.mean(-1), rows.std(-1, unbiased=False)]
                return self.head(torch.cat(pooled, 1))

        return Network()


def can_fit() -> bool:
    """Return whether torch, which fits networks, and what stores them are installed."""
    return all(find_spec(name) is not None for name in ("torch", "onnx", "onnxruntime"))


def require_onnx() -> Any:
    """Return onnx; a :class:`~terrain.errors.ConfigError` where it is not installed."""
    try:
        import onnx
        import onnxruntime  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError("a network is an ONNX graph: pip install 'terrain-slip[cnn]'") from error
    return onnx


def network_onnx(
    training: Training, nets: Sequence[Any], fill: Array, temperature: float, classes: Sequence[str]
) -> bytes:
    """Return the graph of fitted members.

    ``fill`` (n_columns,) is what a missing sample is taken for, ``temperature`` what log probabilities are divided
    by, ``classes`` (k,) are in the order of the output.
    """
    onnx = require_onnx()
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(array: Any, name: str = "") -> str:
        values = np.asarray(array)
        values = values.astype(np.float32) if values.dtype.kind == "f" else values
        name = name or f"c{len(constants)}"
        constants.append(onnx.numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def step(kind: str, *inputs: Any, output: str = "", **attributes: Any) -> str:
        names = [each if isinstance(each, str) else constant(each) for each in inputs]
        output = output or f"n{len(nodes)}"
        nodes.append(onnx.helper.make_node(kind, names, [output], **attributes))
        return output

    def mean_of(values: str) -> str:
        return step("ReduceMean", values, axes=[2], keepdims=1)

    helper, float_ = onnx.helper, onnx.TensorProto.FLOAT
    inputs, pooled, streams = [], [], {}
    of_streams = zip(
        training.columns, training.branches, streams_of(training.columns, fill[None]), strict=True
    )
    for number, (columns, (floor, mean, std), missing) in enumerate(of_streams):
        stream, c, frame, n_times = columns.stream, len(columns.channels), columns.frame, columns.n_samples
        inputs.append(helper.make_tensor_value_info(stream, float_, ["windows", c, n_times]))
        streams[stream] = {"channels": columns.channels, "rate_hz": columns.rate_hz, "n_samples": n_times}
        centred = constant(np.zeros((c, 1), bool), f"{stream}.centred")  # at first no channel is
        values = step("Sub", stream, step("Where", centred, mean_of(stream), 0.0))
        values = step("Where", step("IsNaN", values), constant(missing[0], f"{stream}.fill"), values)
        if frame:
            values = step("Sub", values, mean_of(values))
            single = step("Reshape", values, [-1, 1, n_times])
            waves = step("Conv", single, fourier_kernel(frame).T[:, None], strides=[columns.hop])
            squares, half = step("Mul", waves, waves), frame // 2
            parts = (step("Slice", squares, [at], [at + half], [1]) for at in (0, half))
            n_times = (n_times - frame) // columns.hop + 1
            power = step("Reshape", step("Add", *parts), [-1, c, half, n_times])
            values = step("Log", step("Add", power, constant(floor[:, None, None], f"{stream}.floor")))
        else:
            values = step("Reshape", values, [-1, c, 1, n_times])
        scaled = step("Sub", values, constant(mean[:, :, None], f"{stream}.mean"))
        scaled = step("Div", scaled, constant(std[:, :, None], f"{stream}.std"))
        clipped = step("Clip", scaled, -CLIP_STD, CLIP_STD)
        found = rows = step("Reshape", clipped, [0, mean.size, n_times])
        for layer, (place, groups) in enumerate(((1, 1), (5, len(nets))), start=1):
            weights, biases = [], []
            for net in nets:  # a convolution with the normalisation after it: both are linear
                conv, norm = net.branches[number][place], net.branches[number][place + 1]
                parameters = (
                    conv.weight,
                    conv.bias,
                    norm.weight,
                    norm.bias,
                    norm.running_mean,
                    norm.running_var,
                )
                weight, bias, gain, shift, centre, variance = (
                    each.detach().numpy().astype(np.float64) for each in parameters
                )
                scale = gain / np.sqrt(variance + norm.eps)
                weights.append(weight * scale[:, None, None])
                biases.append(scale * (bias - centre) + shift)
            kernel = constant(np.concatenate(weights), f"{stream}.weight_{layer}")
            offset = constant(np.concatenate(biases), f"{stream}.bias_{layer}")
            found = step("Relu", step("Conv", found, kernel, offset, pads=[1, 1], group=groups))
        largest = step("ReduceMax", found, axes=[2], keepdims=1)
        pooled += [
            step("Reshape", part, [-1, len(nets), len(biases[0])]) for part in (mean_of(found), largest)
        ]
        if not frame:
            level = mean_of(rows)
            apart = step("Sub", rows, level)
            for part in (level, step("Sqrt", mean_of(step("Mul", apart, apart)))):
                alike = step("Reshape", part, [-1, 1, c])
                pooled.append(step("Mul", alike, np.ones((1, len(nets), 1))))
    column = step("Unsqueeze", step("Concat", *pooled, axis=2), [3])
    joining, added = (
        np.stack([getattr(net.head[1], name).detach().numpy() for net in nets]) for name in ("weight", "bias")
    )
    product = step("MatMul", constant(joining, "head_weight"), column)
    logits = step("Add", step("Squeeze", product, [3]), constant(added, "head_bias"))
    joined = step("ReduceMean", step("LogSoftmax", logits, axis=2), axes=[1], keepdims=0)
    tempered, outputs = step("Div", joined, constant(np.array(temperature), "temperature")), []
    for kind, name in (("Softmax", OUTPUT), ("LogSoftmax", LOG_OUTPUT)):
        step(kind, tempered, output=name, axis=1)
        outputs.append(helper.make_tensor_value_info(name, float_, ["windows", len(classes)]))
    model = helper.make_model(
        helper.make_graph(nodes, "terrain", inputs, outputs, constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="terrain-slip",
    )
    metadata = {"classes": json.dumps([str(name) for name in classes]), "streams": json.dumps(streams)}
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def with_centred(content: bytes, centred: Mapping[str, Sequence[bool]], length_s: float) -> bytes:
    """Return a graph that subtracts the mean over the window of some channels of each stream, none of one not named.

    ``length_s`` of a window goes into the metadata.
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
    """Return the logarithms of calibrated probabilities (n, k) of samples (n, n_columns), NaN where one is missing.

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
    return np.asarray(log_softmax(np.concatenate(blocks).astype(np.float64), axis=1))


def check_network(content: bytes, columns: Sequence[SampleColumns], n_classes: int) -> None:
    """Refuse by ``DataError`` what is no graph of a network for these columns and classes, all numbers finite."""
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
    """Return how long (n,) in s a single window with the channels of a file takes on one core, after a first time."""
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


class NetworkChoice(NamedTuple):
    """What inner folds chose: the augmentation, and the members' mean number of epochs."""

    shift: bool
    gain: bool
    mirror: bool
    dropout: bool
    epochs: float


class Trial(NamedTuple):
    """An augmentation, and the mean log loss of runs that were held out under it."""

    augmentation: Augmentation
    loss: float


@dataclass(eq=False, repr=False)
class GroupedNetwork(GroupedClassifier):
    """Ensemble of small convolutional networks that keeps runs whole.

    Attributes
    ----------
    best_ : :class:`NetworkChoice`
    trials_ : :class:`Trial` of each augmentation that was tried
    onnx_ : the graph that it predicts with
    """

    columns: Sequence[SampleColumns] = ()  #: :class:`SampleColumns` of each stream
    n_inner_folds: int = 5  #: networks that choose and calibrate, one an inner fold
    n_members: int = 3  #: networks that predict, each fitted on all runs
    epochs: int = 30  #: at most, of each
    trial_epochs: int = 10  #: of the networks that choose the augmentation; 0 for none, and no choice
    gap: int = 1  #: windows left out beside an inner test block, where the only run of a class is cut
    seed: int = 0  #: deals runs into inner folds, and of all that is drawn

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedNetwork:
        """Choose, fit and calibrate on samples (n, n_columns), NaN where missing.

        Raises
        ------
        ConfigError
            if torch or onnx is not installed.
        DataError
            if there is one class only, too few windows to hold some of them out, or other columns.
        """
        require_torch()
        require_onnx()
        X, y, groups = self._training_rows(X, y, groups)
        class_index = np.searchsorted(self.classes_, y)
        columns = tuple(self.columns)
        if not columns or sum(each.width for each in columns) != X.shape[1]:
            raise DataError(f"the columns of the samples do not describe rows of {X.shape[1]} columns")
        fills = []  # the mean of each channel, 0 where it was never measured
        for each, values in zip(columns, streams_of(columns, X), strict=True):
            known = np.isfinite(values)
            total = np.where(known, values, 0.0).sum(axis=(0, 2))
            fills.append(np.repeat(total / np.maximum(known.sum(axis=(0, 2)), 1), each.n_samples))
        fill = np.concatenate(fills)
        training = Training(
            columns, np.where(np.isnan(X), fill, X).astype(np.float32), class_index, run_of(groups)
        )
        splits = list(inner_splits(y, groups, self.n_inner_folds, self.seed, self.gap))
        if not splits:
            raise DataError(TOO_FEW)
        with reproducible():
            self.trials_: tuple[Trial, ...] = ()
            used, losses = Augmentation(), dict[Augmentation, float]()

            def loss(used: Augmentation) -> float:
                if used not in losses:
                    members = self._members(training, splits, used, self.trial_epochs)
                    losses[used] = float(np.mean([each for _, each, _ in members]))
                return losses[used]

            if self.trial_epochs:  # none, one, or all that lower the loss alone: what does so most
                vibrates, mirrored = any(each.frame for each in columns), mirrors_of(columns) is not None
                can = {"shift": True, "gain": vibrates, "mirror": mirrored, "dropout": len(columns) > 1}
                limit, possible = loss(used), [name for name, each in can.items() if each]
                better = [name for name in possible if loss(Augmentation(**{name: True})) < limit]
                loss(Augmentation(**dict.fromkeys(better, True)))
                self.trials_ = tuple(Trial(*each) for each in losses.items())
                used = min(losses, key=lambda each: losses[each])
            inner = self._members(training, splits, used, self.epochs)
            epochs = float(np.mean([epoch + 1 for *_, epoch in inner]))
            seeds = self.seed + len(splits) + np.arange(self.n_members)
            everything = np.arange(len(y)), used, max(round(epochs), 1)
            nets = [list(training.epochs(*everything, int(seed)))[-1] for seed in seeds]
        log_probability = np.full((len(y), len(self.classes_)), np.nan)
        for (_, test), (held_out, *_) in zip(splits, inner, strict=True):
            log_probability[test] = held_out
        rows = np.flatnonzero(np.isfinite(log_probability).all(axis=1))
        temperature = fit_temperature(log_probability[rows], class_index[rows])
        self.inner_probability_ = np.exp(log_softmax(log_probability / temperature, axis=1))
        self.best_ = NetworkChoice(*used, epochs)
        self.onnx_ = network_onnx(training, nets, fill, temperature, self.classes_.tolist())
        return self

    def _members(
        self, training: Training, splits: Sequence[tuple[Array, Array]], used: Augmentation, epochs: int
    ) -> list[tuple[Array, float, int]]:
        return [training.member(split, used, epochs, self.seed + i) for i, split in enumerate(splits)]

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        return np.asarray(np.exp(log_probabilities(self.onnx_, self.columns, self._rows(X))))


def fit_temperature(log_probability: Array, class_index: Array) -> float:
    """Return the divisor of log probabilities (n, k) under which the true classes are most likely.

    Guo et al. 2017, "On calibration of modern neural networks", section 4.2.
    """
    rows = np.arange(len(class_index))

    def loss(log_temperature: float) -> float:
        return float(
            -log_softmax(log_probability / np.exp(log_temperature), axis=1)[rows, class_index].mean()
        )

    found = minimize_scalar(loss, bounds=LOG_TEMPERATURE_BOUNDS, method="bounded")
    return float(np.exp(found.x))
