"""The course of a training; an interrupted one goes on where its last epoch ended.

Everything random comes from the seed and the number of the epoch, so that a resumed training sees what an uninterrupted
one would have seen.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from surgbench.config import Count, Positive, Section
from surgbench.errors import SurgbenchError
from surgbench.files import sha256_file, write_atomic
from surgbench.randomness import generator, seed_from
from surgbench.report.field import Field as Column
from surgbench.report.field import count, number
from surgbench.report.frame import csv_text, to_frame
from surgbench.trackers.learning.checkpoint import Progress, keep, resume

STATE = "training.safetensors"
LOG = "log.csv"
# A narrower network is trained with its channels first: the gradient of a short cut's weights, a 1 x 1 convolution of
# stride 2, comes out wrong in oneDNN with channels last and fewer than a vector register holds (8 with AVX2, 16 with
# AVX-512), and it writes where it must not (https://github.com/uxlfoundation/oneDNN/issues/6035).
LEAST_CHANNELS_LAST = 16


class CourseSettings(Section):
    """How any network is trained.

    Attributes:
        epochs: At most so many passes over what is learnt.
        patience: It stops after so many epochs in which the validation loss did not fall.
        batch: Examples a step.
        learning_rate: Its peak; it rises at first and falls along a cosine (Loshchilov and Hutter, ICLR
            2017).
        warm_up: Share of the steps in which it rises.
        weight_decay: Of AdamW (Loshchilov and Hutter, ICLR 2019).
    """

    epochs: Count = 14
    patience: Count = 8
    batch: Count = 64
    learning_rate: Positive = 1.2e-3
    warm_up: Annotated[float, Field(ge=0, le=1)] = 0.1
    weight_decay: Annotated[float, Field(ge=0)] = 0.02


class Examples(Protocol):
    """What is learnt."""

    def __len__(self) -> int:
        """How many there are."""
        ...


Learnt = TypeVar("Learnt", bound=Examples)


def log_fields(*measures: str) -> tuple[Column, ...]:
    """Columns of a training's log, with those of what is measured on the validation examples."""
    losses = number("learning_rate", "training_loss", "validation_loss", *measures)
    return (*count("epoch"), *losses, *count("seconds"))


class Course(Generic[Learnt]):
    """One training, in a folder; what is learnt, and how, is its subclass's to say.

    Args:
        folder: Where the best weights so far, the log, and what a resumed training needs are written after every epoch.
        network: Size of the network, with a ``width``.
        settings: How it is trained.
        seed: Of the first weights, and of the order and looks of the examples.
        device: ``"cpu"`` or ``"cuda"``.
        identity: What else the result depends on, as JSON can hold it: a folder with another one is not gone on with.
        start: A model of the same size whose weights are the first; random ones unless told.

    Raises:
        SurgbenchError: The folder holds a training with other settings, or a damaged one, or the start is no model of
            this size; one line.
    """

    measures: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        folder: Path,
        network: Any,
        settings: CourseSettings,
        seed: int,
        device: str,
        identity: Mapping[str, Any],
        start: Path | None = None,
    ) -> None:
        self._size = network
        self._folder, self._seed, self._device = folder, seed, device
        self._settings: Any = settings
        whole = {"training": settings.model_dump(), "seed": seed, "network": network.model_dump(), **identity}
        if start is not None:
            whole["start"] = sha256_file(start)
        self._identity = json.dumps(whole, sort_keys=True)
        with torch.random.fork_rng():
            torch.manual_seed(seed_from(purpose="first weights", seed=seed) % 2**63)
            self._network = self._make()
        if start is not None:
            self._network.load_state_dict(self._first_weights(start).state_dict())
        last = network.width >= LEAST_CHANNELS_LAST
        self._format = torch.channels_last if last else torch.contiguous_format
        self._network.to(device, memory_format=self._format)
        # The same steps in the same order whatever the learning rate is now: it is set before each.
        self._optimiser = torch.optim.AdamW(self._network.parameters(), lr=0.0, weight_decay=settings.weight_decay)
        self._state = Progress()
        self._log: list[dict[str, Any]] = []
        if (folder / STATE).exists():
            self._state, self._log = resume(folder / STATE, self._identity, self._network, self._optimiser)

    @property
    def epoch(self) -> int:
        """How many epochs are done."""
        return int(self._state.epoch)

    @property
    def done(self) -> bool:
        """Whether all epochs are done, or the validation loss has not fallen for too long."""
        waited = self._state.epoch - 1 - self._state.best_epoch
        return bool(self._state.epoch >= self._settings.epochs or waited >= self._settings.patience)

    def run(
        self, training: Learnt, validation: Learnt, progress: Callable[[float], None], say: Callable[[str], None]
    ) -> None:
        """Train to the end.

        Args:
            training: What is learnt.
            validation: What says when to stop, and which epoch's weights are kept.
            progress: Told the share of an epoch that was done, so that all add up to the number of epochs.
            say: Told a line after every epoch.

        Raises:
            SurgbenchError: The loss is no longer finite.
        """
        while not self.done:
            begin = time.monotonic()
            rate, loss = self._learn(training, progress)
            self._network.eval()
            with torch.inference_mode():
                validation_loss, found = self._validate(validation)
            if not np.isfinite(loss + validation_loss):
                raise SurgbenchError(
                    f"training diverged in epoch {self._state.epoch + 1}: the loss is not finite; lower learning_rate"
                )
            row = {
                "epoch": self._state.epoch,
                "learning_rate": float(f"{rate:.3g}"),
                "training_loss": round(loss, 4),
                "validation_loss": round(validation_loss, 4),
                **{name: _short(found[name]) for name in self.measures},
                "seconds": round(time.monotonic() - begin),
            }
            self._log.append(row)
            if validation_loss < self._state.best_loss:
                self._state.best_loss, self._state.best_epoch = validation_loss, self._state.epoch
                self._save()
            self._state.epoch += 1
            write_atomic(self._folder / LOG, csv_text(to_frame(self._log, log_fields(*self.measures))).encode())
            keep(self._folder / STATE, self._identity, self._network, self._optimiser, self._state, self._log)
            measured = self._words(row)
            say(f"epoch {self._state.epoch}: loss {loss:.3f}, validation {validation_loss:.3f}, {measured}")

    def _batch_loss(self, examples: Learnt, chosen: Any, rng: np.random.Generator) -> Tensor:
        """The mean loss of chosen examples, each in a look of its own."""
        raise NotImplementedError

    def _validate(self, examples: Learnt) -> tuple[float, dict[str, float | None]]:
        """The mean loss, and the measures; the network is in ``eval`` mode."""
        raise NotImplementedError

    def _make(self) -> Any:
        """The network, its first weights drawn from PyTorch's global generator."""
        raise NotImplementedError

    def _load(self, path: Path) -> tuple[nn.Module, Any]:
        """A network from a file, and its size."""
        raise NotImplementedError

    def _first_weights(self, path: Path) -> nn.Module:
        weights, size = self._load(path)
        if size != self._size:
            raise SurgbenchError(f"{path}: a network of {size}, not of {self._size}")
        return weights

    def _save(self) -> None:
        """Write the weights, which are the best so far."""
        raise NotImplementedError

    def _repeats(self) -> int:
        """How often an epoch shows each example."""
        return 1

    def _words(self, row: Mapping[str, Any]) -> str:
        """The measures, as they are told after an epoch."""
        raise NotImplementedError

    def _batches(self, examples: Learnt) -> Iterator[Any]:
        """All examples in their order, a batch at a time."""
        order = np.arange(len(examples))
        yield from np.split(order, range(self._settings.batch, len(order), self._settings.batch))

    def _learn(self, examples: Learnt, progress: Callable[[float], None]) -> tuple[float, float]:
        """One pass; the last learning rate and the mean loss."""
        settings = self._settings
        rng = generator(purpose="epoch", seed=self._seed, epoch=self._state.epoch)
        order = np.concatenate([rng.permutation(len(examples)) for _ in range(self._repeats())])
        steps = max(len(order) // settings.batch, 1)
        self._network.train()
        total, rate = 0.0, 0.0
        for step in range(steps):
            rate = self._rate((self._state.epoch * steps + step) / (settings.epochs * steps))
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            loss = self._batch_loss(examples, order[step * settings.batch : (step + 1) * settings.batch], rng)
            self._optimiser.zero_grad()
            loss.backward()
            self._optimiser.step()
            total += float(loss.detach())
            progress(1.0 / steps)
        return rate, total / steps

    def _rate(self, share: float) -> float:
        """The learning rate when this share of all steps is done."""
        warm_up = self._settings.warm_up
        if share < warm_up:
            return float(self._settings.learning_rate * (0.04 + 0.96 * share / warm_up))
        turn = np.pi * (share - warm_up) / max(1.0 - warm_up, 1e-9)
        return float(self._settings.learning_rate * 0.5 * (1.0 + float(np.cos(turn))))


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
