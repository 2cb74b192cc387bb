"""Cameras: pinhole and lens, seen from elsewhere, undistorted, read from files."""

from surgbench.camera.files import read_camera
from surgbench.camera.pinhole import NEAR_M, Camera

__all__ = ["NEAR_M", "Camera", "read_camera"]
