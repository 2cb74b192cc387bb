"""What stands around the wire: the camera arm and what is known of its base, the no-go box; the arm at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.generators.wire_chaser.hand import draw_truncated
from surgbench.generators.wire_chaser.presets import Scene, WireChaser, WireSettings
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.camera_arm import PSM_CLASSIC
from surgbench.viewpoint.registration import Touches, register
from surgbench.viewpoint.setting_up import turned_base
from surgbench.viewpoint.workspace import NoGoZone, Workspace

# The published zone's points, from the middle of its base, as shares of its size: A, B, C, D, E
# (OverallTrackingPerformance.m: sides of 82.3, 74.0, 82.4 and 76.7 mm, 49.4 mm high).
ZONE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.53, -0.473, 0.004], [-0.47, -0.509, 0.0], [0.018, 0.5, 1.008]])
# Where both arms touch, as shares of the box: nothing is published of it.
TOUCHED = np.array([[-0.3, -0.35, 0.9], [0.3, -0.35, 0.2], [0.3, 0.35, 0.9], [-0.3, 0.35, 0.2], [0.0, 0.0, 0.5]])
# Of the arm that holds the ring, from the box's middle: on the other side of the table. Our choice.
TROCAR_M = np.array([-0.12, -0.10, 0.20])


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands around the wire, in the world.

    Attributes:
        T_world_box: ``(4, 4)`` the middle of the box's base, its height along z.
        centre_m: ``(3,)`` the middle of the box.
        T_world_base: ``(4, 4)`` where the camera arm's base is.
        reported: ``(4, 4)`` where the set-up joints have it.
        registered: ``(4, 4)`` where the registration has it that the authors used.
        zone_m: ``(5, 3)`` the points touched around the box.
        touches: The points touched by both arms.
        workspace: The rules.
    """

    T_world_box: FloatArray
    centre_m: FloatArray
    T_world_base: FloatArray
    reported: FloatArray
    registered: FloatArray
    zone_m: FloatArray
    touches: Touches
    workspace: Workspace


def draw_surroundings(preset: WireChaser, rng: np.random.Generator) -> Surroundings:
    """Draw all of it."""
    scene, settings, rules = preset.scene, preset.wire, preset.rules
    tilts = scene.zone_tilt_rad * rng.standard_normal(2)
    yaw = scene.zone_yaw_rad * rng.standard_normal()
    turn = rotation_from_vector(np.append(tilts, 0.0)) @ rotation_from_vector(np.array([0.0, 0.0, yaw]))
    place = np.array(scene.centre_m) + scene.centre_spread_m * rng.uniform(-1.0, 1.0, 3)
    box = rigid_transform(turn, place)
    centre = _in_world(box, np.array([0.0, 0.0, settings.box_m[2] / 2]))
    remote = [
        low if low == high else rng.triangular(low, middle, high)
        for low, middle, high in zip(
            scene.remote_centre_low_m, scene.remote_centre_m, scene.remote_centre_high_m, strict=True
        )
    ]
    rotation = rotation_from_vector(rng.uniform(*scene.base_tilt_rad) * _direction(rng))
    if preset.arm != PSM_CLASSIC:  # which the places above are of
        middle = _towards(centre, np.array(remote))
        base = rigid_transform(rotation, centre + np.array(remote))
        rotation = turned_base(preset.arm, base, middle[None], rules.distance_m)[:3, :3]
    mean, deviation = scene.reported_rad
    misreport = rotation_from_vector(draw_truncated(mean, deviation, scene.reported_range_rad, rng) * _direction(rng))
    misreport_m = np.array(scene.reported_m) + scene.reported_spread_m * rng.standard_normal(3)
    base = rigid_transform(rotation, centre + np.array(remote))
    reported = rigid_transform(misreport @ rotation, base[:3, 3] - misreport_m)
    zone = touch_zone(box, settings, scene, rng)
    touches = touch_points(base, box, settings, scene, rng)
    workspace = Workspace(NoGoZone(zone), rules.floor_m, rules.proximity_m, rules.preferred_side)
    registered = register(reported, touches, "translation")
    return Surroundings(box, centre, base, reported, registered, zone, touches, workspace)


def touch_zone(T_world_box: FloatArray, settings: WireSettings, scene: Scene, rng: np.random.Generator) -> FloatArray:
    """``(5, 3)`` the points touched around the no-go box, which has the published one's shape."""
    points = _in_world(T_world_box, ZONE * settings.box_m)
    return np.asarray(points + scene.zone_m * rng.standard_normal(points.shape))


def touch_points(
    T_world_base: FloatArray, T_world_box: FloatArray, settings: WireSettings, scene: Scene, rng: np.random.Generator
) -> Touches:
    """Five points touched by both arms, each touch with an error."""
    points = _in_world(T_world_box, TOUCHED * settings.box_m)
    errors = scene.touch_m / np.sqrt(3.0) * rng.standard_normal((2, *points.shape))
    return Touches(points + errors[0], _in_world(inverse_transform(T_world_base), points) + errors[1])


def _towards(centre_m: FloatArray, away_m: FloatArray) -> FloatArray:
    """A feature ``(4, 4)`` in the middle, its normal towards the camera arm's remote centre."""
    y = away_m / np.linalg.norm(away_m)
    x = np.cross(y, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    return rigid_transform(np.stack([x, y, np.cross(x, y)], axis=1), centre_m)


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _in_world(transform: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3])
