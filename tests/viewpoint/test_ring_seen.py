"""Whether the ring is seen: what its tool covers, what is in the picture, and that pictures show the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.generators.wire_chaser.presets import WireSettings
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.instrument.model import LinkMesh
from surgbench.rendering.depth import depth_view, load_mitsuba
from surgbench.viewpoint.optics.grasp_object import (
    RING_AHEAD_M,
    RING_RADIUS_M,
    TUBE_RADIUS_M,
    Panel,
    Solid,
    Subject,
    grasp_object,
    holder,
)
from surgbench.viewpoint.optics.markers import TagFinder
from surgbench.viewpoint.optics.photograph import BACKGROUND, OVERSAMPLE, Photographer
from surgbench.viewpoint.optics.rays import mark_free
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.optics.triangles import lay_out
from surgbench.viewpoint.optics.visibility import POINTS, ring_points_m, ring_shares
from surgbench.viewpoint.placement import look_at

RING = np.eye(4)[None]  # the feature's frame is the world's here


def shares(place_m: Any, at_m: Any = (0.0, 0.0, 0.0)) -> FloatArray:
    """What both eyes of a camera at a place see that looks at another."""
    return np.asarray(ring_shares(AUTOCAM_STEREO, look_at(np.array(place_m), np.array(at_m))[None], RING)[0])


def test_from_before_beside_and_ahead_of_the_tool_all_of_the_ring_is_seen() -> None:
    for place in ([0, 0.11, 0], [0.11, 0.001, 0], [0, -0.11, 0.01], [0.01, 0.02, 0.11]):
        np.testing.assert_array_equal(shares(place), 1.0)
    # From above the tool, the stem's end covers what it holds the ring by.
    np.testing.assert_allclose(shares([0.05, 0.07, -0.04]), 1.0, atol=1.5 / POINTS)


def test_behind_the_shaft_nothing_is_seen() -> None:
    """On the tool's axis, outside of the shaft and in it; and along the object, which is wider than the ring."""
    for place in ([0, 0, -0.11], [0.006, 0.004, -0.11], [0.03, 0.0, -0.1]):
        np.testing.assert_array_equal(shares(place), 0.0)


def test_a_ring_on_the_border_of_the_picture_is_seen_in_part() -> None:
    """Turned until the left eye has its centre on the border: half of it is there, and none where it is turned on."""
    place = np.array([0.0, 0.11, 0.0])
    camera, left = look_at(place, np.zeros(3)), AUTOCAM_STEREO.left
    found = []
    for degrees in np.linspace(0, 60, 241):
        turned = camera @ rigid_transform(rotation_from_vector(np.radians([0.0, degrees, 0.0])), np.zeros(3))
        pixel, _ = AUTOCAM_STEREO.see(turned, np.zeros(3))
        found.append((pixel[0, 0], ring_shares(AUTOCAM_STEREO, turned[None], RING)[0, 0]))
    u, share = np.array(found).T
    assert share[0] == 1.0
    assert share[-1] == 0.0
    assert share[np.nanargmin(np.abs(u - left.width * (u > left.width / 2)))] == pytest.approx(0.5, abs=0.15)


def test_an_unknown_feature_has_no_share() -> None:
    unknown = np.full((1, 4, 4), np.nan)
    both = ring_shares(AUTOCAM_STEREO, np.stack([look_at(np.array([0, 0.11, 0]), np.zeros(3))] * 2),
                       np.concatenate([RING, unknown]))  # fmt: skip
    np.testing.assert_array_equal(both[0], 1.0)
    assert np.isnan(both[1]).all()


def test_the_object_is_as_it_is_generated_and_held() -> None:
    assert (WireSettings().ring_radius_m, WireSettings().tube_radius_m) == (RING_RADIUS_M, TUBE_RADIUS_M)
    np.testing.assert_allclose(np.linalg.norm(ring_points_m(), axis=1), RING_RADIUS_M)
    assert len(ring_points_m()) == POINTS
    points = np.concatenate([solid.mesh.vertices_m for solid in holder()])
    assert points[:, 2].max() < -RING_RADIUS_M + TUBE_RADIUS_M
    # The shaft ends far behind every camera, and the jaws reach the stem, not the ring.
    assert points[:, 2].min() < -0.3
    jaws = np.concatenate([solid.mesh.vertices_m for solid in holder()[-2:]])
    assert -RING_AHEAD_M + 0.005 < jaws[:, 2].max() < -0.0232


boxes = st.tuples(*(st.floats(0.01, 0.05),) * 3).map(np.array)
vectors = st.tuples(*(st.floats(-0.1, 0.1),) * 3).map(np.array)


@settings(max_examples=60)
@given(boxes, vectors, vectors)
def test_a_box_is_in_the_way_where_its_slabs_say(size: FloatArray, origin: FloatArray, target: FloatArray) -> None:
    mesh = trimesh.creation.box(size)
    box = Subject((), (Solid(LinkMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)), 0.5),))
    free = np.empty((1, 1), dtype=np.bool_)
    mark_free(origin[None], target[None], 0.0, lay_out(box), free)
    way = target - origin
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([(-size / 2 - origin) / way, (size / 2 - origin) / way])
    entry, exit_ = np.fmin(*ends), np.fmax(*ends)
    outside = ((way == 0) & (np.abs(origin) > size / 2)).any()
    near, far = np.where(way == 0, -np.inf, entry).max(), np.where(way == 0, np.inf, exit_).min()
    # Its surface is met where the segment goes in or out of it.
    met = not outside and near <= far and (0 <= near <= 1 or 0 <= far <= 1)
    grazes = not outside and (abs(far - near) < 1e-9 or min(abs(near), abs(near - 1), abs(far), abs(far - 1)) < 1e-9)
    assert free[0, 0] == (not met) or grazes


def by_mitsuba(camera: Camera, subject: Subject, T_cam_object: FloatArray) -> FloatArray:
    """The same picture, rendered by Mitsuba: one reflected ray along the normal finds the light or something dark."""
    mi = load_mitsuba()
    fine = camera.model_copy(update={
        "width": camera.width * OVERSAMPLE, "height": camera.height * OVERSAMPLE,
        "fx": camera.fx * OVERSAMPLE, "fy": camera.fy * OVERSAMPLE,
        "cx": (camera.cx + 0.5) * OVERSAMPLE - 0.5, "cy": (camera.cy + 0.5) * OVERSAMPLE - 0.5,
    })  # fmt: skip
    view = depth_view(mi, fine)
    view["sensor"]["film"]["pixel_format"] = "luminance_alpha"
    view["integrator"] = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1, "hide_emitters": True}
    place = T_cam_object.copy()
    place[1] *= fine.fy / fine.fx
    shapes = {f"panel_{k}": _rectangle(mi, panel, place) for k, panel in enumerate(subject.panels)}
    shapes |= {f"solid_{k}": _mesh(mi, solid, place) for k, solid in enumerate(subject.solids)}
    scene = mi.load_dict({"type": "scene", **view, "light": {"type": "constant", "radiance": 1.0}, **shapes})
    seen = np.asarray(mi.render(scene, spp=1))
    grey = seen[..., 0] + (1.0 - seen[..., 1]) * BACKGROUND
    coarse = grey.reshape(camera.height, OVERSAMPLE, camera.width, OVERSAMPLE).mean(axis=(1, 3))
    return np.asarray(np.rint(255.0 * coarse))


def _rectangle(mi: Any, panel: Panel, place: FloatArray) -> dict[str, Any]:
    half = np.diag([panel.size_m[0] / 2, panel.size_m[1] / 2, 1.0, 1.0])
    bitmap = mi.Bitmap(np.ascontiguousarray(panel.texture[::-1, :, None]))
    picture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    pose = mi.ScalarTransform4f(place @ panel.T_object_panel @ half)
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "diffuse", "reflectance": picture}}


def _mesh(mi: Any, solid: Solid, place: FloatArray) -> Any:
    properties = mi.Properties()
    colour = {"type": "uniform", "value": solid.reflectance}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "inside": {"type": "diffuse", "reflectance": colour}})
    properties["face_normals"] = True
    vertices = solid.mesh.vertices_m @ place[:3, :3].T + place[:3, 3]
    mesh = mi.Mesh("solid", len(vertices), len(solid.mesh.faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = solid.mesh.faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


@pytest.mark.slow
def test_photographs_are_those_of_mitsuba() -> None:
    """Tags, object and tool, from before, from the side, and from behind the tool, which the near plane cuts."""
    camera = AUTOCAM_STEREO.left.pinhole
    subject = grasp_object(tool=True)
    photographer, finder = Photographer(camera, subject, noise=0.0), TagFinder(camera)
    for place in ([0.01, 0.11, 0.01], [0.06, 0.08, -0.04], [0.1, 0.02, -0.03], [0.004, 0.02, -0.12]):
        T_cam_object = inverse_transform(look_at(np.array(place), np.array([0.002, 0.001, -0.005])))
        ours = photographer.photograph(T_cam_object, np.random.default_rng(0))
        theirs = by_mitsuba(camera, subject, T_cam_object)
        off = np.abs(ours - theirs)
        assert (off > 1).mean() < 2e-3
        assert off.mean() < 0.2
        assert ours.std() > 10
        found, reference = finder.find(ours), finder.find(theirs.astype(np.uint8))
        assert (found is None) == (reference is None)
        if found is not None and reference is not None:
            np.testing.assert_allclose(found.corners_px, reference.corners_px, atol=0.05)


def test_the_tool_is_in_the_photographs() -> None:
    """From behind, shaft and wrist cover much of the object that it holds."""
    T_cam_object = inverse_transform(look_at(np.array([0.012, 0.035, -0.1]), np.array([0.012, 0.004, -0.017])))
    photographers = [Photographer(AUTOCAM_STEREO.left, grasp_object(tool=tool), noise=0.0) for tool in (False, True)]
    bare, held = (one.photograph(T_cam_object, np.random.default_rng(0)).astype(int) for one in photographers)
    assert (np.abs(bare - held) > 20).mean() > 0.05
    assert (held[bare > 200] < 150).mean() > 0.1
