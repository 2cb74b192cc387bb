"""`surgbench view --out`: what stands in a recording, read back by Rerun's own reader. No viewer is opened."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import surgbench
from fabricate import failed, record, write
from small_dataset import CAMERA, DRIVER, DT_S, FRAMES, make_pair, states_of

from surgbench.instrument import load_instrument
from surgbench.report import stage
from surgbench.report.drawing import contours
from surgbench.tasks.instrument.dataset import InstrumentDataset

pytest.importorskip("rerun")
reader = pytest.importorskip("rerun.chunk", reason="Rerun of 0.39 or later, for reading back")

pytestmark = pytest.mark.extras

ODD = "</script> a/b 'c' \\ ä"


class Seen:
    """A recording, path by path."""

    def __init__(self, path: Path) -> None:
        self._batches: dict[str, list[Any]] = {}
        for chunk in reader.RrdReader(path).stream():
            self._batches.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())

    @property
    def paths(self) -> set[str]:
        """All of them but Rerun's own."""
        return {path for path in self._batches if not path.startswith("/__")}

    def column(self, path: str, name: str) -> list[Any]:
        """All values of a component, in the order of frames where it has any."""
        rows: list[tuple[int, Any]] = []
        for batch in self._batches[path]:
            if name in batch.schema.names:
                frames = batch.column("frame").to_pylist() if "frame" in batch.schema.names else [0] * batch.num_rows
                values = batch.column(name).to_pylist()
                rows += [(f, v) for f, v in zip(frames, values, strict=True) if v is not None]
        return [value for _, value in sorted(rows, key=lambda row: row[0])]

    def times(self, path: str) -> tuple[list[int], list[float]]:
        """Frames and seconds of what changes."""
        found: dict[int, float] = {}
        for batch in self._batches[path]:
            if "frame" in batch.schema.names:
                seconds = batch.column("seconds").cast("int64").to_pylist()
                found |= dict(zip(batch.column("frame").to_pylist(), (1e-9 * s for s in seconds), strict=True))
        return sorted(found), [found[frame] for frame in sorted(found)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> InstrumentDataset:
    return make_pair(tmp_path_factory.mktemp("view") / "pairs", images=True)


@pytest.fixture(scope="module")
def runs(dataset: InstrumentDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rows on one arm, the other of which got no further than its second frame; and one that failed at once."""
    common: dict[str, Any] = {"dataset": (dataset.name, dataset.hash), "dataset_path": str(dataset.path)}
    whole = record(frames=FRAMES, **common)
    whole["frames"]["state"] = states_of("left").tolist()
    part = record(row_id="odd", frames=2, **common)
    part["frames"]["state"] = states_of("left")[:2].tolist()
    return write(tmp_path_factory.mktemp("runs"), whole, part, failed(row_id="fails", **common))


def test_a_pair_in_space_and_in_the_picture(dataset: InstrumentDataset, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "pair.rrd"
    surgbench("view", dataset.path, "--unit", "001", "--out", out)
    assert list(out.parent.iterdir()) == [out]
    seen = Seen(out)
    driver = load_instrument(DRIVER)
    for arm in ("left", "right"):
        states = states_of(arm, sequence=1)
        tips = np.array(seen.column(f"/001/truth/{arm}/tips", "Points3D:positions"))
        np.testing.assert_allclose(tips, driver.tips_cam(states), atol=1e-7)
        for link in driver.meshes:
            places = np.array(seen.column(f"/001/truth/{arm}/{link}", "Transform3D:translation"))[:, 0]
            turns = np.array(seen.column(f"/001/truth/{arm}/{link}", "Transform3D:mat3x3"))[:, 0]
            poses = driver.link_transforms(states)[:, driver.link_index[link]]
            np.testing.assert_allclose(places, poses[:, :3, 3], atol=1e-7)
            # Column by column, as Rerun has matrices.
            np.testing.assert_allclose(turns.reshape(-1, 3, 3).swapaxes(1, 2), poses[:, :3, :3], atol=1e-6)
    frames, seconds = seen.times("/001/camera/mask")
    assert frames == list(range(FRAMES))
    np.testing.assert_allclose(seconds, DT_S * np.arange(FRAMES), atol=1e-9)
    assert seen.times("/001/truth/left/tips") == (frames, seconds)


def test_pictures_are_those_of_the_dataset(dataset: InstrumentDataset, tmp_path: Path) -> None:
    surgbench("view", dataset.path, "--every", 2, "--out", tmp_path / "pair.rrd")
    seen = Seen(tmp_path / "pair.rrd")
    assert seen.times("/000/camera/mask")[0] == [0, 2]
    sequence = dataset.sequence("000")
    for frame, mask, blob in zip(
        (0, 2),
        seen.column("/000/camera/mask", "SegmentationImage:buffer"),
        seen.column("/000/camera/image", "EncodedImage:blob"),
        strict=True,
    ):
        found = np.frombuffer(bytes(mask[0]), np.uint8).reshape(CAMERA.height, CAMERA.width)
        np.testing.assert_array_equal(found, sequence.mask("both", frame))
        place = sequence.image_path(frame)
        assert place is not None
        assert bytes(blob[0]) == place.read_bytes()
    # A pixel's centre is at half numbers there.
    outline = np.array(seen.column("/000/camera/reference", "LineStrips2D:strips")[0][0])
    np.testing.assert_allclose(outline[:-1], contours(sequence.mask("both", 0))[0] + 0.5, atol=1e-4)
    matrix = np.array(seen.column("/000/camera", "Pinhole:image_from_camera")[0][0]).reshape(3, 3).T
    np.testing.assert_allclose(matrix[:2, 2], [CAMERA.cx + 0.5, CAMERA.cy + 0.5], rtol=1e-6)


def test_runs_have_estimates_outlines_and_errors(runs: Path, tmp_path: Path) -> None:
    surgbench("view", runs, "--out", tmp_path / "runs.rrd")
    seen = Seen(tmp_path / "runs.rrd")
    driver = load_instrument(DRIVER)
    tips = np.array(seen.column("/000-left/rows/cmaes/left/tips", "Points3D:positions"))
    np.testing.assert_allclose(tips, driver.tips_cam(states_of("left")), atol=1e-7)
    assert seen.times("/000-left/rows/odd/left/tips")[0] == [0, 1]
    errors = seen.column("/000-left/errors/rotation_error_rad/cmaes", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel(errors), [0.1, 0.2, 0.3, 0.4])
    # Outlines of the truth are those of the mask; where there is no estimate, there is none.
    outlines = seen.column("/000-left/camera/rows/odd", "LineStrips2D:strips")
    assert [len(strips) > 0 for strips in outlines] == [True, True, False, False]
    assert not any("jitter" in path or "fails" in path for path in seen.paths)


def test_rows_and_units_are_chosen(
    runs: Path, dataset: InstrumentDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench("view", runs, "--row", "odd", "--unit", "000-left", "--out", tmp_path / "a.rrd")
    assert "/000-left/rows/cmaes/left/tips" not in Seen(tmp_path / "a.rrd").paths
    assert "with --unit" not in capsys.readouterr().err
    surgbench("view", dataset.path, "--out", tmp_path / "b.rrd")
    told = capsys.readouterr()
    assert told.out.strip() == str(tmp_path / "b.rrd")
    assert "shown is 000; with --unit: 000-left, 000-right, 001, 001-left, 001-right" in told.err
    surgbench("view", dataset.path, "--unit", "000", "--unit", "001-right", "--out", tmp_path / "c.rrd")
    found = Seen(tmp_path / "c.rrd").paths
    assert {"/000/camera/mask", "/001-right/truth/right/tips"} <= found
    assert not any(path.startswith("/001-right/truth/left") for path in found)


def test_names_of_any_text_are_one_part_of_a_path() -> None:
    path = stage.Stage("x").path(["000", ODD])
    assert path.count("/") - path.count("\\/") == 2


def one_line(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    surgbench("view", *arguments, expect=2)
    (line,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("surgbench: ")]
    return line


def test_what_cannot_be_shown_is_one_line(
    dataset: InstrumentDataset,
    runs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "x.rrd"
    assert "unknown unit '00'" in one_line(capsys, dataset.path, "--unit", "00", "--out", out)
    assert "unknown row 'cmas'; did you mean 'cmaes'?" in one_line(capsys, runs, "--row", "cmas", "--out", out)
    assert "rows are of runs" in one_line(capsys, dataset.path, "--row", "cmaes", "--out", out)
    assert "end in .rrd" in one_line(capsys, dataset.path, "--out", tmp_path / "x.mp4")
    assert "no such file" in one_line(capsys, tmp_path / "nowhere", "--out", out)
    (tmp_path / "folder.rrd").mkdir()
    assert "is a folder" in one_line(capsys, dataset.path, "--out", tmp_path / "folder.rrd")
    (tmp_path / "file").write_text("")
    assert "cannot be written" in one_line(capsys, dataset.path, "--out", tmp_path / "file" / "x.rrd")
    assert "elsewhere" in one_line(capsys, runs, "--dataset", tmp_path / "elsewhere", "--out", out)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "no display here" in one_line(capsys, dataset.path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.rrd"]


def test_a_damaged_dataset_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = make_pair(tmp_path / "broken", images=True, sequences=1)
    place = broken.sequence("000").image_path(2)
    assert place is not None
    place.write_bytes(place.read_bytes()[:60])
    (tmp_path / "out").mkdir()
    assert "000002.png" in one_line(capsys, broken.path, "--out", tmp_path / "out" / "x.rrd")
    assert not list((tmp_path / "out").iterdir())


def test_a_full_disk_leaves_nothing(
    dataset: InstrumentDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    assert "cannot be written (No space left on device)" in one_line(capsys, dataset.path, "--out", tmp_path / "x.rrd")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_trial_and_two_cameras_on_it(tmp_path: Path) -> None:
    from surgbench.dataset.open import open_as
    from surgbench.records.reader import read_records
    from surgbench.tasks.viewpoint.dataset import ViewpointDataset

    data, runs = tmp_path / "chaser", tmp_path / "runs"
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", 100, "--out", data)
    surgbench("run", "--dataset", data, "--tracker", "gaze", "--tracker", "static", "--out", runs)
    surgbench("view", data, "--out", tmp_path / "trial.rrd")
    seen, trial = Seen(tmp_path / "trial.rrd"), open_as(ViewpointDataset, data).trial("000")
    assert trial.truth is not None
    assert {"/000/scene/wire", "/000/scene/zone", "/000/scene/floor", "/000/start", "/000/start/camera"} <= seen.paths
    places = np.array(seen.column("/000/ring", "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(places, trial.truth.T_world_feature[:, :3, 3], atol=1e-7)
    frames, seconds = seen.times("/000/ring")
    assert frames == list(range(100))
    np.testing.assert_allclose(seconds, trial.timestamps_s, atol=1e-9)
    surgbench("view", runs, "--out", tmp_path / "runs.rrd")
    seen = Seen(tmp_path / "runs.rrd")
    for one in read_records([runs]):
        kept: Any = one.frames
        name = one.spec.row_id
        poses = trial.truth.T_world_base @ trial.arm.forward(np.array(kept.joints))
        places = np.array(seen.column(f"/000/rows/{name}/camera", "Transform3D:translation"))[:, 0]
        np.testing.assert_allclose(places, poses[:, :3, 3], atol=1e-7)
        # The arm's line ends where the camera is; a step's pose is there at the next frame.
        ends = np.array([strips[0][-1] for strips in seen.column(f"/000/rows/{name}/arm", "LineStrips3D:strips")])
        np.testing.assert_allclose(ends, poses[:, :3, 3], atol=1e-6)
        assert seen.times(f"/000/rows/{name}/camera")[0] == list(range(1, len(poses) + 1))
        errors = np.ravel(seen.column(f"/000/errors/vva_deg/{name}", "Scalars:scalars"))
        np.testing.assert_allclose(errors, one.errors["vva_deg"])
        assert f"/000/rules/no_go_mm/{name}" in seen.paths
