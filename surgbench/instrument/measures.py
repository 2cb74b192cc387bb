"""What a person with a ruler reads off an instrument's body, and whether it looks the same when turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument.model import Instrument
from surgbench.instrument.spec import Link
from surgbench.randomness import generator
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import BETA, JOINTS, STATE_SIZE, twin

# Looks the same: its silhouettes without the shaft, and their turned ones, overlap by this on average.
SAME_IOU = 0.95
_CAMERA = Camera(width=320, height=240, fx=800, fy=800, cx=160, cy=120)
_AWAY_M = 0.16


@dataclass(frozen=True)
class JawMeasures:
    """Of one link that bears a tip, metres.

    Attributes:
        link: Its name.
        length_m: From its joint's axis to the end of the body.
        width_m: Along that axis, half-way to the tip.
        thickness_m: Across it, there.
    """

    link: str
    length_m: float
    width_m: float
    thickness_m: float


def shaft_diameter_m(instrument: Instrument) -> float | None:
    """Of the first link's body, its mean width seen from all around; ``None`` where it has none."""
    mesh = instrument.meshes.get(instrument.spec.links[0].name)
    # A convex outline's mean width is its perimeter over pi (Cauchy).
    return None if mesh is None else float(ConvexHull(mesh.vertices_m[:, :2]).area / np.pi)


def wrist_length_m(instrument: Instrument) -> float | None:
    """From the pitch to the yaw axis; ``None`` where it has no wrist."""
    yaw = next((link for link in instrument.spec.links if link.joint == "wrist_yaw"), None)
    if yaw is None:
        return None
    transforms = instrument.link_transforms(np.zeros(STATE_SIZE))
    return float(np.linalg.norm(transforms[instrument.link_index[yaw.name], :3, 3]))


def jaw_measures(instrument: Instrument) -> list[JawMeasures]:
    """Of each link that bears a tip and turns about an axis."""
    measured = {}
    for tip in instrument.spec.tips:
        link = _link(instrument, tip.link)
        mesh = instrument.meshes.get(tip.link)
        if mesh is None or link.joint is None:
            continue
        # The axis is z of the link's frame; the jaw runs from it to the tip.
        along = np.array([*tip.point_m[:2], 0.0])
        reach = float(np.linalg.norm(along))
        if reach == 0:
            continue
        along /= reach
        cut = _cut(mesh.vertices_m[mesh.faces], along, reach / 2)
        if len(cut) == 0:
            continue
        across = cut @ np.array([-along[1], along[0], 0.0])
        measured[tip.link] = JawMeasures(
            tip.link, float((mesh.vertices_m @ along).max()), float(np.ptp(cut[:, 2])), float(np.ptp(across))
        )
    return list(measured.values())


def _cut(corners: FloatArray, along: FloatArray, at: float) -> FloatArray:
    """Where a plane cuts the edges of triangles ``(F, 3, 3)``: ``(n, 3)``."""
    start, end = corners.reshape(-1, 3), corners[:, [1, 2, 0]].reshape(-1, 3)
    before, after = start @ along - at, end @ along - at
    crosses = (before < 0) != (after < 0)
    share = before[crosses] / (before[crosses] - after[crosses])
    points: FloatArray = start[crosses] + share[:, None] * (end[crosses] - start[crosses])
    return points


def _link(instrument: Instrument, name: str) -> Link:
    return instrument.spec.links[instrument.link_index[name]]


def triangles(instrument: Instrument) -> int:
    """Of all its bodies; the time to score a candidate grows with them."""
    return sum(len(mesh.faces) for mesh in instrument.meshes.values())


def summary(instrument: Instrument) -> str:
    """Its measures in a line."""
    shaft, wrist, jaws = shaft_diameter_m(instrument), wrist_length_m(instrument), jaw_measures(instrument)
    words = []
    if shaft is not None:
        words.append(f"shaft {1000 * shaft:.1f} mm")
    words.append("no wrist" if wrist is None else f"wrist {1000 * wrist:.1f} mm")
    if jaws:
        what = "jaws" if "jaw" in instrument.observable else "end"
        words.append(f"{what} {1000 * max(jaw.length_m for jaw in jaws):.1f} mm")
    return ", ".join([*words, f"symmetry {instrument.symmetry}"])


def sample_states(instrument: Instrument, count: int) -> FloatArray:
    """Poses from all around, joints uniform within the generate limits, ``(count, 9)``; always the same."""
    rng = generator(benchmark="instrument-symmetry", seed=0)
    states = np.zeros((count, STATE_SIZE))
    states[:, 0] = rng.uniform(-1.0, 1.0, count)
    states[:, BETA] = rng.uniform(-np.pi, np.pi, count)
    states[:, 2] = rng.uniform(0.3, 1.2, count) * rng.choice([-1.0, 1.0], count)
    states[:, 5] = _AWAY_M
    limits = instrument.generate_limits
    states[:, JOINTS] = rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))
    return states


def turned_ious(instrument: Instrument, states: FloatArray, turned: FloatArray) -> FloatArray:
    """``(n,)``: overlaps of the silhouettes of states with those of others, without the shaft if there is more than it.

    The shaft, which is the same whichever way it is turned, would hide that the rest is not.
    """
    seen = instrument.without_shaft if len(instrument.meshes) > 1 else instrument
    evaluator = SilhouetteEvaluator([seen], _CAMERA)
    ious = []
    for state, other in zip(states, turned, strict=True):
        reference = Reference(evaluator.mask(state))
        ious.append(evaluator.score(other[None], reference).iou(reference)[0])
    return np.array(ious)


@dataclass(frozen=True)
class MeasuredSymmetry:
    """How much an instrument's silhouettes overlap when it is turned, mean intersection over union.

    Attributes:
        twin: With half a turn about the shaft, the wrist's joints reversed.
        axis: With any turn about the shaft, the joints as they are.
    """

    twin: float
    axis: float

    def agrees(self, declared: str) -> bool:
        """Whether what a file declares is what is seen."""
        if declared == "axis":
            return self.axis >= SAME_IOU
        return self.axis < SAME_IOU and (self.twin >= SAME_IOU) == (declared == "twin")


def measured_symmetry(instrument: Instrument, count: int = 60) -> MeasuredSymmetry:
    """Silhouettes of states against those of the same instrument turned."""
    states = sample_states(instrument, count)
    around = states.copy()
    around[:, BETA] += np.linspace(0.5, 2 * np.pi - 0.5, count)
    return MeasuredSymmetry(
        twin=float(turned_ious(instrument, states, twin(states)).mean()),
        axis=float(turned_ious(instrument, states, around).mean()),
    )
