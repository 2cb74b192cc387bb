"""Instruments: kinematics against known truths, closed meshes, user meshes, files and their error lines."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import resting_state

from surgbench.config import packaged_names
from surgbench.errors import ConfigError, NotFoundError
from surgbench.files import sha256_file
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.meshes import check_mesh, edge_defects, signed_volume
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.shapes import loft_mesh
from surgbench.instrument.spec import CrossSection, Loft

NAME = "large_needle_driver"


@pytest.fixture(scope="module")
def driver() -> Instrument:
    return load_instrument(NAME)


def solid(mesh: LinkMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


def winding_number(mesh: LinkMesh, point: FloatArray) -> float:
    """How many of a mesh's closed parts hold the point: its solid angle over 4 pi (van Oosterom and Strackee)."""
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(2 * np.arctan2(triple, la * lb * lc + dots).sum() / (4 * np.pi))


def link_vertices_cam(instrument: Instrument, state: FloatArray, link: str) -> FloatArray:
    transform = instrument.link_transforms(state)[instrument.link_index[link]]
    vertices: FloatArray = instrument.meshes[link].vertices_m @ transform[:3, :3].T + transform[:3, 3]
    return vertices


# ---------------------------------------------------------------------------------------------- built-in


def test_builtin_names_are_the_files() -> None:
    assert NAME in packaged_names("instruments")


@pytest.mark.parametrize("name", packaged_names("instruments"))
def test_builtin_meshes_are_closed_and_face_outward(name: str) -> None:
    for link, mesh in load_instrument(name).meshes.items():
        body = solid(mesh)
        assert edge_defects(mesh.faces).closed, link
        assert body.is_watertight, link
        assert body.is_winding_consistent, link
        for part in body.split(only_watertight=False):
            assert part.volume > 0, link
        assert body.area_faces.min() > 0, link
        np.testing.assert_array_equal(mesh.vertices_m, mesh.vertices_m.astype(np.float32))


def test_builtin_driver_is_light_and_of_the_right_size(driver: Instrument) -> None:
    assert 700 <= sum(len(mesh.faces) for mesh in driver.meshes.values()) <= 1200
    low, high = driver.meshes["shaft"].vertices_m.min(axis=0), driver.meshes["shaft"].vertices_m.max(axis=0)
    np.testing.assert_allclose(high[:2] - low[:2], 2 * 0.00415, atol=1e-4)
    assert low[2] == pytest.approx(-0.3237, abs=1e-6)
    for jaw in ("jaw_left", "jaw_right"):
        assert driver.meshes[jaw].vertices_m[:, 1].max() == pytest.approx(0.0098, abs=2e-4)


def test_jaws_mirror_each_other(driver: Instrument) -> None:
    right, left = driver.meshes["jaw_right"].vertices_m, driver.meshes["jaw_left"].vertices_m
    mirrored = right * [-1, 1, -1]
    distance = np.linalg.norm(mirrored[:, None] - left[None], axis=-1).min(axis=1)
    assert distance.max() < 1e-6


# -------------------------------------------------------------------------------------------- kinematics


def test_straight_instrument_reaches_along_the_shaft(driver: Instrument) -> None:
    straight = np.zeros(9)
    for jaw in ("jaw_left", "jaw_right"):
        assert link_vertices_cam(driver, straight, jaw)[:, 2].max() == pytest.approx(0.019, abs=5e-4)
    tips = driver.tips_cam(straight)
    np.testing.assert_allclose(sorted(tips[:, 1]), [-0.0004, 0.0004], atol=1e-12)
    np.testing.assert_allclose(tips[:, 2], 0.0091 + 0.009, atol=1e-12)
    np.testing.assert_allclose(tips[:, 0], 0.0, atol=1e-12)


def test_link_frames_of_the_straight_instrument(driver: Instrument) -> None:
    transforms = driver.link_transforms(np.zeros(9))
    shaft, wrist, yaw = (transforms[driver.link_index[name]] for name in ("shaft", "wrist", "yaw"))
    np.testing.assert_allclose(shaft, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(wrist[:3, :3], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(yaw[:3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(yaw[:3, 3], [0, 0, 0.0091], atol=1e-12)


def test_joints_turn_about_the_right_axes(driver: Instrument) -> None:
    def yaw_origin(q1: float) -> FloatArray:
        state = np.zeros(9)
        state[6] = q1
        origin: FloatArray = driver.link_transforms(state)[driver.link_index["yaw"], :3, 3]
        return origin

    # Pitch turns the wrist about y of the wrist-pitch frame, towards +x for positive angles.
    np.testing.assert_allclose(yaw_origin(0.5), 0.0091 * np.array([np.sin(0.5), 0, np.cos(0.5)]), atol=1e-12)

    # Yaw turns the middle of the jaws about x, towards -y for positive angles.
    state = np.zeros(9)
    state[7] = 0.4
    middle = driver.tips_cam(state).mean(axis=0)
    np.testing.assert_allclose(middle, [0, -0.009 * np.sin(0.4), 0.0091 + 0.009 * np.cos(0.4)], atol=1e-12)


@pytest.mark.parametrize("q3", [0.0, 0.3, 0.698])
def test_jaws_open_by_q3_each_to_its_own_side(driver: Instrument, q3: float) -> None:
    state = np.zeros(9)
    state[8] = q3
    transforms = driver.link_transforms(state)
    right, left = (transforms[driver.link_index[name]] for name in ("jaw_right", "jaw_left"))
    # +y of each jaw frame runs along the finger.
    np.testing.assert_allclose(right[:3, 1], [0, np.sin(q3), np.cos(q3)], atol=1e-12)
    np.testing.assert_allclose(left[:3, 1], [0, -np.sin(q3), np.cos(q3)], atol=1e-12)
    tips = driver.tips_cam(state)
    expected = 0.009 * np.sin(q3) + 0.0004 * np.cos(q3)
    np.testing.assert_allclose(tips[:, 1], [expected, -expected], atol=1e-12)


def test_tips_lie_on_the_jaws(driver: Instrument) -> None:
    for tip in driver.spec.tips:
        mesh = driver.meshes[tip.link]
        assert winding_number(mesh, np.array(tip.point_m)) == pytest.approx(1.0)
        assert winding_number(mesh, np.array(tip.point_m) + 0.002 * np.eye(3)[1]) == pytest.approx(0.0, abs=1e-9)


def test_pose_places_the_wrist_pitch_frame(driver: Instrument) -> None:
    state = resting_state()
    straight = np.zeros(9)
    straight[6:] = state[6:]
    alpha, beta, gamma = state[:3]

    def turn(axis: int, angle: float) -> FloatArray:
        return Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()

    rotation = turn(1, gamma) @ turn(0, alpha) @ turn(2, beta)
    np.testing.assert_allclose(driver.tips_cam(state), driver.tips_cam(straight) @ rotation.T + state[3:6], atol=1e-12)


finite = st.floats(-4.0, 4.0)


@pytest.mark.slow
@settings(max_examples=50)
@given(st.lists(finite, min_size=9, max_size=9))
def test_link_transforms_are_rigid(values: list[float]) -> None:
    transforms = load_instrument_once().link_transforms(np.array([values, values[::-1]]))
    rotation = transforms[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-9)
    np.testing.assert_array_equal(transforms[..., 3, :], np.broadcast_to([0, 0, 0, 1], transforms.shape[:-1]))


_ONCE: dict[str, Instrument] = {}


def load_instrument_once() -> Instrument:
    return _ONCE.setdefault(NAME, load_instrument(NAME))


def test_limits_are_those_of_the_file(driver: Instrument) -> None:
    np.testing.assert_allclose(driver.search_limits.upper_rad, [1.5707, 1.3963, 1.5707])
    np.testing.assert_allclose(driver.search_limits.lower_rad, [-1.5707, -1.3963, 0])
    np.testing.assert_allclose(driver.generate_limits.upper_rad, [1.3963, 1.3963, 0.698])
    np.testing.assert_allclose(driver.generate_limits.lower_rad, [-1.3963, -1.3963, 0])


def test_skeleton_hangs_together(driver: Instrument) -> None:
    bones = driver.skeleton_cam(resting_state())
    assert bones.shape == (4, 2, 3)
    np.testing.assert_allclose(bones[0, 1], bones[1, 0])
    np.testing.assert_allclose(bones[2:, 0], [bones[1, 1]] * 2)
    np.testing.assert_allclose(bones[2:, 1], driver.tips_cam(resting_state()))


# ----------------------------------------------------------------------------------------------- shapes


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("sides", [3, 4, 7, 24])
def test_lofts_are_closed_along_every_axis(axis: Any, sides: int) -> None:
    sections = (
        CrossSection(at_m=-0.01, radii_m=(0.002, 0.003)),
        CrossSection(at_m=0.0, radii_m=(0.004, 0.003), centre_m=(0.001, 0.0), exponent=6.0),
        CrossSection(at_m=0.02, radii_m=(0.001, 0.001)),
    )
    mesh = loft_mesh(Loft(axis=axis, sides=sides, sections=sections))
    assert len(mesh.faces) == 2 * sides * 2 + 2 * (sides - 2)
    assert edge_defects(mesh.faces).closed
    assert signed_volume(mesh.vertices_m, mesh.faces) > 0
    along = "xyz".index(axis)
    assert mesh.vertices_m[:, along].min() == pytest.approx(-0.01)
    # The widest section lies off centre along the first cross axis (y for x, z for y, x for z).
    reach = mesh.vertices_m.max(axis=0) + mesh.vertices_m.min(axis=0)
    assert reach[(along + 1) % 3] > 1e-3 > abs(reach[(along + 2) % 3])


def test_a_coarse_cylinder_has_the_true_mean_width() -> None:
    ends = tuple(CrossSection(at_m=z, radii_m=(0.004, 0.004)) for z in (0.0, 0.1))
    ring = loft_mesh(Loft(axis="z", sides=8, sections=ends)).vertices_m[:8, :2]
    angles = np.linspace(0, np.pi, 720, endpoint=False)
    across = ring @ np.stack([np.cos(angles), np.sin(angles)])
    assert np.ptp(across, axis=0).mean() == pytest.approx(0.008, rel=1e-4)


def test_four_sides_make_a_box() -> None:
    ends = tuple(CrossSection(at_m=z, radii_m=(0.002, 0.001), exponent=20.0) for z in (0.0, 0.01))
    mesh = loft_mesh(Loft(axis="z", sides=4, sections=ends))
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), [0.004, 0.002, 0.01], rtol=0.03)


# ------------------------------------------------------------------------------------------------ files


def test_saved_instrument_loads_identical(driver: Instrument, tmp_path: Path) -> None:
    written = save_instrument(driver, tmp_path / "a")
    assert written[0] == tmp_path / "a" / "instrument.yaml"
    assert {path.name for path in written} == {path.name for path in (tmp_path / "a").iterdir()}
    loaded = load_instrument(written[0])
    assert loaded.meshes.keys() == driver.meshes.keys()
    for link, mesh in driver.meshes.items():
        assert loaded.meshes[link].vertices_m.tobytes() == mesh.vertices_m.tobytes()
        assert loaded.meshes[link].faces.tobytes() == mesh.faces.tobytes()
    state = resting_state()
    assert loaded.link_transforms(state).tobytes() == driver.link_transforms(state).tobytes()
    assert loaded.spec.tips == driver.spec.tips
    assert loaded.spec.joints == driver.spec.joints

    again = save_instrument(loaded, tmp_path / "b")
    assert [sha256_file(path) for path in again] == [sha256_file(path) for path in written]


def test_saved_instrument_needs_nothing_outside_its_folder(tmp_path: Path) -> None:
    save_instrument(
        load_instrument(write_instrument(tmp_path / "mine", trimesh.creation.box([0.01] * 3))), tmp_path / "copy"
    )
    (tmp_path / "mine" / "body.stl").unlink()
    (tmp_path / "copy").rename(tmp_path / "moved")
    assert len(load_instrument(tmp_path / "moved" / "instrument.yaml").meshes["body"].faces) == 12


def test_unknown_name_gives_the_nearest() -> None:
    with pytest.raises(
        NotFoundError, match="unknown instrument 'large_needel_driver'; did you mean 'large_needle_driver'"
    ):
        load_instrument("large_needel_driver")


def spec_of(mesh: dict[str, Any] | None = None) -> dict[str, Any]:
    limits = {"search_rad": [-1.0, 1.0], "generate_rad": [-0.5, 0.5]}
    return {
        "format": "surgbench-instrument-1",
        "name": "mine",
        "title": "One rigid body",
        "joints": {"wrist_pitch": limits, "wrist_yaw": limits, "jaw": limits},
        "links": [{"name": "body", "mesh": mesh or {"path": "body.stl"}}],
        "tips": [{"link": "body", "point_m": [0, 0, 0]}] * 2,
    }


def marker_of(link: str = "body") -> dict[str, Any]:
    """A spot that begins 1 mm off one side of a box of 1 cm."""
    return {
        "name": "dot",
        "point": {"link": link, "point_m": [0.006, 0, 0]},
        "radius_m": 1.5e-3,
        "colour": [0, 1, 0],
    }


def write_instrument(folder: Path, mesh: trimesh.Trimesh, name: str = "body.stl", **entry: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    mesh.export(str(folder / name))
    path = folder / "mine.yaml"
    spec = spec_of({"path": name, **entry})
    spec["tips"] = [{"link": "body", "point_m": entry.get("translation_m", [0, 0, 0])}] * 2
    path.write_text(yaml.safe_dump(spec))
    return path


def change(spec: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    here: Any = spec
    for part in path:
        here = here[int(part) if part.isdigit() else part]
    here[last] = value


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("titel", "x", r"unknown key 'titel'; did you mean 'title'"),
        ("name", "My Driver", r"'name': .*pattern"),
        ("joints.jaw.search_rad", [1.0, 0.0], r"'joints.jaw': search_rad must be \[lower, upper\]"),
        ("links.0.alpha_rad", "flat", r"'links.0.alpha_rad': .*number"),
        ("links.0.mesh.sclae", 2, r"unknown key 'links.0.mesh.sclae'; did you mean 'scale'"),
        ("links.0.mesh.scale", -1, r"'links.0.mesh.scale': .*greater than 0"),
        ("links.0.mesh.rotation", [[2, 0, 0], [0, 2, 0], [0, 0, 2]], r"'links.0.mesh.rotation': .*use 'scale'"),
        ("links.0.parent", "base", r"'link 'body': the first link, and only it, has no parent|first link"),
        ("links.0.name", "../body", r"'links.0.name': .*pattern"),
        ("tips.1.link", "jaw", r"unknown link 'jaw'"),
        ("markers", [marker_of()] * 2, r"two markers are named 'dot'"),
        ("markers", [marker_of("jaw")], r"unknown link 'jaw' of marker 'dot'"),
        ("markers", [{**marker_of(), "colour": [0, 2, 0]}], r"'markers.0.colour.1': .*less than or equal to 1"),
        ("markers", [{**marker_of(), "radius_m": 1e-4}], r"marker 'dot' is further than its radius off .* 'body'"),
    ],
)
def test_wrong_key_is_one_line_with_file_and_key(tmp_path: Path, key: str, value: Any, told: str) -> None:
    path = write_instrument(tmp_path, trimesh.creation.box([0.01] * 3))
    spec = spec_of()
    change(spec, key, value)
    path.write_text(yaml.safe_dump(spec))
    with pytest.raises(ConfigError, match=told) as caught:
        load_instrument(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("text", ["links: [", "- a\n- b\n", ""])
def test_file_that_is_no_mapping_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_instrument(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_markers_travel_with_an_instrument(tmp_path: Path) -> None:
    path = write_instrument(tmp_path, trimesh.creation.box([0.01] * 3))
    before = save_instrument(load_instrument(path), tmp_path / "bare")[0].read_bytes()
    assert b"markers" not in before
    path.write_text(yaml.safe_dump({**spec_of(), "markers": [marker_of()]}))
    painted = load_instrument(path)
    assert painted.spec.markers[0].colour == (0, 1, 0)
    save_instrument(painted, tmp_path / "copy")
    assert load_instrument(tmp_path / "copy" / "instrument.yaml").spec.markers == painted.spec.markers


def test_missing_instrument_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_instrument(str(tmp_path / "nowhere.yaml"))


def test_instrument_without_bodies_is_refused(tmp_path: Path) -> None:
    spec = spec_of()
    del spec["links"][0]["mesh"]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(spec))
    with pytest.raises(ConfigError, match="no link has 'shapes', 'parts' or a 'mesh'"):
        load_instrument(path)


# ------------------------------------------------------------------------------------------ user meshes


@pytest.mark.parametrize("name", ["body.stl", "body.obj", "body.ply", "BODY.STL"])
def test_mesh_files_of_every_kind(tmp_path: Path, name: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.005)
    mesh = load_instrument(write_instrument(tmp_path, ball, name)).meshes["body"]
    assert mesh.faces.shape == (320, 3)
    assert len(mesh.vertices_m) == len(ball.vertices)
    assert solid(mesh).is_watertight
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(ball.volume, rel=1e-4)


def test_quads_and_several_objects_in_one_obj(tmp_path: Path) -> None:
    lines, count = [], 0
    for offset in (0.0, 0.05):
        corners = [(x, y, z) for x in (0, 0.01) for y in (0, 0.01) for z in (0, 0.01)]
        lines += [f"o part{count}", *(f"v {x + offset} {y} {z}" for x, y, z in corners)]
        for quad in ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)):
            lines.append("f " + " ".join(str(corner + count) for corner in quad))
        count += 8
    path = write_instrument(tmp_path, trimesh.creation.box([0.01] * 3), "body.obj")
    (tmp_path / "body.obj").write_text("\n".join(lines) + "\n")
    mesh = load_instrument(path).meshes["body"]
    assert len(mesh.faces) == 24
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(2e-6, rel=1e-4)


def test_millimetres_rotation_and_translation(tmp_path: Path) -> None:
    block = trimesh.creation.box([2.0, 4.0, 6.0])
    path = write_instrument(
        tmp_path, block, scale=0.001, rotation=[[0, -1, 0], [1, 0, 0], [0, 0, 1]], translation_m=[0.1, 0.0, 0.0]
    )
    vertices = load_instrument(path).meshes["body"].vertices_m
    np.testing.assert_allclose(vertices.min(axis=0), [0.098, -0.001, -0.003], atol=1e-8)
    np.testing.assert_allclose(vertices.max(axis=0), [0.102, 0.001, 0.003], atol=1e-8)


def test_inward_parts_are_turned_outward(tmp_path: Path) -> None:
    outward = trimesh.creation.icosphere(subdivisions=1, radius=0.005)
    inward = trimesh.creation.box([0.01] * 3)
    inward.apply_translation([0.5, 0, 0])
    inward.invert()
    assert inward.volume < 0
    both = trimesh.util.concatenate([outward, inward])
    assert isinstance(both, trimesh.Trimesh)
    mesh = load_instrument(write_instrument(tmp_path, both)).meshes["body"]
    parts = solid(mesh).split()
    assert len(parts) == 2
    assert all(part.volume > 0 for part in parts)


def open_ball() -> trimesh.Trimesh:
    ball: trimesh.Trimesh = trimesh.creation.icosphere(subdivisions=2, radius=0.005)
    ball.update_faces(np.arange(len(ball.faces)) >= 2)
    return ball


def test_open_mesh_is_refused_with_the_way_to_mend_it(tmp_path: Path) -> None:
    path = write_instrument(tmp_path, open_ball())
    with pytest.raises(
        ConfigError, match=r"body\.stl.*'body' is not closed \((4|6) open edges\).*'close_holes: true'"
    ) as caught:
        load_instrument(path)
    assert "\n" not in str(caught.value)


def test_inconsistent_winding_is_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box([0.01] * 3)
    box.faces[0] = box.faces[0][::-1]
    with pytest.raises(ConfigError, match="3 edges whose faces turn opposite ways"):
        load_instrument(write_instrument(tmp_path, trimesh.Trimesh(box.vertices, box.faces, process=False), "body.ply"))


BOX = trimesh.creation.box([0.01] * 3)
FLAT = [[0.2, 0.2, 0.3], [0.3, 0.2, 0.1], [0.2, 0.37, 0.7]]


@pytest.mark.parametrize(
    ("points", "triangles", "told"),
    [
        ([], BOX.faces[:1], r"not closed \(3 edges with more than two faces\); set 'close_holes: true'"),
        ([], BOX.faces, r"not closed \(18 edges with more than two faces\); set 'close_holes: true'"),
        (
            [[0.02, 0.03, 0]],
            [[0, 1, 8]],
            r"not closed \(2 open edges, 1 edge with more than two faces\); set 'close_ho",
        ),
        (FLAT, [[8, 9, 10]], r"not closed \(3 open edges\); set 'close_holes: true'"),
        (FLAT, [[8, 9, 10], [8, 10, 9]], r"part without volume \(2 triangles about .* m .*\); delete it or"),
        ([[1, 1, 1], [2, 2, 2], [4, 4, 4]], [[8, 9, 10], [8, 10, 9]], r"without volume \(2 .*; delete it or"),
    ],
    ids=["a face twice", "all faces twice", "a fin", "an open part far away", "a flat part", "a part without area"],
)
@pytest.mark.parametrize("kind", ["stl", "ply"])
def test_a_box_with_something_wrong_is_refused(
    tmp_path: Path, kind: str, points: list[list[float]], triangles: Any, told: str
) -> None:
    vertices = np.concatenate([BOX.vertices, np.reshape(points, (-1, 3))])
    wrong = trimesh.Trimesh(vertices, np.concatenate([BOX.faces, triangles]), process=False)
    with pytest.raises(ConfigError, match=rf"body\.{kind}: mesh of link 'body' .*{told}") as caught:
        load_instrument(write_instrument(tmp_path, wrong, f"body.{kind}"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("faces", "told"),
    [
        (BOX.faces[1:], r"not closed \(3 open edges\); mend it, .* 'close_holes: true'"),
        (np.concatenate([BOX.faces, BOX.faces[:1]]), r"not closed \(3 edges with more than two faces\); mend it"),
        (
            np.concatenate([BOX.faces[:1, ::-1], BOX.faces[1:]]),
            r"not closed \(3 edges whose faces turn opposite ways\); mend it",
        ),
        (np.concatenate([BOX.faces, [[0, 0, 1]]]), r"not closed \(1 open edge, 1 edge with more"),
        (BOX.faces + 1, r"other vertices than its 8"),
        (BOX.faces - 1, r"other vertices than its 8"),
    ],
)
def test_a_mesh_given_in_python_is_checked_as_well(faces: Any, told: str) -> None:
    with pytest.raises(ValueError, match=rf"^mesh of link 'wrist' .*{told}"):
        check_mesh("wrist", LinkMesh(BOX.vertices, faces.astype(np.int32)))


def test_a_mesh_given_in_python_may_touch_itself_but_not_be_without_place() -> None:
    two: Any = trimesh.util.concatenate([BOX, BOX.copy().apply_translation([0.01, 0.01, 0])])
    two.merge_vertices()
    faces = two.faces.astype(np.int32)
    assert edge_defects(faces).crowded == 1
    check_mesh("wrist", LinkMesh(two.vertices, faces))
    with pytest.raises(ValueError, match="'wrist' has vertices that are not finite"):
        check_mesh("wrist", LinkMesh(two.vertices * np.nan, faces))


def test_an_inward_part_that_touches_another_in_a_corner_is_turned(tmp_path: Path) -> None:
    """An STL file merges the corner, so that the two hang together by it; edges they do not share."""
    faces = np.concatenate([BOX.faces, BOX.faces[:, ::-1] + 8])
    both = trimesh.Trimesh(np.concatenate([BOX.vertices, BOX.vertices + 0.01]), faces, process=False)
    mesh = load_instrument(write_instrument(tmp_path, both)).meshes["body"]
    assert len(mesh.vertices_m) == 15
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(2e-6, rel=1e-4)


@pytest.mark.parametrize(("name", "data"), [("body.stl", b"solid nothing"), ("body.ply", b"ply\n"), ("body.obj", b"")])
def test_broken_mesh_file_is_one_line(tmp_path: Path, name: str, data: bytes) -> None:
    path = write_instrument(tmp_path, trimesh.creation.box([0.01] * 3), name)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ConfigError, match=f"{name}: cannot be read as a triangle mesh") as caught:
        load_instrument(path)
    assert "\n" not in str(caught.value)


def test_missing_mesh_and_unknown_kind(tmp_path: Path) -> None:
    path = write_instrument(tmp_path, trimesh.creation.box([0.01] * 3))
    (tmp_path / "body.stl").unlink()
    with pytest.raises(ConfigError, match=r"body\.stl: mesh file of link 'body' is missing"):
        load_instrument(path)
    path.write_text(yaml.safe_dump(spec_of({"path": "body.dae"})))
    with pytest.raises(ConfigError, match=r"body\.dae: .*\.stl, \.obj, \.ply"):
        load_instrument(path)


def pymeshlab_problem() -> str:
    if importlib.util.find_spec("pymeshlab") is None:
        return "pymeshlab is not installed (extra 'meshes')"
    try:
        import pymeshlab  # noqa: F401
    except ImportError as error:
        return f"pymeshlab does not load: {error}"
    return ""


PROBLEM = pymeshlab_problem()


@pytest.mark.extras
@pytest.mark.skipif(bool(PROBLEM), reason=PROBLEM)
def test_holes_are_closed(tmp_path: Path) -> None:
    whole = trimesh.creation.icosphere(subdivisions=2, radius=0.005)
    mesh = load_instrument(write_instrument(tmp_path, open_ball(), close_holes=True)).meshes["body"]
    assert solid(mesh).is_watertight
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(whole.volume, rel=0.02)


@pytest.mark.extras
@pytest.mark.skipif(bool(PROBLEM), reason=PROBLEM)
def test_parts_that_touch_along_an_edge_are_set_apart(tmp_path: Path) -> None:
    first, second = trimesh.creation.box([0.01] * 3), trimesh.creation.box([0.01] * 3)
    second.apply_translation([0.01, 0.01, 0])
    both = trimesh.util.concatenate([first, second])
    assert isinstance(both, trimesh.Trimesh)
    with pytest.raises(ConfigError, match="1 edge with more than two faces"):
        load_instrument(write_instrument(tmp_path, both))
    mesh = load_instrument(write_instrument(tmp_path, both, close_holes=True)).meshes["body"]
    assert edge_defects(mesh.faces).closed
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(2e-6, rel=1e-4)


@pytest.mark.extras
@pytest.mark.skipif(bool(PROBLEM), reason=PROBLEM)
def test_triangles_are_reduced(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.005)
    mesh = load_instrument(write_instrument(tmp_path, ball, max_triangles=400)).meshes["body"]
    assert len(mesh.faces) <= 400
    assert solid(mesh).is_watertight
    assert signed_volume(mesh.vertices_m, mesh.faces) == pytest.approx(ball.volume, rel=0.03)


def test_without_pymeshlab_one_line_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(ConfigError, match=r"'close_holes' needs pymeshlab: pip install 'surgbench\[meshes\]'"):
        load_instrument(write_instrument(tmp_path, open_ball(), close_holes=True))


def test_pymeshlab_is_not_imported_for_good_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    box = trimesh.creation.box([0.01] * 3)
    assert load_instrument(write_instrument(tmp_path, box, close_holes=True, max_triangles=12)).meshes


def test_the_example_in_the_docs_loads(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "instruments.md").read_text(encoding="utf-8")
    example = page.split("```yaml\n")[1].split("```")[0]
    trimesh.creation.box([6.0] * 3).export(str(tmp_path / "wrist.stl"))
    for jaw in ("jaw_right.ply", "jaw_left.ply"):
        trimesh.creation.box([0.002, 0.02, 0.001]).export(str(tmp_path / jaw))
    path = tmp_path / "my_grasper.yaml"
    path.write_text(example, encoding="utf-8")
    instrument = load_instrument(path)
    assert list(instrument.meshes) == ["shaft", "wrist", "jaw_right", "jaw_left"]
    assert np.ptp(instrument.meshes["wrist"].vertices_m) == pytest.approx(0.006, rel=1e-6)
    np.testing.assert_allclose(
        instrument.tips_cam(np.zeros(9)), load_instrument(NAME).tips_cam(np.zeros(9)), atol=1e-12
    )
