"""What cannot be seen of an instrument is not scored, and what cannot be an instrument is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from support import resting_state

from surgbench.alike import choose_seen_alike
from surgbench.camera import Camera
from surgbench.errors import ConfigError
from surgbench.geometry import look_at_rotation
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.observability import is_round
from surgbench.instrument.plausibility import distance_to_body
from surgbench.metrics import POSE_ERRORS, interval_coverages, pose_errors
from surgbench.references import reference_joint_errors
from surgbench.state import BETA, JOINTS

CAMERA = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
LIMITS = {"search_rad": [-1.0, 1.0], "generate_rad": [-0.5, 0.5]}


def tube(**changes: Any) -> dict[str, Any]:
    """A suction tube: round, stiff, its two keypoints on its rim."""
    sections = [
        {"at_m": at, "radii_m": [radius, radius]} for at, radius in ((-0.2, 0.0025), (0.0, 0.0025), (0.01, 0.002))
    ]
    return {
        "format": "surgbench-instrument-1",
        "name": "tube",
        "title": "Suction tube",
        "joints": {"wrist_pitch": LIMITS, "wrist_yaw": LIMITS, "jaw": LIMITS},
        "links": [{"name": "shaft", "shapes": [{"axis": "z", "sides": 16, "sections": sections}]}],
        "tips": [{"link": "shaft", "point_m": [side * 0.0015, 0.0, 0.01]} for side in (1, -1)],
        **changes,
    }


def load(folder: Path, spec: dict[str, Any]) -> Instrument:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(spec))
    return load_instrument(path)


def hook() -> dict[str, Any]:
    """A tube with a bent end on a wrist joint."""
    box = [{"at_m": at, "radii_m": [0.001, 0.001], "centre_m": [0.001, 0]} for at in (0.0, 0.01)]
    spec = tube()
    spec["links"].append(
        {
            "name": "hook",
            "parent": "shaft",
            "alpha_rad": -1.57,
            "joint": "wrist_pitch",
            "shapes": [{"axis": "x", "sections": box}],
        }
    )
    return spec


def test_the_needle_driver_shows_everything() -> None:
    """So that nothing about it is scored otherwise than before."""
    assert load_instrument("large_needle_driver").observed.all()


def test_a_tube_shows_neither_joints_nor_its_roll(tmp_path: Path) -> None:
    instrument = load(tmp_path, tube())
    assert instrument.observable == frozenset()
    assert instrument.observed.tolist() == [True, False, True, True, True, True, False, False, False]
    again = load_instrument(save_instrument(instrument, tmp_path / "copy")[0])
    assert again.observable == frozenset()


def test_joints_that_move_nothing_are_not_there(tmp_path: Path) -> None:
    assert load(tmp_path, hook()).observable == {"roll", "wrist_pitch"}
    idle = hook()
    idle["links"].append({"name": "empty", "parent": "hook", "joint": "jaw"})
    assert load(tmp_path, idle).observable == {"roll", "wrist_pitch"}


def test_the_file_decides(tmp_path: Path) -> None:
    instrument = load(tmp_path, {**hook(), "observable": ["wrist_pitch"]})
    assert instrument.observable == {"wrist_pitch"}
    assert load_instrument(save_instrument(instrument, tmp_path / "copy")[0]).observable == {"wrist_pitch"}
    with pytest.raises(ConfigError, match="observable names 'jaw', which is the joint of no link"):
        load(tmp_path, {**tube(), "observable": ["jaw"]})


def test_round_is_round_wherever_its_rings_are() -> None:
    cylinder = trimesh.creation.cylinder(radius=0.004, height=0.1, sections=24)
    assert is_round(np.asarray(cylinder.vertices))
    assert is_round(np.asarray(trimesh.creation.annulus(0.002, 0.004, 0.1).vertices))
    assert not is_round(np.asarray(trimesh.creation.box([0.008, 0.008, 0.1]).vertices))
    assert not is_round(np.asarray(cylinder.vertices) + np.array([0.001, 0, 0]))


@given(roll=st.floats(-3, 3), joints=st.tuples(*[st.floats(-1, 1)] * 3))
@settings(max_examples=30, deadline=None)
def test_what_looks_the_same_has_no_error(
    tmp_path_factory: pytest.TempPathFactory, roll: float, joints: tuple[float, float, float]
) -> None:
    instrument = load(tmp_path_factory.mktemp("tube"), tube())
    truth = resting_state()[None]
    estimate = truth.copy()
    estimate[:, BETA] += roll
    estimate[:, JOINTS] = joints
    errors = pose_errors(instrument, CAMERA, estimate, truth)
    for name in POSE_ERRORS:
        if name[0] == "q":
            assert np.isnan(errors[name]).all()
        else:
            np.testing.assert_array_equal(errors[name], 0.0)


@given(
    off=st.tuples(st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(-0.5, 0.5)),
)
@settings(max_examples=30, deadline=None)
def test_what_is_left_of_the_rotation_is_the_angle_between_the_shafts(off: tuple[float, float, float]) -> None:
    truth = resting_state()
    estimate = truth + np.array([*off, 0, 0, 0, 0, 0, 0])
    observed = np.ones(9, dtype=bool)
    observed[BETA] = False
    chosen = choose_seen_alike(estimate, truth, observed)
    its, true = (look_at_rotation(state[:3])[:, 2] for state in (estimate, truth))
    expected = np.arctan2(np.linalg.norm(np.cross(its, true)), its @ true)
    between = look_at_rotation(truth[:3]).T @ look_at_rotation(chosen[:3])
    np.testing.assert_allclose(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1)), expected, atol=1e-6)
    np.testing.assert_array_equal(choose_seen_alike(estimate, truth, np.ones(9, dtype=bool)), estimate)


def test_intervals_and_readings_leave_out_what_is_not_seen(tmp_path: Path) -> None:
    instrument = load(tmp_path, tube())
    truth = resting_state()[None]
    estimate = truth + np.array([0, 1.0, 0, 0, 0, 0, 1, 1, 1])
    shares = interval_coverages(estimate, np.full(9, 0.01), truth, instrument.observed)
    assert [float(shares[f"interval_coverage{part}"][0]) for part in ("", "_rotation", "_translation")] == [1.0] * 3
    assert all(np.isnan(shares[f"interval_coverage_q{joint}"]).all() for joint in (1, 2, 3))
    off = reference_joint_errors(estimate, truth[:, JOINTS], instrument.search_limits, instrument.observed)
    assert np.isnan(off).all()


# --- what cannot be


def with_mesh(folder: Path, mesh: trimesh.Trimesh, **entry: Any) -> dict[str, Any]:
    mesh.export(str(folder / "body.stl"))
    spec = tube()
    spec["links"] = [{"name": "shaft", "mesh": {"path": "body.stl", **entry}}]
    spec["tips"] = [{"link": "shaft", "point_m": [0, 0, 0]}] * 2
    return spec


def test_millimetres_for_metres_are_refused_with_the_scale(tmp_path: Path) -> None:
    shaft = trimesh.creation.cylinder(radius=4.0, height=300.0, sections=12)
    with pytest.raises(ConfigError, match=r"body of link 'shaft' is 8 x 8 x 300 m, .* set 'scale: 0.001' under"):
        load(tmp_path, with_mesh(tmp_path, shaft))
    assert load(tmp_path, with_mesh(tmp_path, shaft, scale=0.001)).name == "tube"
    with pytest.raises(ConfigError, match=r"too small to be seen; .* set 'scale: 0.001' under"):
        load(tmp_path, with_mesh(tmp_path, shaft, scale=1e-6))
    jaw = trimesh.creation.box([0.9, 0.2, 0.2])  # centimetres
    with pytest.raises(ConfigError, match="too large for an instrument"):
        load(tmp_path, with_mesh(tmp_path, jaw))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"tips": [{"link": "shaft", "point_m": [1.5, 0, 10]}] * 2}, "further off than any instrument is long"),
        ({"tips": [{"link": "shaft", "point_m": [0.0015, 0, 0.03]}] * 2}, "is 20.0 mm off that link's body"),
        (
            {"links": [*tube()["links"], {"name": "yaw", "parent": "shaft", "a_m": 9.1}]},
            r"link 'yaw': 'a_m' is 9.1 m, .*\(0.0091 if it was millimetres\)",
        ),
        (
            {"joints": {**tube()["joints"], "jaw": {"search_rad": [0, 70], "generate_rad": [0, 30]}}},
            r"search_rad is \[0, 70\], more than a full turn; limits are radians \(\[0, 1.222\]",
        ),
        (
            {"joints": {**tube()["joints"], "jaw": {"search_rad": [0, 0.5], "generate_rad": [0, 0.7]}}},
            r"generate_rad \[0.0, 0.7\] must lie within search_rad \[0.0, 0.5\]",
        ),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        load(tmp_path, tube(**changes))
    assert "\n" not in str(caught.value)


def test_a_tip_within_a_thick_body_is_on_it(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    mesh = load(tmp_path, with_mesh(tmp_path, ball)).meshes["shaft"]
    assert distance_to_body(mesh, np.zeros(3)) == 0.0
    assert distance_to_body(mesh, np.array([0.0, 0.0, 0.03])) == pytest.approx(0.01, abs=2e-4)


def needs_pillow(*_: object, **__: object) -> None:
    raise ModuleNotFoundError("No module named 'PIL'", name="PIL")


@pytest.mark.parametrize("corner", ["{0}/{0}", "{0}//1", "{0}/{0}/1"], ids=["texture", "normals", "both"])
def test_textures_and_quads_need_no_further_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, corner: str
) -> None:
    monkeypatch.setattr("trimesh.visual.texture.TextureVisuals.__init__", needs_pillow)
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = ["mtllib body.mtl", "o body", *(f"v {x * 0.004} {y * 0.004} {z * 0.01}" for x, y, z in corners)]
    lines += [*(f"vt 0.{place} 0.5" for place in range(8)), "vn 0 0 1", "usemtl steel", "s off"]
    lines += ["f " + " ".join(corner.format(place) for place in quad) for quad in quads]
    (tmp_path / "body.obj").write_text("\n".join(lines) + "\n")
    spec = with_mesh(tmp_path, trimesh.creation.box([0.01] * 3))
    spec["links"][0]["mesh"]["path"] = "body.obj"
    assert len(load(tmp_path, spec).meshes["shaft"].faces) == 12


def test_a_package_that_is_missing_is_blamed_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = with_mesh(tmp_path, trimesh.creation.box([0.01] * 3))
    monkeypatch.setattr(trimesh, "load_mesh", needs_pillow)
    with pytest.raises(ConfigError, match=r"needs pillow, which is not installed: pip install pillow"):
        load(tmp_path, spec)
