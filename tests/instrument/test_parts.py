"""Parts of an instrument file: bodies of the stated lengths, bad input in a line, and the commands for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from commandline import surgbench
from pydantic import TypeAdapter

from surgbench.config import locate
from surgbench.errors import ConfigError
from surgbench.instrument import load_instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.parts import Part
from surgbench.instrument.parts_mesh import parts_mesh

PART: Any = TypeAdapter(Part)
WRIST = {
    "kind": "wrist", "length_m": 0.0091, "reach_m": 0.0015, "tongue_m": 0.0024, "width_m": 0.0063, "depth_m": 0.006,
    "belly_m": 0.0051, "tongue_width_m": 0.0055, "tongue_depth_m": 0.002, "slot_m": 0.0039, "slot_depth_m": 0.003,
    "end_width_m": 0.0045,
}  # fmt: skip
JAW: dict[str, Any] = {
    "kind": "jaw", "side": "left", "from_m": 0.002, "length_m": 0.02,
    "profile": [{"at": 0, "width_m": 0.005, "thickness_m": 0.0015}, {"at": 1, "width_m": 0.004, "gap_m": 0.0002}],
}  # fmt: skip
BAR = {
    "kind": "bar", "across": "z",
    "path": [{"point_m": [0, 0, 0], "width_m": 0.001, "thickness_m": 0.002}, {"point_m": [0, 0.01, 0]},
             {"point_m": [0.005, 0.01, 0]}],
}  # fmt: skip


def body(*parts: dict[str, Any]) -> LinkMesh:
    return parts_mesh([PART.validate_python(part) for part in parts])


def size(mesh: LinkMesh) -> list[float]:
    return [float(side) for side in np.ptp(mesh.vertices_m, axis=0)]


def volume(mesh: LinkMesh) -> float:
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert solid.is_watertight
    assert all(piece.volume > 0 for piece in solid.split(only_watertight=False))
    return float(solid.volume)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_jaw_has_the_stated_measures_on_its_side(side: str) -> None:
    mesh = body({**JAW, "side": side})
    assert size(mesh) == pytest.approx([0.0015, 0.018, 0.005], abs=1e-7)
    assert volume(mesh) == pytest.approx(0.0015 * 0.0045 * 0.018, rel=1e-4)
    towards = -1 if side == "left" else 1
    assert (towards * mesh.vertices_m[:, 0]).min() == pytest.approx(0.0002, abs=1e-7)


def test_a_hole_takes_its_volume_away() -> None:
    holes = [{"from_m": 0.005, "to_m": 0.009, "width_m": 0.002}, {"from_m": 0.011, "to_m": 0.018, "width_m": 0.0015}]
    straight = {**JAW, "profile": [{"at": 0, "width_m": 0.005, "thickness_m": 0.001}, {"at": 1}]}
    expected = 0.018 * 0.005
    for hole in holes:
        w, length = hole["width_m"], hole["to_m"] - hole["from_m"]
        expected -= w * (length - w) + np.pi / 4 * w * w
        # Rails reach a little into what lies before and behind.
        expected += 2 * 5e-5 * 0.005
    assert volume(body({**straight, "holes": holes})) == pytest.approx(0.001 * expected, rel=0.01)


def test_jaws_that_bend_bend_alike_and_blades_lie_on_their_own_sides() -> None:
    bent = {**JAW, "profile": [{**JAW["profile"][0], "curve_m": 0, "stagger_m": 0.0005}, {"at": 1, "curve_m": 0.003}]}
    left, right = body(bent), body({**bent, "side": "right"})

    def middle(mesh: LinkMesh, end: Any) -> float:
        z = mesh.vertices_m[mesh.vertices_m[:, 1] == end(mesh.vertices_m[:, 1]), 2]
        return float((z.min() + z.max()) / 2)

    assert (middle(left, np.min), middle(right, np.min)) == pytest.approx((0.0005, -0.0005), abs=1e-7)
    assert (middle(left, np.max), middle(right, np.max)) == pytest.approx((0.0035, 0.0025), abs=1e-7)


def test_a_bar_keeps_its_thickness_round_a_bend() -> None:
    mesh = body(BAR)
    assert size(mesh) == pytest.approx([0.006, 0.011, 0.001], abs=1e-7)
    # Two prisms that meet in the bend's plane: as long as the middle line.
    assert volume(mesh) == pytest.approx(0.001 * 0.002 * 0.015, rel=1e-4)


def test_wrist_tube_clevis_pin_and_pulley_have_the_stated_measures() -> None:
    assert size(body(WRIST)) == pytest.approx([0.013, 0.0063, 0.006], abs=1e-6)
    tube = body({"kind": "tube", "radius_m": 0.004, "from_m": -0.3, "to_m": 0.001, "nose_m": 0.005,
                 "nose_radius_m": 0.003})  # fmt: skip
    assert size(tube)[2] == pytest.approx(0.301)
    clevis = body({"kind": "clevis", "radius_m": 0.004, "gap_m": 0.006, "root_m": 0.006, "reach_m": 0.002})
    assert np.abs(clevis.vertices_m[:, 1]).min() == pytest.approx(0.003, abs=1e-7)
    assert np.hypot(*clevis.vertices_m[:, :2].T).max() < 0.0043
    pulley = body({"kind": "pulley", "side": "right", "radius_m": 0.0025, "from_m": 0.0003, "to_m": 0.002})
    assert pulley.vertices_m[:, 2].max() == pytest.approx(-0.0003)
    for mesh in (tube, clevis, pulley, body({"kind": "pin", "axis": "y", "radius_m": 0.001, "length_m": 0.01})):
        assert volume(mesh) > 0


# ---------------------------------------------------------------------------------------------- bad input


def written(folder: Path, name: str = "cadiere_forceps", **changes: Any) -> Path:
    """A file of the catalogue with some values changed, by dotted keys with ``__`` for the dots."""
    spec = yaml.safe_load(locate("instruments", "instrument", name).read_text())
    for key, value in changes.items():
        *path, last = key.split("__")
        here: Any = spec
        for part in path:
            here = here[int(part) if part.isdigit() else part]
        if last.isdigit():
            here[int(last)] = value
        else:
            here[last] = value
    file = folder / "mine.yaml"
    file.write_text(yaml.safe_dump(spec))
    return file


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"links__3__parts__1__holes": [{"from_m": 0.006, "to_m": 0.018, "width_m": 0.0052}]},
         r"'links.3.parts.1.jaw': the hole from 6 mm to 18 mm is 5.2 mm wide, and the jaw only 5.2 mm .* nothing"),
        ({"links__3__parts__1__holes": [{"from_m": 0.012, "to_m": 0.022, "width_m": 0.002}]}, "does not lie within"),
        ({"links__3__parts__1__holes": [{"from_m": 0.012, "to_m": 0.013, "width_m": 0.002}]}, "its ends are round"),
        ({"links__3__parts__1__lenght_m": 0.02},
         r"unknown key 'links.3.parts.1.jaw.lenght_m'; did you mean 'length_m'"),
        ({"links__3__parts__1__kind": "jow"}, r"'links.3.parts.1': .*'jow'.*'jaw'"),
        ({"links__3__parts__1__profile__0__at": 0.01}, "profile goes from at: 0 to at: 1"),
        ({"links__1__parts__0__slot_m": 0.005}, r"slot_m < end_width_m"),
        ({"links__0__parts__0__to_m": -0.33}, "has no length"),
        ({"links__0__parts__1__gap_m": 0.0081}, "leave nothing of a shaft of 8.3 mm"),
        ({"links__3__parts__0__chamfer_m": 0.001}, "no room for chamfers"),
        ({"links__0__shapes": [{"axis": "z", "sections": [{"at_m": at, "radii_m": [1, 1]} for at in (0, 1)]}]},
         "both 'shapes' and 'parts'; give one"),
        ({"links__1__parts": [BAR | {"path": [*BAR["path"][:2], {"point_m": [0.0005, 0.01, 0]},
                                              {"point_m": [0.0005, 0.002, 0]}]}]},
         r"link 'wrist': part 1 \(bar\) is no closed body: it folds over itself about"),
        ({"links__0__parts__0__radius_m": 4.15, "links__0__parts__0__nose_radius_m": 3.5}, "lengths are metres"),
    ],
)  # fmt: skip
def test_what_makes_no_body_is_one_line(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    file = written(tmp_path, **changes)
    with pytest.raises(ConfigError, match=told) as caught:
        load_instrument(file)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(file))


# --------------------------------------------------------------------------------------------- the commands


@pytest.mark.parametrize("name", ["monopolar_curved_scissors", "suction_irrigator"])
def test_show_draws_a_picture(name: str, tmp_path: Path) -> None:
    out = tmp_path / "tool.png"
    surgbench("instrument", "show", name, "--out", out)
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.shape[1] == 1500
    assert 0.5 < np.mean(picture == 255) < 0.98


def test_show_takes_a_file_and_asks_for_a_png(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("instrument", "show", written(tmp_path), "--out", tmp_path / "mine.png")
    assert (tmp_path / "mine.png").stat().st_size > 10_000
    surgbench("instrument", "show", "cadiere_forceps", "--out", tmp_path / "mine.jpg", expect=2)
    assert "expected a file FILE.png" in capsys.readouterr().err


def test_check_measures_as_with_a_ruler(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("instrument", "check", "cadiere_forceps")
    said = " ".join(capsys.readouterr().out.split())
    assert "shaft 8.3 mm across, 326 mm long" in said
    assert "wrist 9.1 mm from the pitch to the yaw axis" in said
    assert "jaw_left 19.9 mm from its axis to its end; half-way to the tip 5.2 mm along that axis" in said
    assert "on its body" in said
    assert "symmetry twin; its silhouettes overlap by 1.00" in said
    assert said.endswith("nothing is wrong with it")


def test_check_says_all_that_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block = trimesh.creation.box([0.004, 0.004, 0.02])
    block.apply_translation([0, 0, 0.02])
    block.invert()
    block.export(str(tmp_path / "shaft.stl"))
    open_ = trimesh.creation.box([0.004] * 3)
    open_.update_faces(np.arange(12) > 0)
    open_.export(str(tmp_path / "wrist.stl"))
    file = written(tmp_path, tips__0__point_m=[0.0, 0.03, 0.0])
    spec = yaml.safe_load(file.read_text())
    for index, mesh in ((0, "shaft.stl"), (1, "wrist.stl")):
        del spec["links"][index]["parts"]
        spec["links"][index]["mesh"] = {"path": mesh}
    file.write_text(yaml.safe_dump(spec))
    surgbench("instrument", "check", file, expect=2)
    captured = capsys.readouterr()
    assert "shaft.stl of link 'shaft' faces inward" in captured.out
    assert "wrong: " in captured.out
    assert "lies ahead of the pitch axis" in captured.out
    assert "is not closed" in captured.out
    assert "10.1 mm off that link's body" in captured.out
    assert captured.err.endswith("3 things are wrong with it (see above)\n")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"symmetry": "none"}, "'symmetry' is none, and its silhouettes are those of 'twin'"),
        ({"symmetry": "axis"}, "'symmetry' is axis, and its silhouettes are those of 'twin'"),
    ],
)
def test_check_sees_a_symmetry_that_is_not(
    tmp_path: Path, changes: dict[str, Any], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench("instrument", "check", written(tmp_path, **changes), expect=2)
    assert told in capsys.readouterr().out


def test_a_misspelt_name_gets_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("instrument", "check", "cadiere_forcep", expect=2)
    assert "did you mean 'cadiere_forceps'?" in capsys.readouterr().err


def test_the_list_has_a_line_for_each(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("list", "instruments")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 13
    hook = next(line for line in lines if line.startswith("permanent_cautery_hook"))
    assert hook.split(maxsplit=1)[1] == "shaft 8.3 mm, wrist 9.3 mm, end 18.1 mm, symmetry none"
