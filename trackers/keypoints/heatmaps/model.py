"""A trained network of tip heatmaps on disk."""

from __future__ import annotations

from pathlib import Path

from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.learning.weights import load_weights, save_weights

FORMAT = "surgbench-tip-heatmaps-1"


def save_network(path: Path, network: HeatmapNetwork, settings: NetworkSettings) -> None:
    """Write a network, so that the file is whole or not there at all."""
    save_weights(path, network, FORMAT, settings)


def load_network(path: Path) -> tuple[HeatmapNetwork, NetworkSettings]:
    """Read a network.

    Returns:
        The network in single precision, ready to be asked (``eval``), and its size.

    Raises:
        SurgbenchError: There is no such file, it is damaged, or holds another network; one line.
    """
    network, settings = load_weights(path, FORMAT, "tip heatmaps", NetworkSettings, HeatmapNetwork)
    return network, settings
