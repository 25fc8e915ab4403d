"""Networks over the spectrograms of a window's streams, fitted with torch: the one module that imports it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from terrain.classify.augment import Augmentation, augmented, mirrors_of
from terrain.classify.network_input import (
    FLOOR_RATIO,
    Branch,
    SampleColumns,
    power_spectrogram,
    seen,
    standardised,
    streams_of,
)
from terrain.classify.network_onnx import MemberWeights
from terrain.errors import ConfigError
from terrain.records import Array

BATCH = 64
MIN_BATCHES, SMALL_BATCH = 4, 8
"""Few windows make so many batches an epoch, of at least so many windows."""

LEARNING_RATE = 3e-3
WEIGHT_DECAY = 1e-2
LABEL_SMOOTHING = 0.05
DROPOUT = 0.4
INPUT_DROPOUT = 0.1
HIDDEN_SPECTRUM = 48
HIDDEN_SAMPLES = 16
NO_TORCH = "the recipes 'cnn', 'stack' and 'best' train with torch: pip install 'terrain-slip[cnn]'"


class Member(NamedTuple):
    """A member, its held-out log probabilities and their mean loss, and the epoch that it was stopped at."""

    net: Any
    held_out: Array
    loss: float
    epoch: int


class Task(NamedTuple):
    """What all members share: training samples by stream, classes by number, and their branches."""

    streams: list[Array]
    class_index: Array
    weight: Array
    n_classes: int
    columns: tuple[SampleColumns, ...]
    branches: list[Branch]
    means: list[Array]

    def rows(self, streams: Sequence[Array]) -> list[Array]:
        """Return what the branches see, standardised."""
        return [
            standardised(branch, seen(columns, values, branch.floor))
            for columns, branch, values in zip(self.columns, self.branches, streams, strict=True)
        ]


def require_torch() -> Any:
    """Return torch; a :class:`~terrain.errors.ConfigError` where it is not installed."""
    try:
        import torch
    except ModuleNotFoundError as error:
        raise ConfigError(NO_TORCH) from error
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


def task_of(columns: tuple[SampleColumns, ...], samples: Array, class_index: Array, groups: Array) -> Task:
    """Return what all members share: ``samples`` (n, n_columns) without gaps, ``class_index`` and run (n,).

    A window of a run of ``n`` weighs ``1/sqrt(n)``: the windows of a run resemble each other, so a long run
    tells more than a short one, but not as much more as it is longer.
    """
    streams = list(streams_of(columns, samples))
    branches = []
    for each, values in zip(columns, streams, strict=True):
        floor = np.zeros(len(each.channels), np.float32)
        if each.frame:
            floor = FLOOR_RATIO * power_spectrogram(values, each.frame, each.hop).mean(axis=(0, 2, 3))
            floor = np.maximum(floor, np.finfo(np.float32).tiny * 1e8)  # of a channel at rest
        found = seen(each, values, floor)
        std = found.std(axis=(0, 3))
        std = np.where(std > 1e-6 * np.maximum(1.0, np.abs(found.mean(axis=(0, 3)))), std, 1.0)
        branches.append(Branch(floor, found.mean(axis=(0, 3)), std))
    means = [values.mean(axis=(0, 2)) for values in streams]
    _, run, count = np.unique(groups, return_inverse=True, return_counts=True)
    weight = 1.0 / np.sqrt(count[run])
    weight = (weight / weight.mean()).astype(np.float32)
    return Task(streams, class_index, weight, int(class_index.max()) + 1, columns, branches, means)


def fit_member(task: Task, split: tuple[Array, Array], used: Augmentation, epochs: int, seed: int) -> Member:
    """Fit one network on some rows, stopped at the epoch under which the others are most likely.

    Parameters
    ----------
    task : samples and classes
    split : rows to train on, and rows that are held out
    used : augmentation of the training rows
    epochs : at most
    seed : of the first weights, the order of the rows and the augmentation
    """
    torch = require_torch()
    functional = torch.nn.functional
    train, test = split
    held_out = [torch.from_numpy(rows) for rows in task.rows([values[test] for values in task.streams])]
    test_truth = torch.from_numpy(task.class_index[test])
    best, at, net = np.inf, 0, None
    kept: dict[str, Any] = {}
    for epoch, net in enumerate(_epochs(task, train, used, epochs, seed)):
        with torch.no_grad():
            found = float(functional.cross_entropy(net(held_out), test_truth))
        if found < best or not kept:
            best, at = found, epoch
            kept = {name: value.clone() for name, value in net.state_dict().items()}
    assert net is not None
    net.load_state_dict(kept)
    with torch.no_grad():
        log_probability = functional.log_softmax(net(held_out), dim=1).numpy().astype(float)
    return Member(net, log_probability, float(best), at)


def fit_on_all(task: Task, used: Augmentation, epochs: int, seed: int) -> Any:
    """Return a network fitted on all rows; parameters as of :func:`fit_member`."""
    return list(_epochs(task, np.arange(len(task.class_index)), used, max(epochs, 1), seed))[-1]


def _epochs(task: Task, train: Array, used: Augmentation, epochs: int, seed: int) -> Iterator[Any]:
    """Yield the network, ready to predict, after each epoch on some rows."""
    torch = require_torch()
    functional = torch.nn.functional
    torch.manual_seed(seed)
    rng = np.random.default_rng((seed, 1))
    mirrors = mirrors_of(task.columns)
    vibrates = [each.frame > 0 for each in task.columns]
    net = _network(task)
    streams = [values[train] for values in task.streams]
    plain = task.rows(streams) if used == Augmentation() else []
    truth = torch.from_numpy(task.class_index[train])
    weight = torch.from_numpy(task.weight[train])
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
                rows = task.rows(augmented(drawn, task.means, used, mirrors, vibrates, rng))
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


def _network(task: Task) -> Any:
    """Return an untrained network: a branch for each stream, and the layer that joins them."""
    torch = require_torch()
    nn = torch.nn

    class Network(nn.Module):  # type: ignore[name-defined]
        """Branches over the standardised rows (n, c f, t) of each stream, pooled and joined."""

        def __init__(self) -> None:
            super().__init__()
            self.branches = nn.ModuleList()
            self.of_samples = [not each.frame for each in task.columns]
            pooled = 0
            for each, branch in zip(task.columns, task.branches, strict=True):
                rows = branch.mean.size
                hidden = HIDDEN_SPECTRUM if each.frame else HIDDEN_SAMPLES
                self.branches.append(
                    nn.Sequential(
                        nn.Dropout1d(INPUT_DROPOUT) if each.frame else nn.Identity(),
                        nn.Conv1d(rows, hidden, 3, padding=1),
                        nn.BatchNorm1d(hidden),
                        nn.ReLU(),
                        nn.Dropout(DROPOUT / 2 if each.frame else 0.0),
                        nn.Conv1d(hidden, hidden, 3, padding=1),
                        nn.BatchNorm1d(hidden),
                        nn.ReLU(),
                    )
                )
                pooled += 2 * hidden + (0 if each.frame else 2 * rows)
            self.head = nn.Sequential(nn.Dropout(DROPOUT), nn.Linear(pooled, task.n_classes))

        def forward(self, streams: Sequence[Any]) -> Any:
            pooled = []
            for branch, rows, of_samples in zip(self.branches, streams, self.of_samples, strict=True):
                hidden = branch(rows)
                pooled += [hidden.mean(-1), hidden.amax(-1)]
                if of_samples:
                    pooled += [rows.mean(-1), rows.std(-1, unbiased=False)]
            return self.head(torch.cat(pooled, 1))

    return Network()


def weights_of(net: Any) -> MemberWeights:
    """Return the weights of a member; the normalisation of batches goes into the convolutions."""
    branches = [(*_folded(branch, 1), *_folded(branch, 5)) for branch in net.branches]
    weight, bias = (p.detach().numpy().copy() for p in (net.head[1].weight, net.head[1].bias))
    return MemberWeights(branches, weight, bias)


def _folded(branch: Any, place: int) -> tuple[Array, Array]:
    """Return weight and bias of a convolution with the normalisation after it: both are linear."""
    conv, norm = branch[place], branch[place + 1]
    weight, bias, gain, shift, mean, variance = (
        p.detach().numpy().astype(np.float64)
        for p in (conv.weight, conv.bias, norm.weight, norm.bias, norm.running_mean, norm.running_var)
    )
    scale = gain / np.sqrt(variance + norm.eps)
    return (
        (weight * scale[:, None, None]).astype(np.float32),
        (scale * (bias - mean) + shift).astype(np.float32),
    )
