"""Camera files as labs have them: each of one camera, each read as that camera, or answered with one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from commandline import surgbench
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.camera.files import find_camera, read_camera
from surgbench.camera.options import CameraOptions
from surgbench.dataset.open import open_as
from surgbench.errors import ConfigError, DatasetError
from surgbench.generators.presets import load_preset
from surgbench.tasks.instrument.dataset import InstrumentDataset

K = [[905.955, 0.0, 294.28], [0.0, 904.82, 238.699], [0.0, 0.0, 1.0]]
CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.82, cx=294.28, cy=238.699)
LENS = CAMERA.model_copy(update={"distortion": (-0.25, 0.5, -0.002, -0.004, -0.2)})
FISHEYE = CAMERA.model_copy(
    update={"fx": 420.0, "fy": 421.5, "distortion": (-0.02, 0.01, -0.005, 0.001), "distortion_model": "fisheye"}
)
ROS_NAMES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial", 12: "rational_polynomial"}


def matrix(camera: Camera) -> dict[str, Any]:
    """As ROS writes it."""
    return {"rows": 3, "cols": 3, "data": camera.matrix.ravel().tolist()}


def own(camera: Camera) -> str:
    return camera.model_dump_json(indent=1)


def with_mark(camera: Camera) -> str:
    return "\ufeff" + own(camera)


def with_whole_floats(camera: Camera) -> str:
    return json.dumps({**camera.model_dump(), "width": float(camera.width), "height": float(camera.height)})


def ros_yaml(camera: Camera) -> str:
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": "left",
        "camera_matrix": matrix(camera),
        "distortion_model": "equidistant"
        if camera.distortion_model == "fisheye"
        else ROS_NAMES.get(len(camera.distortion), "plumb_bob"),
        "distortion_coefficients": {"rows": 1, "cols": len(camera.distortion), "data": list(camera.distortion)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
    }
    return yaml.safe_dump(content)


def ros_echo(camera: Camera) -> str:
    content = {
        "header": {"seq": 3, "frame_id": "left_frame"},
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "equidistant" if camera.distortion_model == "fisheye" else "plumb_bob",
        "D": list(camera.distortion),
        "K": camera.matrix.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": [0.0] * 12,
        "binning_x": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "do_rectify": False},
    }
    return yaml.safe_dump(content, sort_keys=False) + "---\n"


def ros_echoes(camera: Camera) -> str:
    """As it is printed until it is interrupted, here amid a message."""
    one = ros_echo(camera)
    return one + one.replace("seq: 3", "seq: 4") + "\n".join(one.splitlines()[:6])


def opencv(suffix: str, names: tuple[str, str] = ("camera_matrix", "distortion_coefficients")) -> Callable[..., str]:
    def text(camera: Camera) -> str:
        storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write("calibration_time", "Tue 01 Mar 2022")
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("fisheye_model", int(camera.distortion_model == "fisheye"))
        storage.write(names[0], camera.matrix)
        if camera.distortion:
            storage.write(names[1], np.array(camera.distortion))
        storage.write("avg_reprojection_error", 0.3)
        return str(storage.releaseAndGetString())

    return text


FORMATS: dict[str, Callable[[Camera], str]] = {
    "own": own,
    "byte order mark": with_mark,
    "whole floats": with_whole_floats,
    "ROS's calibration": ros_yaml,
    "ROS's message": ros_echo,
    "ROS's messages": ros_echoes,
    "OpenCV's YAML": opencv("c.yaml"),
    "OpenCV's XML": opencv("c.xml"),
    "OpenCV's JSON": opencv("c.json"),
    "other names": opencv("c.yaml", ("cameraMatrix", "dist_coeffs")),
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("camera", [CAMERA, LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_every_format_is_told_by_its_content(tmp_path: Path, form: str, camera: Camera) -> None:
    """The name says nothing: it is the same for all."""
    (tmp_path / "camera.json").write_text(FORMATS[form](camera), encoding="utf-8")
    said: list[str] = []
    read = read_camera(tmp_path / "camera.json", (700, 493), say=said.append)
    np.testing.assert_allclose(read.matrix, camera.matrix, rtol=1e-12)
    assert (read.width, read.height) == (700, 493)
    assert read.distortion_model == camera.distortion_model
    assert read.is_distorted == camera.is_distorted
    if camera.is_distorted:
        np.testing.assert_allclose(read.distortion, camera.distortion, rtol=1e-12)
    assert said[0].startswith("camera.json: ")
    assert "700x493 pixels" in said[0]


@settings(max_examples=25)
@given(st.sampled_from(sorted(FORMATS)), st.sampled_from([4, 5, 8, 12, 14]), st.data())
def test_whatever_the_numbers(
    tmp_path_factory: pytest.TempPathFactory, form: str, count: int, data: st.DataObject
) -> None:
    small = st.floats(-0.02, 0.02).filter(lambda value: value == 0 or abs(value) > 1e-9)
    focal = data.draw(st.floats(700, 3000))
    camera = Camera(
        width=data.draw(st.integers(640, 1920)),
        height=data.draw(st.integers(480, 1080)),
        fx=focal * data.draw(st.floats(0.9, 1.1)),
        fy=focal,
        cx=data.draw(st.floats(64, 900)),
        cy=data.draw(st.floats(200, 700)),
        distortion=tuple(data.draw(small) for _ in range(count)),
    )
    path = tmp_path_factory.mktemp("any") / "camera"
    path.write_text(FORMATS[form](camera), encoding="utf-8")
    read = read_camera(path, model="opencv")
    np.testing.assert_allclose(read.matrix, camera.matrix, rtol=1e-12)
    np.testing.assert_allclose(read.distortion, camera.distortion, rtol=1e-12)
    assert (read.width, read.height) == (camera.width, camera.height)


def npy(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.array(K))


def npz(path: Path) -> None:
    """As the tutorials of OpenCV keep what ``calibrateCamera`` gives."""
    with path.open("wb") as file:
        np.savez(file, mtx=np.array(K), dist=np.array([LENS.distortion]))


@pytest.mark.parametrize(
    "write",
    [
        npy,
        npz,
        lambda path: path.write_text(json.dumps(K)),
        lambda path: path.write_text(json.dumps({"K": K})),
        lambda path: path.write_text(yaml.safe_dump(K)),
        lambda path: path.write_text("camera_matrix:\n- [905.955, 0, 294.28]\n- [0, 904.82, 238.699]\n- [0, 0, 1]\n"),
        lambda path: path.write_text("# K\n905.955 0 294.28\n0 904.82 238.699\n0 0 1\n"),
        lambda path: path.write_text(str(np.array(K))),
        lambda path: path.write_bytes("905.955,0,294.28\r\n0,904.82,238.699\r\n0,0,1".encode("utf-16")),
    ],
)
def test_a_matrix_alone_is_that_of_the_pictures(tmp_path: Path, write: Callable[[Path], Any]) -> None:
    path = tmp_path / "K.any"
    write(path)
    said: list[str] = []
    read = read_camera(path, (700, 493), say=said.append)
    np.testing.assert_allclose(read.matrix, K, rtol=1e-6)
    assert "(the pictures' size: it says none)" in said[0]
    # Of pictures half as large, only if that is said.
    with pytest.raises(
        DatasetError, match=r"principal point .* is far from the middle of pictures of 350x246; .* --camera-s"
    ):
        read_camera(path, (350, 246))
    half = read_camera(path, (350, 246), calibrated_at=(700, 493), say=said.append)
    np.testing.assert_allclose(half.matrix[:2], CAMERA.resized(350, 246).matrix[:2], rtol=1e-6)
    assert any("calibrated at 700x493, scaled to the pictures' 350x246" in line for line in said)
    with pytest.raises(DatasetError, match="says no size of the pictures; say it with --camera-size WIDTHxHEIGHT"):
        read_camera(path)


def test_another_size_is_scaled_and_another_shape_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(own(LENS.resized(1400, 986)))
    said: list[str] = []
    np.testing.assert_allclose(read_camera(path, (700, 493), say=said.append).matrix, LENS.matrix, rtol=1e-12)
    assert "camera.json: calibrated at 1400x986, scaled to the pictures' 700x493: fx 905.9" in said[1]
    with pytest.raises(
        DatasetError, match="calibrated at 1400x986, and the pictures are 640x480: another aspect ratio"
    ):
        read_camera(path, (640, 480))
    with pytest.raises(DatasetError, match="says 1400x986 pixels, and --camera-size 700x493"):
        read_camera(path, calibrated_at=(700, 493))


@pytest.mark.parametrize(
    ("calibrated", "pictures"), [((700, 493), (700, 492)), ((700, 493), (700, 494)), ((701, 493), (700, 492))]
)
def test_what_an_encoder_made_even_has_the_same_lens(
    tmp_path: Path, calibrated: tuple[int, int], pictures: tuple[int, int]
) -> None:
    camera = LENS.model_copy(update={"width": calibrated[0], "height": calibrated[1]})
    (tmp_path / "camera.json").write_text(own(camera))
    said: list[str] = []
    read = read_camera(tmp_path / "camera.json", pictures, say=said.append)
    assert read == camera.model_copy(update={"width": pictures[0], "height": pictures[1]})
    assert "as encoders want even sizes" in said[1]


def test_four_coefficients_of_a_wide_lens_may_be_a_fisheyes(tmp_path: Path) -> None:
    wide = FISHEYE.model_copy(update={"distortion_model": "opencv"})
    path = tmp_path / "camera.json"
    path.write_text(own(wide))
    with pytest.raises(DatasetError, match="k1, k2, p1, p2, or k1 to k4 of a fisheye\\? Say --distortion-model"):
        read_camera(path)
    assert read_camera(path, model="opencv") == wide
    assert read_camera(path, model="fisheye") == FISHEYE
    # A narrow one is taken for what it usually is, and that is said.
    path.write_text(own(CAMERA.model_copy(update={"distortion": FISHEYE.distortion})))
    said: list[str] = []
    assert read_camera(path, say=said.append).distortion_model == "opencv"
    assert "taken as k1, k2, p1, p2 (of a fisheye: --distortion-model fisheye)" in said[0]
    path.write_text(own(FISHEYE))
    with pytest.raises(DatasetError, match="says distortion_model 'fisheye', and --distortion-model says 'opencv'"):
        read_camera(path, model="opencv")


def ros_with(**changes: Any) -> str:
    return yaml.safe_dump({**yaml.safe_load(ros_yaml(LENS)), **changes})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no camera file (keys: width, height, fx, fy, cx, cy; or camera_matrix; or nine numbers of K)"),
        ("{", "not valid JSON"),
        ("camera_matrix: [1, 2", "not valid YAML"),
        ("[" * 100_000, "not valid JSON (nested more than 100 deep)"),
        (ros_echo(CAMERA) + ros_echo(LENS), "holds several cameras, one after the other"),
        ("%YAML:1.0\n---\na: [1, 2\nb: : :", "not valid YAML or XML of OpenCV"),
        ("[1, 2, 3]", "'K' must be 9 numbers, not 3"),
        ('{"K": [[1, 0], [0, 1]]}', "'camera_matrix' must be 9 numbers, not 4"),
        ('{"K": "wide"}', "'camera_matrix' must be numbers"),
        (json.dumps({"K": np.array(K).T.tolist()}), "'camera_matrix' is transposed"),
        (json.dumps({"K": [900, 7, 300, 0, 900, 200, 0, 0, 1]}), "must be [fx 0 cx; 0 fy cy; 0 0 1], not [900 7 300;"),
        (json.dumps({"M1": K, "D1": [0] * 5, "M2": K, "D2": [0] * 5}), "has M1 and M2, but no 'camera_matrix'"),
        (
            json.dumps({"K": K, "camera_matrix": np.eye(3).tolist()}),
            "has both 'K' and 'camera_matrix', and they differ",
        ),
        (json.dumps({"K": K, "fx": 3.0}), "'fx' is 3.0, and 905.955 in K"),
        (ros_with(distortion_model="fish"), "unknown distortion_model 'fish'; did you mean"),
        (ros_with(distortion_model="equidistant"), "'distortion' must have 4 coefficients, k1 to k4"),
        (ros_with(distortion_coefficients={"data": [0.1, 0.2]}), "must have 4, 5, 8, 12 or 14 coefficients"),
        (ros_with(distortion_coefficients=None, distortion_coefs=[0.1] * 5), "unknown key 'distortion_coefs'; did you"),
        (ros_with(binning_x=2), "'binning_x' is 2: pictures are not those of K"),
        (ros_with(roi={"x_offset": 8, "y_offset": 0}), "'roi' is a part of the picture"),
        (ros_with(camera_matrix={"data": [0.0] * 8 + [1.0]}), "'fx': input should be greater than 0"),
        (own(CAMERA).replace("905.955", "NaN"), "'fx': "),
        (own(CAMERA).replace("905.955", "-905.955"), "'fx': input should be greater than 0, not -905.955"),
        (json.dumps({"K": K}).replace("905.955", "NaN"), "'camera_matrix' must be finite numbers, not nan"),
        (
            own(CAMERA).replace("905.955", "4.5"),
            "fx is 4.5 where pictures are 700 wide; plausible is 70 to 14000 (pixels",
        ),
        (own(CAMERA).replace("905.955", "1e300"), "fx is 1e+300 where pictures are 700 wide; plausible is 70 to 14000"),
        (own(CAMERA).replace("904.82", "90.482"), "fy is 90.482 where fx is 905.955; plausible is 452.978 to 1811.91"),
        (own(CAMERA).replace("294.28", "29428"), "cx is 29428 where pictures are 700 wide; plausible is about 350"),
        (own(CAMERA).replace("238.699", "-900"), "cy is -900 where pictures are 493 high; plausible is about 246.5"),
        (own(LENS).replace("0.5", "1e300"), "a distortion coefficient is 1e+300"),
        (
            own(LENS).replace("-0.25", "-25"),
            "the lens sees 4 % of the picture (its model folds the picture over beyond",
        ),
        (own(CAMERA).replace('"width": 700', '"width": 700.5'), "'width': input should be a valid integer"),
        (own(CAMERA).replace('"fx"', '"f_x"'), "unknown key 'f_x'; did you mean 'fx'?"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.any"
    path.write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_camera(path, (700, 493))
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert message in line
    assert "\n" not in line


def test_what_is_no_text_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "camera.npy"
    for data in (b"\x93NUMPY\x01", b"PK\x03\x04broken", b"\x89PNG\r\n\xff"):
        path.write_bytes(data)
        with pytest.raises(DatasetError, match=r"^[^\n]+: (not valid NumPy|no camera file)[^\n]*$"):
            read_camera(path)
    with pytest.raises(DatasetError, match=r"none\.json: camera file is missing"):
        read_camera(tmp_path / "none.json")
    with pytest.raises(DatasetError, match="camera file cannot be read"):
        read_camera(tmp_path)


def test_the_camera_file_of_a_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"camera\.json: camera file is missing .* elsewhere: --camera FILE"):
        find_camera(tmp_path)
    (tmp_path / "notes.txt").write_text("9 sutures")
    (tmp_path / "patient.yaml").write_text("age: 9\n")
    (tmp_path / ".hidden.yaml").write_text(ros_yaml(CAMERA))
    (tmp_path / "left.yaml").write_text(ros_yaml(CAMERA))
    assert find_camera(tmp_path).name == "left.yaml"
    (tmp_path / "right.yaml").write_text(ros_yaml(LENS))
    with pytest.raises(DatasetError, match=r"holds 2 cameras \(left.yaml, right.yaml\); say which with --camera FILE"):
        find_camera(tmp_path)
    (tmp_path / "camera.json").write_text("{")
    assert find_camera(tmp_path).name == "camera.json"
    # What is called a camera and is damaged is not called missing.
    for name in ("camera.json", "left.yaml", "right.yaml"):
        (tmp_path / name).unlink()
    (tmp_path / "camera_info.yaml").write_text("camera_matrix: [1, 2")
    with pytest.raises(DatasetError, match=r"camera_info\.yaml: not valid YAML"):
        read_camera(find_camera(tmp_path))


def test_options(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(own(CAMERA))
    assert CameraOptions().read(tmp_path, (700, 493)) == CAMERA
    for options, message in (
        (CameraOptions(camera_size="700"), "--camera-size: must be WIDTHxHEIGHT, for example 1400x986, not '700'"),
        (
            CameraOptions(distortion_model="fisheyes"),
            "--distortion-model: unknown distortion_model 'fisheyes'; did you",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            options.read(tmp_path, None)


def recording(root: Path, camera: Camera, text: str, name: str) -> Path:
    """Two discs as the camera sees them, where they are undistorted: (200, 150) and (500, 350)."""
    straight = np.array([[200.0, 150.0], [500.0, 350.0]])
    pixels = camera.lens.distort(straight)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    for pixel in pixels:
        cv2.circle(picture, tuple(np.rint(pixel * 16).astype(int).tolist()), 9 * 16, 255, -1, cv2.LINE_8, 4)
    (root / "masks").mkdir(parents=True)
    (root / "masks" / "000000.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    (root / "tips.csv").write_text(
        "frame,u1,v1,u2,v2\n0," + ",".join(f"{value:.4f}" for value in pixels.ravel()) + "\n"
    )
    (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("camera", "text", "options"),
    [
        (LENS, ros_yaml(LENS), ()),
        (LENS, opencv("c.yaml")(LENS), ()),
        (FISHEYE, ros_yaml(FISHEYE), ()),
        (
            FISHEYE,
            own(FISHEYE.model_copy(update={"distortion_model": "opencv"})),
            ("--distortion-model", "equidistant"),
        ),
    ],
)
def test_recordings_are_imported_with_their_labs_camera(
    tmp_path: Path, camera: Camera, text: str, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    source = recording(tmp_path / "lab", camera, text, "camera_info.yaml")
    surgbench("import", "masks", source, "--out", tmp_path / "out", *options)
    assert "camera_info.yaml: " in capsys.readouterr().err
    dataset = open_as(InstrumentDataset, tmp_path / "out")
    sequence = dataset.sequences[0]
    assert sequence.camera == camera.pinhole
    assert dataset.manifest.configuration["source_camera"] == camera.model_dump(mode="json")
    np.testing.assert_allclose(sequence.keypoints("left")[0], [[200, 150], [500, 350]], atol=0.001)
    _, _, _, centres = cv2.connectedComponentsWithStats(sequence.mask("left", 0).astype(np.uint8))
    np.testing.assert_allclose(np.asarray(centres)[1:], [[200, 150], [500, 350]], atol=1.0)


def test_tips_that_no_undistorted_picture_holds_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = recording(tmp_path / "lab", FISHEYE, ros_yaml(FISHEYE), "camera_info.yaml")
    (source / "tips.csv").write_text("frame,u1,v1,u2,v2\n0,2,2,294,239\n")
    surgbench("import", "masks", source, "--out", tmp_path / "out")
    assert "tips.csv: 1 tips lie outside of what an undistorted picture holds" in capsys.readouterr().err
    tips = open_as(InstrumentDataset, tmp_path / "out").sequences[0].keypoints("left")[0]
    assert np.isnan(tips[0]).all()
    np.testing.assert_allclose(tips[1], [294, 239], atol=0.1)


def test_a_camera_that_lies_elsewhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = recording(tmp_path / "lab", CAMERA, "nothing", "readme.md")
    surgbench("import", "masks", source, "--out", tmp_path / "out", expect=2)
    assert "camera file is missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "K.txt").write_text(str(np.array(K)))
    surgbench("import", "masks", source, "--out", tmp_path / "out", "--camera", tmp_path / "K.txt")
    said = capsys.readouterr().err
    assert "K.txt: a matrix K, 700x493 pixels" in said
    assert "(the pictures' size: it says none)" in said
    np.testing.assert_allclose(open_as(InstrumentDataset, tmp_path / "out").sequences[0].camera.matrix, K, rtol=1e-6)


def test_presets_have_plausible_cameras(tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    for camera, message in (
        ({**CAMERA.model_dump(), "fx": 4.5}, "camera.fx is 4.5 where pictures are 700 wide"),
        ({**CAMERA.model_dump(), "fy": 1e300}, "camera.fy is 1e"),
    ):
        path.write_text(f"name: x\npairs: 1\nframes: 3\ncamera: {json.dumps(camera)}\n")
        with pytest.raises(ConfigError, match=message):
            load_preset(path)
