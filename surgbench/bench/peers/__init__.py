"""Silhouette renderers by name: ours, and what a user would reach for instead. One file each."""

from surgbench.bench.peers.base import Contestant, Peer
from surgbench.bench.peers.embreex import Embreex
from surgbench.bench.peers.mitsuba import MitsubaLLVM, MitsubaScalar
from surgbench.bench.peers.moderngl import ModernGL
from surgbench.bench.peers.open3d import Open3D
from surgbench.bench.peers.opencv import OpenCV
from surgbench.bench.peers.ours import SilhouetteEngine
from surgbench.bench.peers.scanline import Scanline

PEERS: dict[str, type[Peer]] = {
    peer.name: peer for peer in (Scanline, ModernGL, OpenCV, Open3D, MitsubaLLVM, MitsubaScalar, Embreex)
}

__all__ = ["PEERS", "Contestant", "Peer", "SilhouetteEngine"]
