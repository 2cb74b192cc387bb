"""Cameras: pinhole and lens, seen from elsewhere, undistorted."""

from surgbench.camera.pinhole import NEAR_M, Camera, read_camera

__all__ = ["NEAR_M", "Camera", "read_camera"]
