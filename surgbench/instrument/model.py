"""An instrument ready for use: link tables, meshes in link frames, forward kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument.observability import observable
from surgbench.instrument.spec import JOINT_NAMES, InstrumentSpec, LinkPoint, Quantity
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, STATE_SIZE, JointLimits, Symmetry


@dataclass(frozen=True)
class LinkMesh:
    """A closed triangle mesh in its link's frame.

    Attributes:
        vertices_m: ``(V, 3)`` float64, rounded to float32 so that every reader sees the same numbers.
        faces: ``(F, 3)`` int32, counter-clockwise seen from outside.
    """

    vertices_m: FloatArray
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class Instrument:
    """One instrument: what its file says, and one closed mesh per link that has a body.

    Attributes:
        spec: The instrument file.
        meshes: Link name to mesh; links without a body are absent.
    """

    spec: InstrumentSpec
    meshes: dict[str, LinkMesh]

    @property
    def name(self) -> str:
        """The instrument's name, as in its file."""
        return self.spec.name

    @cached_property
    def search_limits(self) -> JointLimits:
        """Joint box that trackers search, radians."""
        return self._limits("search_rad")

    @cached_property
    def generate_limits(self) -> JointLimits:
        """Joint box that generated data stays in, radians."""
        return self._limits("generate_rad")

    def _limits(self, key: str) -> JointLimits:
        box = np.array([getattr(self.spec.joints[name], key) for name in JOINT_NAMES], dtype=np.float64)  # type: ignore[index]
        return JointLimits(box[:, 0], box[:, 1])

    @cached_property
    def observable(self) -> frozenset[Quantity]:
        """What can be seen of its state besides where it is and points: of ``roll`` and the joints' names."""
        transforms = self.link_transforms(np.zeros(STATE_SIZE))
        bodies = {
            name: mesh.vertices_m @ transforms[self.link_index[name], :3, :3].T
            + transforms[self.link_index[name], :3, 3]
            for name, mesh in self.meshes.items()
        }
        return observable(self.spec, bodies)

    @cached_property
    def observed(self) -> NDArray[np.bool_]:
        """``(9,)``: which components of a state can be seen; of the angles beta, the turn about the shaft, may not be.

        What cannot be seen is not scored, and null where states are written for others.
        """
        seen = np.ones(STATE_SIZE, dtype=bool)
        seen[BETA] = "roll" in self.observable
        seen[JOINTS] = [name in self.observable for name in JOINT_NAMES]
        return seen

    @cached_property
    def symmetry(self) -> Symmetry:
        """What turns it into one that looks the same: as its file says; else ``twin``, or ``axis`` if no roll is seen.

        ``twin``: half a turn about the shaft with both wrist joints reversed (:func:`surgbench.state.twin`); ``axis``:
        any turn about the shaft; ``none``.
        """
        if self.spec.symmetry is not None:
            return self.spec.symmetry
        return "twin" if "roll" in self.observable else "axis"

    @cached_property
    def tips(self) -> tuple[LinkPoint, LinkPoint]:
        """The two tips; of a tool with one, that one twice."""
        return self.spec.tips[0], self.spec.tips[-1]

    @property
    def has_two_tips(self) -> bool:
        """Whether its tips are two; else both of :attr:`tips` are the same point."""
        return len(self.spec.tips) == 2

    @cached_property
    def without_shaft(self) -> Instrument:
        """Its wrist and jaws: the same without the mesh of its first link."""
        shaft = self.spec.links[0].name
        return Instrument(self.spec, {name: mesh for name, mesh in self.meshes.items() if name != shaft})

    @cached_property
    def link_index(self) -> dict[str, int]:
        """Link name to its place in the chain."""
        return {link.name: index for index, link in enumerate(self.spec.links)}

    @cached_property
    def parents(self) -> NDArray[np.int32]:
        """``(L,)`` index of each link's parent, -1 for the first."""
        parents = [-1 if link.parent is None else self.link_index[link.parent] for link in self.spec.links]
        return np.array(parents, np.int32)

    @cached_property
    def fixed_transforms(self) -> FloatArray:
        """``(L, 4, 4)``: the part ``Rx(alpha) Tx(a) Tz(d)`` of each link's transform that no joint moves."""
        transforms = np.tile(np.eye(4), (len(self.spec.links), 1, 1))
        for transform, link in zip(transforms, self.spec.links, strict=True):
            c, s = np.cos(link.alpha_rad), np.sin(link.alpha_rad)
            transform[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
            # Rz and Tz commute, so that Tz(d) may stand before Rz(theta).
            transform[:3, 3] = [link.a_m, -s * link.d_m, c * link.d_m]
        return transforms

    @cached_property
    def theta_offsets_rad(self) -> FloatArray:
        """``(L,)`` constant part of each link's theta."""
        return np.array([link.theta_offset_rad for link in self.spec.links])

    @cached_property
    def theta_gains(self) -> FloatArray:
        """``(L, 3)``: ``theta = theta_offsets_rad + theta_gains @ [q1, q2, q3]``."""
        gains = np.zeros((len(self.spec.links), 3))
        for row, link in zip(gains, self.spec.links, strict=True):
            if link.joint is not None:
                row[JOINT_NAMES.index(link.joint)] = link.joint_scale
        return gains

    def link_transforms(self, states: FloatArray) -> FloatArray:
        """Forward kinematics: where every link is in the camera frame.

        Args:
            states: ``(..., 9)``.

        Returns:
            ``(..., L, 4, 4)`` T_cam_link, links in the file's order.

        Example:
            The wrist-yaw axis is 9.1 mm beyond the wrist-pitch axis, as seen from the camera here.

            >>> import numpy as np
            >>> from surgbench.instrument import load_instrument
            >>> driver = load_instrument("large_needle_driver")
            >>> T_cam_link = driver.link_transforms(np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0]))
            >>> T_cam_link[driver.link_index["yaw"], 2, 3].round(6).item()  # metres along the optical axis
            0.1391
        """
        states = np.asarray(states, dtype=np.float64)
        lead = states.shape[:-1]
        base = np.zeros((*lead, 4, 4))
        base[..., :3, :3] = look_at_rotation(states[..., ANGLES])
        base[..., :3, 3] = states[..., POSITION]
        base[..., 3, 3] = 1.0
        theta = self.theta_offsets_rad + states[..., JOINTS] @ self.theta_gains.T
        cos, sin = np.cos(theta), np.sin(theta)
        turns = np.zeros((*theta.shape, 4, 4))
        turns[..., 0, 0] = turns[..., 1, 1] = cos
        turns[..., 1, 0], turns[..., 0, 1] = sin, -sin
        turns[..., 2, 2] = turns[..., 3, 3] = 1.0
        transforms = np.empty_like(turns)
        for index, parent in enumerate(self.parents.tolist()):
            above = base if parent < 0 else transforms[..., parent, :, :]
            transforms[..., index, :, :] = above @ self.fixed_transforms[index] @ turns[..., index, :, :]
        return transforms

    def points_cam(self, states: FloatArray, points: tuple[LinkPoint, ...]) -> FloatArray:
        """Where points fixed to links are in the camera frame.

        Args:
            states: ``(..., 9)``.
            points: P points.

        Returns:
            ``(..., P, 3)`` metres.

        Example:
            The shaft, 1 cm above the wrist:

            >>> import numpy as np
            >>> from surgbench.instrument import load_instrument
            >>> from surgbench.instrument.spec import LinkPoint
            >>> driver = load_instrument("large_needle_driver")
            >>> point = LinkPoint(link="shaft", point_m=(0.0, 0.0, -0.01))
            >>> driver.points_cam(np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0]), (point,)).round(6)
            array([[0.  , 0.  , 0.12]])
        """
        transforms = self.link_transforms(states)
        placed = []
        for point in points:
            transform = transforms[..., self.link_index[point.link], :, :]
            placed.append(transform[..., :3, :3] @ np.array(point.point_m) + transform[..., :3, 3])
        return np.stack(placed, axis=-2)

    def tips_cam(self, states: FloatArray) -> FloatArray:
        """The two tips of :attr:`tips` (keypoints of eq. 8) in the camera frame, ``(..., 2, 3)`` metres.

        Example:
            Straight ahead, jaws closed, then opened by 30 degrees each; they open along y:

            >>> import numpy as np
            >>> from surgbench.instrument import load_instrument
            >>> driver = load_instrument("large_needle_driver")
            >>> states = np.array([[0, 0, 0, 0, 0, 0.13, 0, 0, half_jaw] for half_jaw in (0, np.pi / 6)])
            >>> (driver.tips_cam(states)[:, :, 1:] * 1000).round(1)  # y and z of both, millimetres
            array([[[  0.4, 148.1],
                    [ -0.4, 148.1]],
            <BLANKLINE>
                   [[  4.8, 146.7],
                    [ -4.8, 146.7]]])
        """
        return self.points_cam(states, self.tips)

    def skeleton_cam(self, states: FloatArray) -> FloatArray:
        """End points of the bones drawn in overlays, ``(..., B, 2, 3)`` metres."""
        flat = self.points_cam(states, tuple(point for bone in self.spec.skeleton for point in bone))
        return flat.reshape(*flat.shape[:-2], -1, 2, 3)
