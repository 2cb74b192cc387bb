"""What works the network out: PyTorch, or ONNX Runtime, which takes a third of the time on one core of a CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from surgbench.processes.torch_threads import one_thread
from surgbench.trackers.keypoints.heatmaps.fusion import without_norms
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings

EngineName = Literal["torch", "onnxruntime"]
# From a picture (s, s) float32, 1 in the mask, to the logits of its heat (s, s) float32.
Engine = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def make_engine(name: EngineName, network: HeatmapNetwork, settings: NetworkSettings, device: str = "cpu") -> Engine:
    """The network, ready to be asked on one thread.

    Args:
        name: Of the engine; on a GPU it is PyTorch in any case.
        network: Trained; not changed.
        settings: Its size.
        device: Where it is asked.
    """
    if name == "torch" or device != "cpu":
        return TorchEngine(network, device)
    return OnnxEngine(network, settings)


class TorchEngine:
    """PyTorch, without normalisations and with channels last.

    Args:
        network: Trained; not changed.
        device: Where it is asked.
    """

    def __init__(self, network: HeatmapNetwork, device: str = "cpu") -> None:
        self._network = without_norms(network).to(device, memory_format=torch.channels_last)
        self._device = device

    def __call__(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Logits of a picture."""
        with torch.inference_mode(), one_thread():
            one = torch.from_numpy(np.ascontiguousarray(picture)).to(self._device)[None, None]
            logits: NDArray[np.float32] = (
                self._network(one.contiguous(memory_format=torch.channels_last))[0].cpu().numpy()
            )
        return logits


class OnnxEngine:
    """ONNX Runtime in single precision; its logits are PyTorch's to a few last digits.

    Args:
        network: Trained; not changed.
        settings: Its size.
    """

    def __init__(self, network: HeatmapNetwork, settings: NetworkSettings) -> None:
        import onnxruntime

        from surgbench.trackers.keypoints.heatmaps.onnx_graph import onnx_graph

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        graph = onnx_graph(without_norms(network), settings)
        self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def __call__(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Logits of a picture."""
        (logits,) = self._session.run(None, {"picture": np.ascontiguousarray(picture)[None, None]})
        return np.asarray(logits[0, 0], dtype=np.float32)
