"""A trained network on disk: its weights in safetensors, which runs no code when read, its size in the header."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from surgbench.config import parse_model
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.files import write_atomic
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings

FORMAT = "surgbench-tip-heatmaps-1"
WEIGHTS = "weights.safetensors"


def save_network(path: Path, network: HeatmapNetwork, settings: NetworkSettings) -> None:
    """Write a network, its weights in half precision, so that the file is whole or not there at all."""
    tensors = {
        name: tensor.detach().to("cpu", torch.float16 if tensor.is_floating_point() else tensor.dtype).contiguous()
        for name, tensor in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    # One key: several would be in any order, and the same network not always the same bytes.
    write_atomic(path, save(tensors, {FORMAT: settings.model_dump_json()}))


def read_tensors(path: Path, device: str = "cpu") -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Header and tensors of a safetensors file.

    Raises:
        SafetensorError: It is damaged.
        OSError: It cannot be read.
    """
    with safe_open(path, framework="pt", device=device) as file:
        return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dictionary)


def load_network(path: Path) -> tuple[HeatmapNetwork, NetworkSettings]:
    """Read a network.

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
    if FORMAT not in header:
        raise SurgbenchError(f"{path}: not a model of tip heatmaps (its header has no '{FORMAT}')")
    try:
        settings = parse_model(NetworkSettings, json.loads(header[FORMAT]), "header")
    except (ConfigError, json.JSONDecodeError, RecursionError) as error:
        raise SurgbenchError(f"{path}: {error}") from None
    network = HeatmapNetwork(settings)
    problem = _mismatch(network, tensors)
    if problem:
        raise SurgbenchError(f"{path}: the weights are not those of a network of width {settings.width}: {problem}")
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
