from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import NotFoundError, SurgbenchError
from surgbench.exchange.masks import import_masks
from surgbench.recordings.coding import Told
from surgbench.tasks.instrument.dataset import InstrumentDataset

CAMERA: dict[str, Any] = {"width": 40, "height": 30, "fx": 60.0, "fy": 61.0, "cx": 19.0, "cy": 14.5}
FRAMES = 3


def blob(frame: int) -> np.ndarray:
    mask = np.zeros((30, 40), np.uint8)
    mask[10 : 16 + frame, : 20 + frame] = 255
    return mask


def write_png(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


@pytest.fixture
def source(tmp_path: Path) -> Path:
    root = tmp_path / "knot tying"
    for frame in range(FRAMES):
        write_png(root / "masks" / f"{frame:06d}.png", blob(frame))
    (root / "camera.json").write_text(json.dumps(CAMERA))
    return root


@pytest.fixture
def full(source: Path) -> Path:
    """With images, joints and tips."""
    for frame in range(FRAMES):
        picture = np.zeros((30, 40, 3), np.uint8)
        picture[..., 2] = 10 * frame + 5  # red, in OpenCV's order
        write_png(source / "images" / f"{frame:06d}.png", picture)
    (source / "joints.csv").write_text(
        "frame,wrist_pitch,wrist_yaw,half_jaw\n0,0.1,0.2,0.3\n1,0.1,0.2,-0.05\n2,0.3,0.2,0.3\n"
    )
    (source / "tips.csv").write_text("frame,u1,v1,u2,v2\n0,20,12,21,14\n2,22,12,,\n")
    return source


def test_masks_become_a_dataset_without_truth(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done: list[float] = []
    assert import_masks(source, out, fps=25.0, progress=done.append) == FRAMES
    assert sum(done) == FRAMES
    assert validate(out) == []
    dataset = open_as(InstrumentDataset, out)
    assert dataset.name == "knot-tying"
    assert [(unit.id, unit.arms, unit.kind) for unit in dataset.units()] == [("000", ("left",), "left")]
    sequence = dataset.sequences[0]
    assert sequence.camera == Camera(**CAMERA)
    assert sequence.states("left") is None
    assert sequence.readings("left") is None
    assert sequence.image(0) is None
    assert np.isnan(sequence.keypoints("left")).all()
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.04, 0.08])
    for frame in range(FRAMES):
        assert np.array_equal(sequence.mask("left", frame), blob(frame) > 0)
    assert not (out / "truth").exists()
    assert sequence.entry.source_frames == ("000000", "000001", "000002")
    with pytest.raises(SurgbenchError, match="sequence '000' has no ground truth"):
        sequence.clean_mask("left", 0)


def test_what_is_damaged_while_it_is_imported_is_not_blessed(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    file = "sequences/000/observed/left/000000.png"

    def damage(_: float) -> None:
        written = tmp_path / ".out.importing" / file
        written.write_bytes(written.read_bytes()[:-1])

    import_masks(source, out, progress=damage)
    (problem,) = validate(out)
    assert problem.startswith(f"{out / file}: truncated, ")
    assert not list(tmp_path.glob(".out*"))


def test_images_joints_and_tips(full: Path, tmp_path: Path) -> None:
    import_masks(full, tmp_path / "out", arm="right", name="real")
    assert validate(tmp_path / "out") == []
    dataset = open_as(InstrumentDataset, tmp_path / "out")
    sequence = dataset.sequences[0]
    assert (dataset.name, sequence.arms) == ("real", ("right",))
    image = sequence.image(2)
    assert image is not None
    assert image[0, 0].tolist() == [25, 0, 0]
    np.testing.assert_array_equal(sequence.readings("right"), [[0.1, 0.2, 0.3], [0.1, 0.2, -0.05], [0.3, 0.2, 0.3]])
    tips = sequence.keypoints("right")
    np.testing.assert_array_equal(tips[0], [[20, 12], [21, 14]])
    assert np.isnan(tips[1]).all()
    np.testing.assert_array_equal(tips[2], [[22, 12], [np.nan, np.nan]])


def test_single_images_are_sequences_of_their_own(full: Path, tmp_path: Path) -> None:
    (full / "masks" / "000001.png").rename(full / "masks" / "frame_12.png")
    (full / "images" / "000001.png").rename(full / "images" / "12.png")
    for table in ("joints.csv", "tips.csv"):
        text = (full / table).read_text()
        (full / table).write_text(text.replace("\n1,", "\n12,"))
    import_masks(full, tmp_path / "out", single_images=True)
    assert validate(tmp_path / "out") == []
    dataset = open_as(InstrumentDataset, tmp_path / "out")
    assert [(s.id, s.frames) for s in dataset.sequences] == [("000000", 1), ("000002", 1), ("000012", 1)]
    assert [unit.id for unit in dataset.units()] == ["000000", "000002", "000012"]
    np.testing.assert_array_equal(dataset.sequence("000012").readings("left"), [[0.1, 0.2, -0.05]])
    assert np.array_equal(dataset.sequence("000012").mask("left", 0), blob(1) > 0)


def test_the_first_frame_may_have_any_number(source: Path, tmp_path: Path) -> None:
    (source / "masks" / "000000.png").unlink()
    import_masks(source, tmp_path / "out")
    sequence = open_as(InstrumentDataset, tmp_path / "out").sequences[0]
    assert np.array_equal(sequence.mask("left", 0), blob(1) > 0)


def test_the_same_recording_gives_the_same_bytes(full: Path, tmp_path: Path) -> None:
    hashes = []
    for name in ("a", "b"):
        import_masks(full, tmp_path / name)
        hashes.append(open_as(InstrumentDataset, tmp_path / name).hash)
    assert hashes[0] == hashes[1]


def test_distorted_recordings_are_undistorted(full: Path, tmp_path: Path) -> None:
    distorted = Camera(**CAMERA, distortion=(-0.4, 0.1, 0.0, 0.0, 0.0))
    (full / "camera.json").write_text(distorted.model_dump_json())
    (full / "tips.csv").write_text("frame,u1,v1,u2,v2\n0,35,25,19,14.5\n")
    # A disc about (35, 25) as the distorting camera sees it.
    picture = np.zeros((30, 40), np.uint8)
    cv2.circle(picture, (35, 25), 2, 255, -1)
    write_png(full / "masks" / "000000.png", picture)
    import_masks(full, tmp_path / "out")
    dataset = open_as(InstrumentDataset, tmp_path / "out")
    assert dataset.manifest.configuration["undistorted"] is True
    assert dataset.manifest.configuration["source_camera"]["distortion"] == [-0.4, 0.1, 0.0, 0.0, 0.0]
    sequence = dataset.sequences[0]
    assert sequence.camera.distortion == ()
    outer, centre = sequence.keypoints("left")[0]
    np.testing.assert_allclose(centre, [19, 14.5], atol=1e-6)
    assert outer[0] > 35.3
    assert outer[1] > 25.2
    rows, columns = np.nonzero(sequence.mask("left", 0))
    np.testing.assert_allclose([columns.mean(), rows.mean()], outer, atol=0.6)


# Everything that can be wrong


def remove(name: str) -> Callable[[Path], Any]:
    return lambda source: (source / name).unlink()


def put(name: str, text: str) -> Callable[[Path], Any]:
    return lambda source: (source / name).write_text(text)


def empty_masks(source: Path) -> None:
    for path in (source / "masks").iterdir():
        path.unlink()


def no_masks(source: Path) -> None:
    empty_masks(source)
    (source / "masks").rmdir()


def camera_without(key: str) -> Callable[[Path], Any]:
    return put("camera.json", json.dumps({name: value for name, value in CAMERA.items() if name != key}))


def truncate(name: str) -> Callable[[Path], Any]:
    return lambda source: (source / name).write_bytes((source / name).read_bytes()[:-9])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (no_masks, "masks: missing; expected a folder of masks"),
        (empty_masks, "masks: holds no masks"),
        (
            lambda s: write_png(s / "masks/000001.png", np.zeros((30, 41), np.uint8)),
            "000001.png: is 41x30 pixels; the first mask is 40x30",
        ),
        (truncate("masks/000001.png"), "000001.png: truncated or damaged PNG"),
        (
            lambda s: (s / "masks/000003.bmp").write_bytes(b"BM"),
            "masks/000003.bmp: is neither PNG nor JPEG, as others there are",
        ),
        (lambda s: (s / "masks/000003.png").symlink_to(s / "nowhere"), "masks/000003.png: leads nowhere"),
        (lambda s: (s / "masks/000003.png").mkdir(), "masks/000003.png: is no file; masks must be files"),
        (
            lambda s: write_png(s / f"masks/{2**63}.png", blob(0)),
            f"masks/{2**63}.png: its number is too large for a frame's",
        ),
        (put("masks/000001.png", "text"), "000001.png: not a PNG or JPEG file"),
        (lambda s: write_png(s / "masks/last.png", blob(0)), "last.png: its name must hold the frame's number"),
        (lambda s: write_png(s / "masks/m1.png", blob(0)), "m1.png: is frame 1, and so is 000001.png"),
        (remove("camera.json"), "camera.json: camera file is missing"),
        (put("camera.json", "{"), "camera.json: not valid JSON"),
        (camera_without("fx"), "camera.json: key 'fx' is missing"),
        (put("camera.json", json.dumps({**CAMERA, "fx": "wide"})), "camera.json: 'fx'"),
        (
            put("camera.json", json.dumps({**CAMERA, "distortion": [0.1]})),
            "camera.json: 'distortion' must have 4, 5, 8",
        ),
        (remove("images/000002.png"), "images: the image of frame 2 is missing"),
        (lambda s: write_png(s / "images/000001.png", np.zeros((29, 40, 3), np.uint8)), "000001.png: is 40x29 pixels"),
        (
            put("joints.csv", "frame,q1,q2,q3\n0,0,0,0\n2,0,0,0\n"),
            "joints.csv: frame 1 is missing; every mask needs a row",
        ),
        (
            put("joints.csv", "frame,q1,q2,q3\n0,0,0,0\n1,0,,0\n2,0,0,0\n"),
            "joints.csv: line 3: 'q2' must be a finite number",
        ),
        (
            put("joints.csv", "frame,q1,q2,q3\n0,0,0,0\n1,0,nan,0\n2,0,0,0\n"),
            "line 3: 'q2' must be a finite number, not 'nan'",
        ),
        (put("joints.csv", "frame,q1,q2,q3\n0,0,0,x\n"), "joints.csv: line 2: 'q3' must be a finite number, not 'x'"),
        (
            put("joints.csv", "frame,q1,q2,q3\n0,0,0,0\n1,0,0,0\n2,0,0,0\n7,0,0,0\n"),
            "line 5: there is no mask of frame 7",
        ),
        (put("joints.csv", "frame,q1,q2,q3\n0,0,0,0\n0,0,0,0\n"), "joints.csv: line 3: frame 0 is there twice"),
        (put("joints.csv", "frame,q1,q2\n0,0,0\n"), "joints.csv: line 1 must be 'frame,q1,q2,q3'"),
        (put("joints.csv", "frame,q1,q2,q3\n0,0,0\n"), "joints.csv: line 2 has 3 values; expected 4"),
        (put("joints.csv", "frame,q1,q2,q3\n0.5,0,0,0\n"), "line 2: 'frame' must be a whole number, not '0.5'"),
        (put("joints.csv", ""), "joints.csv: line 1 must be"),
        (
            put("tips.csv", "frame,u1,v1,u2,v2\n1,400,1,1,1\n"),
            "tips.csv: frame 1: a tip lies outside the image of 40x30",
        ),
        (put("tips.csv", "frame,u1,v1,u2,v2\n1,inf,1,1,1\n"), "tips.csv: line 2: 'u1' must be a finite number"),
    ],
)
def test_what_is_wrong_is_one_line_and_leaves_nothing(
    full: Path, tmp_path: Path, damage: Callable[[Path], Any], message: str
) -> None:
    damage(full)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SurgbenchError) as caught:
        import_masks(full, tmp_path / "out")
    line = str(caught.value)
    assert message in line
    assert "\n" not in line
    assert sorted(tmp_path.iterdir()) == before


TWO = {"left": frozenset({1}), "right": frozenset({2})}


def test_wrong_options(source: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="unknown instrument 'needle'"):
        import_masks(source, tmp_path / "out", instrument="needle")
    with pytest.raises(SurgbenchError, match="--fps: must be greater than 0, not 0"):
        import_masks(source, tmp_path / "out", fps=0.0)
    for fps in (1e-300, 1e300):
        with pytest.raises(SurgbenchError, match=r"--fps: .* plausible is 0.001 to 100000"):
            import_masks(source, tmp_path / "out", fps=fps)
    with pytest.raises(SurgbenchError, match="--instances has a left one too; leave --arms away"):
        import_masks(source, tmp_path / "out", arm="right", told=Told(instances=TWO))
    with pytest.raises(SurgbenchError, match="no such folder"):
        import_masks(tmp_path / "none", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_output_that_holds_something_is_left_alone(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "cat.jpg").write_bytes(b"cat")
    with pytest.raises(SurgbenchError, match="holds something already"):
        import_masks(source, out)
    assert [path.name for path in out.iterdir()] == ["cat.jpg"]
    (out / "cat.jpg").unlink()
    import_masks(source, out)
    assert validate(out) == []


def test_what_a_killed_import_left_is_no_obstacle(source: Path, tmp_path: Path) -> None:
    stale = tmp_path / ".out.importing"
    stale.mkdir()
    (stale / "half.png").write_bytes(b"x")
    import_masks(source, tmp_path / "out")
    assert validate(tmp_path / "out") == []
    assert not stale.exists()


def test_a_full_disk_is_one_line(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(path: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(SurgbenchError, match=r"out: the disk is full; make room, then run the same command again$"):
        import_masks(source, tmp_path / "out")
