"""Teleoperation aligned to a view that moves (article, II-B): what the hand does to the right happens to the right.

"The article" is AutoCam (arXiv 2505.10398), "the code" its AlexandreBanks6/RCL_Autocam_Public, ``teleop_refactor.py``,
of which facts are used and no text. Where they differ:

- **When the view is taken anew.** The article updates it "when the MTM translates" and freezes it while the clutch is
  pressed. The code takes it when the camera is more than 10 mm from where it was frozen, whether the master moves or
  not, and also while the clutch is pressed. Here: the code's 10 mm, the article's clutch.
- **What is averaged.** The code averages the last 25 poses that it took, so that its view trails behind the camera, and
  begins with the tool's pose in place of the camera's. Here the last 25 poses that came are averaged.
- **Scale.** The code's default is 0.4, dVRK's 0.2; the article names none. Here 0.2.
- **Clutch.** The code locks the master's orientation while it is pressed, so that the tool need not turn on release.
  Here, if the master or the view turned nevertheless, the alignment takes it up: the tool does not turn.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from surgbench.config import NotNegative, Positive, Section
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, is_rigid, rigid_transform


class TeleoperationError(SurgbenchError):
    """A pose that is none, or a step before the first reset."""


class TeleoperationSettings(Section):
    """How the tool follows the hand.

    Attributes:
        scale: The tool's way by the master's.
        resample_beyond_m: The view is taken anew when the camera is farther than this from where it was taken.
        mean_of: The camera's pose is the mean over so many steps.
        turns_with_view: Where the view is taken anew the tool turns at once by as much as the view did (as published).
            Else the alignment takes that up, as it does at the release of the clutch: the tool turns by the hand alone.
    """

    scale: Positive = 0.2
    resample_beyond_m: NotNegative = 0.01
    mean_of: Annotated[int, Field(ge=1)] = 25
    turns_with_view: bool = True


class Teleoperation:
    """The tool's pose from the master's, as seen in the camera's picture.

    Poses are ``(4, 4)`` rigid transforms, metres: ``T_display_master`` of the master's grip before the console's
    display, ``T_world_camera`` and ``T_world_tool``. The axes of display and camera mean the same: where the camera's
    are OpenCV's (x right, y down, z forward), so are the display's. A picture that is shown turned needs a camera pose
    that is turned with it.

    With the view ``V``, a mean pose of the camera that is frozen (below), the tool's orientation and its step are

        R_world_tool = R_world_V  R_display_master  R_align
        p_world_tool += scale  R_world_V  (change of p_display_master)

    so that the tool turns and moves in the picture as the master does before the display. ``R_align`` is what makes the
    first equation true at the reset, and again when the clutch is released.

    When the view is taken anew, which it is in a step in which the mean camera is more than ``resample_beyond_m`` from
    ``V`` and the clutch is not pressed:

    - The tool's position does not change: only later movements of the hand take another direction.
    - The tool's orientation changes at once, in the world by ``R_world_V' R_world_V^T``; seen from the view it stays as
      it was. A camera that turned by 5 degrees within those 10 mm turns the tool by 5 degrees about its own origin with
      no movement of the hand. This is what the article's match of orientations asks for, and what the code does.
    - Without ``turns_with_view`` it does neither: only later movements and turns of the hand take other directions.
    - A camera that only turns in its place is never taken anew, here as in the code.

    While the clutch is pressed the tool rests and the view is frozen. In the step of the release the view is taken anew
    if the camera is far enough, then ``R_align`` is: the tool does not move, and later follows the master from there.

    Attributes:
        settings: As given.
        tool: ``(4, 4)`` T_world_tool, the last answer.
        view: ``(4, 4)`` T_world_V, frozen.
        align: ``(3, 3)`` R_align.
        clutched: Whether the clutch was pressed in the last step.
    """

    tool: FloatArray
    view: FloatArray
    align: FloatArray
    clutched: bool

    def __init__(self, settings: TeleoperationSettings | None = None) -> None:
        self.settings = settings or TeleoperationSettings()
        self._cameras = np.empty((self.settings.mean_of, 4, 4))
        self._taken = 0
        self._master: FloatArray | None = None

    def reset(self, T_display_master: FloatArray, T_world_camera: FloatArray, T_world_tool: FloatArray) -> None:
        """Begin: the tool stays where it is, whatever the master's pose.

        Raises:
            TeleoperationError: A pose is not a rigid transform.
        """
        master, camera = _pose(T_display_master, "master"), _pose(T_world_camera, "camera")
        self.tool = _pose(T_world_tool, "tool")
        self._taken = 0
        self._take(camera)
        self.view = camera
        self.clutched = False
        self._master = master
        self._align_to(master)

    def step(self, T_display_master: FloatArray, T_world_camera: FloatArray, clutch: bool = False) -> FloatArray:
        """Follow the master.

        Args:
            T_display_master: ``(4, 4)``.
            T_world_camera: ``(4, 4)``, as measured.
            clutch: Whether it is pressed.

        Returns:
            ``(4, 4)`` T_world_tool, where the tool shall go.

        Raises:
            TeleoperationError: A pose is not a rigid transform, and then nothing has changed; or there was no reset.
        """
        if self._master is None:
            raise TeleoperationError("teleoperation: step before reset")
        master, camera = _pose(T_display_master, "master"), _pose(T_world_camera, "camera")
        self._take(camera)
        before, self._master = self._master, master
        moved_m = master[:3, 3] - before[:3, 3]
        released = self.clutched and not clutch
        self.clutched = clutch
        if clutch:
            return self.tool.copy()
        view, self.view = self.view, self._next_view()
        if released:
            # What the hand did between the last pressed step and this one still belongs to the clutch.
            self._align_to(master)
            return self.tool.copy()
        if self.view is not view and not self.settings.turns_with_view:
            self._align_to(before)
        rotation = self.view[:3, :3]
        position_m = self.tool[:3, 3] + self.settings.scale * rotation @ moved_m
        self.tool = rigid_transform(rotation @ master[:3, :3] @ self.align, position_m)
        return self.tool.copy()

    def _align_to(self, master: FloatArray) -> None:
        self.align = _rotation(master[:3, :3].T @ self.view[:3, :3].T @ self.tool[:3, :3])

    def _take(self, camera: FloatArray) -> None:
        self._cameras[self._taken % self.settings.mean_of] = camera
        self._taken += 1

    def _next_view(self) -> FloatArray:
        """The mean camera where it is far from the frozen view, or else that view."""
        cameras = self._cameras[: self._taken]  # of a mean, the order does not matter
        position_m = cameras[:, :3, 3].mean(axis=0)
        if np.linalg.norm(position_m - self.view[:3, 3]) <= self.settings.resample_beyond_m:
            return self.view
        # The rotation with the least sum of squared differences: no sign to choose, as there is with quaternions.
        return rigid_transform(Rotation.from_matrix(cameras[:, :3, :3]).mean().as_matrix(), position_m)


def _rotation(matrix: FloatArray) -> FloatArray:
    """The nearest rotation: products of products stay rotations, however often the clutch is pressed."""
    return np.asarray(Rotation.from_matrix(matrix).as_matrix())


def _pose(transform: FloatArray, what: str) -> FloatArray:
    """A copy of a pose.

    Raises:
        TeleoperationError: It is not a rigid transform.
    """
    pose = np.array(transform, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not is_rigid(pose):
        raise TeleoperationError(f"teleoperation: pose of the {what} is not a rigid transform (4x4, finite)")
    return pose
