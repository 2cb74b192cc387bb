"""Silhouette renderers by name: ours, and what a user would reach for instead. One file each."""

from surgbench.comparison.peers.base import Contestant, Peer
from surgbench.comparison.peers.embreex import Embreex
from surgbench.comparison.peers.mitsuba import MitsubaLLVM, MitsubaScalar
from surgbench.comparison.peers.moderngl import ModernGL
from surgbench.comparison.peers.open3d import Open3D
from surgbench.comparison.peers.opencv import OpenCV
from surgbench.comparison.peers.ours import SilhouetteEngine
from surgbench.comparison.peers.scanline import Scanline

PEERS: dict[str, type[Peer]] = {
    peer.name: peer for peer in (Scanline, ModernGL, OpenCV, Open3D, MitsubaLLVM, MitsubaScalar, Embreex)
}

__all__ = ["PEERS", "Contestant", "Peer", "SilhouetteEngine"]
