"""What an interrupted training needs to go on: a safetensors file, so that nothing is pickled."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor, nn
from torch.optim import Optimizer

from surgbench.errors import SurgbenchError
from surgbench.files import write_atomic
from surgbench.trackers.learning.weights import read_tensors

Log = list[dict[str, Any]]


@dataclass
class Progress:
    """How far a training has come.

    Attributes:
        epoch: How many epochs are done.
        best_loss: Least validation loss so far.
        best_epoch: When that was, from 0.
    """

    epoch: int = 0
    best_loss: float = float("inf")
    best_epoch: int = -1


def keep(path: Path, identity: str, network: nn.Module, optimiser: Optimizer, progress: Progress, log: Log) -> None:
    """Write everything that a resumed training needs, so that the file is whole or not there at all.

    Args:
        path: The file.
        identity: What the result depends on, as JSON.
        network: Its weights and the statistics of its normalisations are kept.
        optimiser: Its moments are kept.
        progress: How far the training has come.
        log: A row for each epoch.
    """
    tensors = {f"network.{name}": tensor.contiguous() for name, tensor in network.state_dict().items()}
    for number, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": value.contiguous() for name, value in moments.items()}
    header = {"identity": identity, "progress": json.dumps(asdict(progress)), "log": json.dumps(log)}
    write_atomic(path, save({name: tensor.cpu() for name, tensor in tensors.items()}, header))


def resume(path: Path, identity: str, network: nn.Module, optimiser: Optimizer) -> tuple[Progress, Log]:
    """Read what :func:`keep` wrote into a network and its optimiser, which must be made as they were then.

    Raises:
        SurgbenchError: The file is damaged, or of a training with another identity; one line.
    """
    try:
        header, tensors = read_tensors(path)
        if header["identity"] != identity:
            raise SurgbenchError(
                f"{path.parent}: holds a training with other settings; give another folder, or remove it"
            )
        progress, log = Progress(**json.loads(header["progress"])), json.loads(header["log"])
        network.load_state_dict(_part(tensors, "network."))
        parameters = dict(enumerate(parameter for group in optimiser.param_groups for parameter in group["params"]))
        moments: dict[int, dict[str, Tensor]] = {}
        for name, tensor in _part(tensors, "optimiser.").items():
            number, _, key = name.partition(".")
            # A file knows no memory format: with their parameter's, the moments take the kernels that they would have
            # taken. The count of steps stays where it is, on the CPU.
            laid = tensor if key == "step" else torch.empty_like(parameters[int(number)]).copy_(tensor)
            moments.setdefault(int(number), {})[key] = laid
        optimiser.load_state_dict({**optimiser.state_dict(), "state": moments})
    except (SafetensorError, KeyError, ValueError, RuntimeError, TypeError) as error:
        words = " ".join(str(error).split())
        raise SurgbenchError(f"{path}: damaged ({words}); remove it to begin anew") from None
    return progress, log


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
