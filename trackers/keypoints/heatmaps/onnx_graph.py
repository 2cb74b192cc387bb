"""The network as an ONNX graph, node by node: no exporter is needed, and the weights stay in safetensors alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, checker, helper, numpy_helper
from torch import nn

from surgbench.trackers.keypoints.heatmaps.network import BasicBlock, HeatmapNetwork, NetworkSettings

# Versions that every runtime since 2022 reads.
OPSET, IR_VERSION = 17, 8


def onnx_graph(network: HeatmapNetwork, settings: NetworkSettings) -> bytes:
    """The model for one picture: input ``picture``, output ``logits``, both ``(1, 1, s, s)`` float32.

    Args:
        network: Without normalisations (:func:`~surgbench.trackers.keypoints.heatmaps.fusion.without_norms`).
        settings: Its size.
    """
    graph = _Graph()
    features = [graph.convolve("picture", network.stem[0], rectified=True)]
    before = graph.add("MaxPool", [features[0]], kernel_shape=[3, 3], strides=[2, 2], pads=[1] * 4)
    for stage in network.stages:
        for block in stage:
            before = graph.block(before, block)
        features.append(before)
    merged = graph.convolve(features[-1], network.lateral[-1])
    for lateral, feature in zip(reversed(list(network.lateral)[:-1]), reversed(features[:-1]), strict=True):
        merged = graph.add("Add", [graph.doubled(merged), graph.convolve(feature, lateral)])
    heat = graph.convolve(graph.convolve(merged, network.smooth, rectified=True), network.heat)
    graph.add("DepthToSpace", [heat], name="logits", blocksize=2, mode="CRD")
    return graph.model([1, 1, settings.input_px, settings.input_px])


class _Graph:
    """Nodes and constants so far. Methods return the name of what they add."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def add(self, kind: str, inputs: list[str], *, name: str | None = None, **attributes: Any) -> str:
        name = name or f"{kind}-{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return name

    def constant(self, values: NDArray[np.float32]) -> str:
        name = f"constant-{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def convolve(self, of: str, convolution: Any, *, rectified: bool = False) -> str:
        weights = [self.constant(part.detach().cpu().numpy()) for part in (convolution.weight, convolution.bias)]
        pads = [*convolution.padding] * 2
        found = self.add("Conv", [of, *weights], strides=[*convolution.stride], pads=pads)
        return self.add("Relu", [found]) if rectified else found

    def block(self, of: str, block: BasicBlock) -> str:
        inner = self.convolve(self.convolve(of, block.first, rectified=True), block.second)
        short_cut = of if isinstance(block.short_cut, nn.Identity) else self.convolve(of, block.short_cut)
        return self.add("Relu", [self.add("Add", [inner, short_cut])])

    def doubled(self, of: str) -> str:
        scales = self.constant(np.array([1, 1, 2, 2], dtype=np.float32))
        how = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return self.add("Resize", [of, "", scales], mode="nearest", **how)

    def model(self, shape: list[int]) -> bytes:
        ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("picture", "logits")]
        graph = helper.make_graph(self._nodes, "tip-heatmaps", ends[:1], ends[1:], self._constants)
        opset = helper.make_opsetid("", OPSET)
        model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION)
        checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content
