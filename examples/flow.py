"""A tracker that looks at images: where points of the instruments went since the last frame (Lucas and Kanade, 1981).

Example: surgbench run --dataset data/endoscope --arms dual --tracker examples/flow.py:FlowTracker
"""

import cv2
import numpy as np
from scipy.optimize import least_squares

from surgbench.contract import Estimate, InstrumentTracker
from surgbench.state import clip_joints, split_arms

POINTS, FEWEST, ASTRAY_PX, REACH_M = 60, 15, 0.7, 0.06
# A change of the state by this much (rad, m, rad) weighs as much as one point that is a pixel off.
STEP = np.repeat([0.1, 0.005, 0.2], 3)


class FlowTracker(InstrumentTracker):
    """Each arm is where the points of its surface have gone in the image; masks it does not look at."""

    name, one_view, reads_images = "flow", True, True

    def reset(self, scene, state, rng):
        """Draw points of every link's surface, each with the direction that it faces."""
        self._arms, self._limits, self._state, self._before = scene.instruments, scene.joint_limits, state, None
        self._links = [[arm.link_index[name] for name in arm.meshes] for arm in self._arms]
        self._points = [np.stack([surface(mesh, rng) for mesh in arm.meshes.values()], axis=1) for arm in self._arms]

    def step(self, observation):
        """Look where the last frame's points are now, and move the arms there."""
        view = observation.views[0]
        image, found, states = view.image(), [], []
        if image is None:
            return Estimate(observation.start, lost=True)
        before, self._before = self._before, cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        if before is None:  # the first frame: there the state is known
            return Estimate(self._state)
        for number, state in enumerate(split_arms(self._state)):
            at, towards = self._placed(number, state)
            pixels = view.camera.project(at)
            shown = view.camera.contains(pixels, 5.0) & ((at * towards).sum(axis=-1) < 0)
            now = flow(before, self._before, pixels[shown])
            steady = np.linalg.norm(flow(self._before, before, now) - pixels[shown], axis=1) < ASTRAY_PX
            shown[shown] = steady

            def residuals(step, number=number, state=state, shown=shown, now=now[steady]):
                there = view.camera.project(self._placed(number, state + step * STEP)[0][shown])
                return np.append(np.nan_to_num(there - now, nan=1e3), step)

            found.append(shown.sum() >= FEWEST)
            step = least_squares(residuals, np.zeros(9), loss="soft_l1").x if found[-1] else 0.0
            states.append(state + step * STEP)
        self._state = clip_joints(np.concatenate(states), self._limits)
        return Estimate(self._state, lost=not all(found))

    def _placed(self, number, state):
        """``(links, points, 3)`` places of an arm's points in the camera's frame, and directions."""
        T = self._arms[number].link_transforms(state)[self._links[number]]
        places, directions = self._points[number] @ T[:, :3, :3].transpose(0, 2, 1)
        return places + T[:, None, :3, 3], directions


def surface(mesh, rng):
    """``(2, points, 3)`` places on a mesh, evenly by area, and their normals; of a shaft, near its end."""
    corners = mesh.vertices_m[mesh.faces].clip(min=-REACH_M)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    face = rng.choice(len(area), POINTS, p=area / area.sum())
    return np.stack([np.einsum("pc,pcx->px", rng.dirichlet(np.ones(3), POINTS), corners[face]), normals[face]])


def flow(first, second, pixels):
    """Where pixels of the first picture are in the second."""
    start = np.ascontiguousarray(pixels, np.float32)
    return cv2.calcOpticalFlowPyrLK(first, second, start, None, winSize=(15, 15))[0] if len(start) else start
