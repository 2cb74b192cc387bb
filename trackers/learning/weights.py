"""A trained network on disk: its weights in safetensors, which runs no code when read, its size in the header."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from surgbench.config import Section, parse_model
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.files import write_atomic

WEIGHTS = "weights.safetensors"

Size = TypeVar("Size", bound=Section)
Network = TypeVar("Network", bound=nn.Module)


def save_weights(path: Path, network: nn.Module, form: str, settings: Section) -> None:
    """Write a network, its weights in half precision, so that the file is whole or not there at all.

    Args:
        path: The file.
        network: Whose weights are written.
        form: Name of what the file holds: the header's only key.
        settings: Size of the network, its value.
    """
    tensors = {
        name: tensor.detach().to("cpu", torch.float16 if tensor.is_floating_point() else tensor.dtype).contiguous()
        for name, tensor in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    # One key: several would be in any order, and the same network not always the same bytes.
    write_atomic(path, save(tensors, {form: settings.model_dump_json()}))


def read_tensors(path: Path, device: str = "cpu") -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Header and tensors of a safetensors file.

    Raises:
        SafetensorError: It is damaged.
        OSError: It cannot be read.
    """
    with safe_open(path, framework="pt", device=device) as file:
        return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dictionary)


def load_weights(
    path: Path, form: str, what: str, size: type[Size], make: Callable[[Size], Network]
) -> tuple[Network, Size]:
    """Read a network.

    Args:
        path: The file.
        form: What its header has to name.
        what: The same in words, for the message.
        size: The settings in its header, with a ``width``.
        make: A network of such settings.

    Returns:
        The network in single precision, ready to be asked (``eval``), and its size.

    Raises:
        SurgbenchError: There is no such file, it is damaged, or holds another network; one line.
    """
    try:
        header, tensors = read_tensors(path)
    except (SafetensorError, ValueError) as error:
        raise SurgbenchError(f"{path}: no readable safetensors file ({' '.join(str(error).split())})") from None
    except OSError as error:
        raise SurgbenchError(f"{path}: model cannot be read ({(error.strerror or str(error)).lower()})") from None
    if form not in header:
        raise SurgbenchError(f"{path}: not a model of {what} (its header has no '{form}')")
    try:
        settings = parse_model(size, json.loads(header[form]), "header")
    except (ConfigError, json.JSONDecodeError, RecursionError) as error:
        raise SurgbenchError(f"{path}: {error}") from None
    network = make(settings)
    problem = _mismatch(network, tensors)
    if problem:
        width = settings.model_dump()["width"]
        raise SurgbenchError(f"{path}: the weights are not those of a network of width {width}: {problem}")
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()}, strict=False)
    return network.eval(), settings


def _mismatch(network: nn.Module, tensors: dict[str, torch.Tensor]) -> str | None:
    """The first thing that differs between what the network needs and what there is, in words."""
    needed = {
        name: tuple(tensor.shape)
        for name, tensor in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    for name, shape in needed.items():
        if name not in tensors:
            return f"'{name}' is missing"
        if tuple(tensors[name].shape) != shape:
            return f"'{name}' is {tuple(tensors[name].shape)}, not {shape}"
        if not tensors[name].is_floating_point():
            return f"'{name}' is of {tensors[name].dtype}"
        if not torch.isfinite(tensors[name].float()).all():
            return f"'{name}' is not finite"
    unknown = sorted(set(tensors) - set(needed))
    return f"'{unknown[0]}' is no part of it" if unknown else None
