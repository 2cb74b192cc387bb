from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from fabricate import failed, record, with_seed, write
from support import rigid_instrument
from typer import Typer
from typer.testing import CliRunner

from surgbench.camera import Camera
from surgbench.cli.video import video
from surgbench.contract import Trace
from surgbench.dataset.manifest import observations_path
from surgbench.dataset.masks import encode_image, encode_mask
from surgbench.dataset.open import open_as
from surgbench.dataset.tables import encode_table
from surgbench.errors import ConfigError, DatasetError, NotFoundError, SurgbenchError
from surgbench.files import sha256_file
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.spec import LinkPoint
from surgbench.records.reader import read_records_of
from surgbench.report.drawing import (
    ESTIMATE_COLOURS,
    MASK_GREY,
    REFERENCE_COLOUR,
    TINT,
    Picture,
    clip_segment,
    contours,
    draw_contours,
    draw_dots,
    fit_text,
    legend,
    strip,
    text_size,
)
from surgbench.report.movie import spread_frames, write_video
from surgbench.report.video_options import VideoOptions
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import InstrumentManifest, SequenceEntry, observed_path
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery
from surgbench.tasks.instrument.skeletons import BEST_COLOUR, draw_samples, project_bones
from surgbench.tasks.instrument.video import compose_frame, contact_sheet, draw, make_shots, plan

FRAMES = 3
CUBE_M = 0.02
CAMERA = Camera(width=120, height=80, fx=100.0, fy=100.0, cx=60.0, cy=40.0)


def cube_state(u_px: float) -> list[float]:
    """The cube (20 px wide) with its front face's centre at row 40 and column ``u_px``."""
    return [0.0, 0.0, 0.0, (u_px - CAMERA.cx) / CAMERA.fx * 0.1, 0.0, 0.1 + CUBE_M / 2, 0.0, 0.0, 0.0]


def make_dataset(
    root: Path, image: Picture | None = None, name: str = "cubes", bones: bool = False
) -> InstrumentDataset:
    """Three frames in which a cube's mask stands at columns 50, 51 and 52."""
    cube = rigid_instrument(trimesh.creation.box((CUBE_M,) * 3))
    if bones:
        ends = LinkPoint(link="body", point_m=(0, 0, 0)), LinkPoint(link="body", point_m=(0.01, 0, 0))
        cube = replace(cube, spec=cube.spec.model_copy(update={"skeleton": (ends,)}))
    save_instrument(cube, root / "instruments/rigid")
    for frame in range(FRAMES):
        mask = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
        mask[30:51, 40 + frame : 61 + frame] = True
        _put(root / observed_path("000", "left", frame), encode_mask(mask))
        if image is not None:
            _put(root / observed_path("000", "image", frame), encode_image(image))
    _put(root / observations_path("000"), encode_table({"timestamp_s": 0.1 * np.arange(FRAMES, dtype=np.float64)}))
    entry = SequenceEntry(
        id="000",
        frames=FRAMES,
        dt_s=0.1,
        camera="camera",
        arms=("left",),
        instruments={"left": "rigid"},
        kinds=("left",),
        images=image is not None,
    )
    paths = [path for path in root.rglob("*") if path.is_file()]
    files = {str(path.relative_to(root)): {"bytes": path.stat().st_size, "sha256": sha256_file(path)} for path in paths}
    manifest = InstrumentManifest.model_validate(
        {
            "format": "surgbench-dataset-1",
            "name": name,
            "created_by": "test",
            "origin": "imported",
            "configuration": {},
            "cameras": {"camera": CAMERA},
            "instruments": {"rigid": "instruments/rigid/instrument.yaml"},
            "sequences": (entry,),
            "files": files,
        }
    )
    (root / "dataset.json").write_bytes(manifest.to_bytes())
    return open_as(InstrumentDataset, root)


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def run_of(dataset: InstrumentDataset, row_id: str, columns: list[float], **changes: Any) -> dict[str, Any]:
    """A record of a tracker that put the cube at some columns."""
    content = record(row_id, "000-left", frames=len(columns), truth=False, dataset=(dataset.name, dataset.hash))
    content["frames"]["state"] = [cube_state(column) for column in columns]
    return content | {"dataset_path": str(dataset.path), "unit_frames": FRAMES} | changes


@pytest.fixture
def dataset(tmp_path: Path) -> InstrumentDataset:
    return make_dataset(tmp_path / "data")


@pytest.fixture
def runs(tmp_path: Path, dataset: InstrumentDataset) -> Path:
    stopped = run_of(dataset, "gd-10", [70.0, 70.0], status="timeout", error="no answer in 1 s")
    return write(tmp_path / "runs", run_of(dataset, "cmaes", [50.0, 51.0, 52.0]), stopped)


def records_and_scenery(dataset: InstrumentDataset, runs: Path) -> tuple[list[InstrumentRecord], Scenery]:
    records = read_records_of(InstrumentRecord, [runs])
    return records, Scenery(dataset, records[0])


def is_near(pixel: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> bool:
    return bool(np.abs(pixel.astype(int) - colour).max() <= tolerance)


def has_colour(picture: Picture, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=-1) <= 8).any())


def test_contour_of_a_rectangle_runs_along_its_edge() -> None:
    mask = np.zeros((40, 60), dtype=bool)
    mask[10:20, 15:45] = True
    (polygon,) = contours(mask)
    assert polygon.min(axis=0) == pytest.approx([14.5, 9.5], abs=0.3)
    assert polygon.max(axis=0) == pytest.approx([44.5, 19.5], abs=0.3)


def test_contours_know_holes_borders_and_emptiness() -> None:
    mask = np.ones((30, 30), dtype=bool)
    mask[10:20, 10:20] = False
    assert len(contours(mask)) == 2
    assert contours(np.zeros((5, 5), dtype=bool)) == []


def test_contours_are_antialiased_and_scale() -> None:
    mask = np.zeros((40, 60), dtype=bool)
    mask[10:30, 20:40] = True
    picture = strip(120, 80, (0, 0, 0))
    draw_contours(picture, mask, (255, 0, 0), 1, scale=2.0)
    assert picture[40, 39:41, 0].astype(int).sum() > 250  # the left edge, between columns 39 and 40
    assert picture[40, 39:41, 1:].max() == 0
    assert len(np.unique(picture[..., 0])) > 10
    shifted = strip(60, 40, (0, 0, 0))
    draw_contours(shifted, mask, (255, 0, 0), 1, scale=2.0, origin=(15, 5))
    assert picture[10:50, 30:90].tolist() == shifted.tolist()


def test_panel_has_green_where_the_reference_ends_and_the_trackers_colour_where_its_estimate_ends(
    dataset: InstrumentDataset, runs: Path
) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    far = make_shots(records)[1]
    panel = scenery.panel(0, [far], scale=4.0)
    assert panel.shape == (320, 480, 3)
    row = 4 * 40
    assert is_near(panel[row, 4 * 40 - 2], REFERENCE_COLOUR)
    assert is_near(panel[row, 4 * 80], far.colour, 90)
    assert is_near(panel[row, 4 * 50], (MASK_GREY,) * 3, 5)
    assert is_near(panel[10, 10], panel[0, 0].tolist(), 0)
    assert not has_colour(scenery.panel(2, [far], scale=4.0), far.colour)  # it stopped after frame 1


def test_estimate_that_agrees_lies_on_the_reference_and_leaves_its_rim(dataset: InstrumentDataset, runs: Path) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    panel = scenery.panel(0, make_shots(records)[:1], scale=4.0)
    assert has_colour(panel, ESTIMATE_COLOURS[0])
    assert has_colour(panel, REFERENCE_COLOUR)


def test_image_is_the_ground_where_there_is_one(tmp_path: Path, runs: Path) -> None:
    image = strip(CAMERA.width, CAMERA.height, (10, 60, 200))
    dataset = make_dataset(tmp_path / "coloured", image=image)
    scenery = Scenery(dataset, read_records_of(InstrumentRecord, [runs])[0])
    assert scenery.panel(0, [], scale=1.0)[5, 5].tolist() == [10, 60, 200]


def test_frames_are_of_one_even_size(dataset: InstrumentDataset, runs: Path) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    for overlay in (False, True):
        for count in (1, 2, 5):
            shots = make_shots((records * 3)[:count])
            shapes = {compose_frame(scenery, shots, frame, overlay).shape for frame in range(FRAMES)}
            assert len(shapes) == 1
            height, width, _ = shapes.pop()
            assert height % 2 == width % 2 == 0


def test_overlay_has_all_trackers_in_one_panel(dataset: InstrumentDataset, runs: Path) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    shots = make_shots(records)
    beside, over = compose_frame(scenery, shots, 0), compose_frame(scenery, shots, 0, overlay=True)
    assert beside.shape[1] > 2 * CAMERA.width
    assert over.shape[1] == CAMERA.width
    for shot in shots:
        assert has_colour(over, shot.colour)


def test_side_by_side_shows_what_was_observed_before_the_trackers(tmp_path: Path, runs: Path) -> None:
    image = strip(CAMERA.width, CAMERA.height, (10, 60, 200))
    dataset = make_dataset(tmp_path / "coloured", image=image)
    records = read_records_of(InstrumentRecord, [runs])
    scenery, shots = Scenery(dataset, records[0]), make_shots(records)
    plain, picture = (compose_frame(scenery, shots, 0, side_by_side=asked) for asked in (False, True))
    assert (plain.shape[1] - 4) // 2 == (picture.shape[1] - 8) // 3 == CAMERA.width
    head = picture.shape[0] - CAMERA.height
    row, places = head + 34, (50, CAMERA.width + 4 + 50, 2 * (CAMERA.width + 4) + 70)
    for column, colour in zip(places, (REFERENCE_COLOUR, shots[0].colour, shots[1].colour), strict=True):
        laid = TINT * np.array(colour) + (1 - TINT) * np.array([10, 60, 200])
        assert np.abs(picture[row, column + 6] - laid).max() <= 1
        assert picture[row, column - 45].tolist() == [10, 60, 200]
    assert picture[head:, -CAMERA.width :].tolist() != plain[head:, -CAMERA.width :].tolist()


def test_side_by_side_has_dots_at_tips(dataset: InstrumentDataset, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    (shot, _) = make_shots(records)
    state = shot.state(0)
    assert state is not None
    for tip in scenery.tips(state, 0):
        panel = scenery.panel(0, [shot], 4.0, filled=True)
        u, v = np.rint((tip + 0.5) * 4.0 - 0.5).astype(int)
        assert is_near(panel[v, u], shot.colour, 5)
    assert scenery.points(0).shape == (0, 2)
    seen = np.array([[[15.0, 60.0], [np.nan, np.nan]]] * FRAMES)
    monkeypatch.setattr(scenery.recording, "keypoints", lambda arm: seen)
    panel = scenery.panel(0, [], 4.0, filled=True)
    assert is_near(panel[round(60.5 * 4 - 0.5), round(15.5 * 4 - 0.5)], REFERENCE_COLOUR, 5)
    assert scenery.points(0).tolist() == [[15.0, 60.0]]


def test_sheet_side_by_side_has_one_row_more(dataset: InstrumentDataset, runs: Path) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    plain = contact_sheet(scenery, make_shots(records), [0, 1])
    more = contact_sheet(scenery, make_shots(records), [0, 1], side_by_side=True)
    panel = scenery.window([0, 1]).height * 2  # enlarged as much as may be
    assert more.shape[0] - plain.shape[0] >= panel
    assert has_colour(more, REFERENCE_COLOUR)


def test_dots_far_outside_are_left_out() -> None:
    picture = strip(40, 30, (0, 0, 0))
    draw_dots(picture, np.array([[1e12, 0.0], [-1e9, 5.0], [20.0, 10.0]]), (255, 0, 0), 3)
    assert picture[10, 20].tolist() == [255, 0, 0]
    assert np.abs(picture.astype(int) - (0, 0, 0)).max(axis=-1)[:, :14].max() == 0


def test_overlay_and_side_by_side_are_two_ways(runs: Path) -> None:
    app = Typer()
    app.command()(video)
    result = CliRunner().invoke(app, [str(runs), "--overlay", "--side-by-side"])
    assert isinstance(result.exception, ConfigError)
    assert "--overlay and --side-by-side" in str(result.exception)
    assert not (runs / "video").exists()


def test_sheet_has_a_row_per_tracker_and_a_column_per_frame(dataset: InstrumentDataset, runs: Path) -> None:
    records, scenery = records_and_scenery(dataset, runs)
    one = contact_sheet(scenery, make_shots(records[:1]), [0])
    more = contact_sheet(scenery, make_shots(records), [0, 1, 2])
    assert more.shape[1] > 2.5 * one.shape[1]
    assert more.shape[0] > 1.5 * one.shape[0]
    # Cropped to the masks and enlarged: the cube of 21 px is a good part of a panel.
    window = scenery.window([0, 1, 2])
    assert (window.left, window.top) == (33, 23)
    assert (window.width, window.height) == (37, 35)


def test_command_writes_a_video_that_opencv_reads_and_a_sheet(runs: Path) -> None:
    app = Typer()
    app.command()(video)
    result = CliRunner().invoke(app, [str(runs), "--frames", "2"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    folder = runs / "video"
    assert result.stdout.split() == [str(folder / "000-left.mp4"), str(folder / "000-left.png")]
    assert {path.name for path in folder.iterdir()} == {"000-left.mp4", "000-left.png"}
    capture = cv2.VideoCapture(str(folder / "000-left.mp4"))
    pictures = []
    while True:
        there, picture = capture.read()
        if not there:
            break
        pictures.append(picture)
    assert len(pictures) == FRAMES
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    green = pictures[0][..., 1].astype(int) - pictures[0].max(axis=-1, initial=0, where=np.array([True, False, True]))
    assert green.max() > 80
    sheet = cv2.imread(str(folder / "000-left.png"))
    assert sheet is not None
    assert has_colour(np.asarray(sheet[..., ::-1], dtype=np.uint8), REFERENCE_COLOUR)


def test_interrupted_video_leaves_nothing(tmp_path: Path) -> None:
    def pictures() -> Any:
        yield strip(64, 48)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", pictures(), 10.0)
    assert list(tmp_path.iterdir()) == []


def test_run_that_failed_at_once_is_drawn_without_estimate(tmp_path: Path, dataset: InstrumentDataset) -> None:
    content = failed(row_id="stuck", dataset=(dataset.name, dataset.hash), frames=FRAMES)
    runs = write(tmp_path / "failed", content | {"dataset_path": str(dataset.path)})
    (job,) = plan(read_records_of(InstrumentRecord, [runs]), VideoOptions())
    assert [path.suffix for path in draw(job, VideoOptions(), tmp_path / "out")] == [".mp4", ".png"]


def test_plan_chooses_units_and_rows(runs: Path) -> None:
    records = read_records_of(InstrumentRecord, [runs])
    (job,) = plan(records, VideoOptions(rows=("gd-10",)))
    assert (job.name, [r.spec.row_id for r in job.records], job.frames) == ("000-left", ["gd-10"], FRAMES)
    with pytest.raises(NotFoundError, match="unknown row 'cmeas'; did you mean 'cmaes'"):
        plan(records, VideoOptions(rows=("cmeas",)))
    with pytest.raises(NotFoundError, match="unknown unit '000-rihgt'"):
        plan(records, VideoOptions(units=("000-rihgt",)))


def test_dataset_that_moved_is_found_again(runs: Path, dataset: InstrumentDataset, tmp_path: Path) -> None:
    new = dataset.path.rename(tmp_path / "elsewhere")
    records = read_records_of(InstrumentRecord, [runs])
    with pytest.raises(DatasetError, match="--dataset PATH"):
        plan(records, VideoOptions())
    assert plan(records, VideoOptions(), new)[0].dataset.path == new
    other = make_dataset(tmp_path / "other", name="others")
    with pytest.raises(DatasetError, match="not the dataset that the records were made on"):
        plan(records, VideoOptions(), other.path)


def test_units_of_two_datasets_do_not_overwrite_each_other(tmp_path: Path, runs: Path) -> None:
    other = make_dataset(tmp_path / "other", name="others")
    more = write(tmp_path / "more", run_of(other, "cmaes", [50.0]))
    jobs = plan(read_records_of(InstrumentRecord, [runs, more]), VideoOptions())
    assert [job.name for job in jobs] == ["cubes-000-left", "others-000-left"]


def test_rows_of_one_name_get_their_variant(dataset: InstrumentDataset, tmp_path: Path) -> None:
    first = run_of(dataset, "cmaes", [50.0])
    runs = write(tmp_path / "runs", first, with_seed(1, first, variant="readings"))
    assert {shot.title for shot in make_shots(read_records_of(InstrumentRecord, [runs]))} == {
        "cmaes (none/random kalman)",
        "cmaes (readings)",
    }


def test_plugins_of_one_name_get_the_start_of_their_hashes(dataset: InstrumentDataset, tmp_path: Path) -> None:
    runs = []
    for name, digits in (("a", "1a2b3c4d"), ("b", "5e6f7a8b")):
        content = run_of(dataset, "cmaes", [50.0])
        tracker = content["spec"]["tracker"] | {"source": f"{name}.py:Still@{digits}"}
        content |= {"spec": content["spec"] | {"tracker": tracker}, "settings_hash": digits}
        runs.append(write(tmp_path / name, content))
    assert {shot.title for shot in make_shots(read_records_of(InstrumentRecord, runs))} == {
        "cmaes (none/random kalman, cmaes@1a2b3c)",
        "cmaes (none/random kalman, cmaes@5e6f7a)",
    }


def test_spread_frames() -> None:
    assert spread_frames(60, 5) == [0, 15, 30, 44, 59]
    assert spread_frames(3, 5) == [0, 1, 2]
    assert spread_frames(1, 5) == [0]


def test_long_texts_are_cut_and_legends_wrap() -> None:
    text = fit_text("a very long name of a tracker", 12, 80)
    assert text.endswith("..")
    assert text_size(text, 12)[0] <= 80
    entries = [(f"estimate: tracker-{number}", ESTIMATE_COLOURS[number]) for number in range(6)]
    assert legend(entries, 300, 12).shape[0] > legend(entries, 3000, 12).shape[0]
    assert legend(entries, 300, 12).shape[1] == 300


@pytest.fixture(scope="module")
def driver() -> Instrument:
    return load_instrument("large_needle_driver")


DRIVER_STATE = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])


def test_bones_end_at_the_tips_and_are_cut_at_the_camera_plane(driver: Instrument, camera: Camera) -> None:
    bones = project_bones(camera, [driver], DRIVER_STATE)
    tips = camera.project(driver.tips_cam(DRIVER_STATE))
    for tip in tips:
        assert np.linalg.norm(bones[:, 1] - tip, axis=-1).min() < 1e-9
    # Looking along the shaft from 2 cm: its far end is behind the camera.
    close = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.02, 0.0, 0.0, 0.3])
    assert (driver.skeleton_cam(close)[..., 2] < 0).any()
    assert np.isfinite(project_bones(camera, [driver], close)).all()
    behind = DRIVER_STATE + np.array([0, 0, 0, 0, 0, -5.0, 0, 0, 0])
    assert project_bones(camera, [driver], behind).shape == (0, 2, 2)


def test_clip_segment() -> None:
    box = (0.0, 0.0), (10.0, 10.0)
    inside = clip_segment(np.array([[-5.0, 5.0], [15.0, 5.0]]), *box)
    assert inside is not None
    assert inside.tolist() == [[0.0, 5.0], [10.0, 5.0]]
    assert clip_segment(np.array([[-5.0, 20.0], [15.0, 20.0]]), *box) is None
    assert clip_segment(np.array([[np.nan, 0.0], [1.0, 1.0]]), *box) is None
    far = clip_segment(np.array([[5.0, 5.0], [1e12, 1e12]]), *box)
    assert far is not None
    assert far[1] == pytest.approx([10.0, 10.0])


def test_samples_draw_the_best_of_each_iteration_in_columns(driver: Instrument, camera: Camera) -> None:
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    off = DRIVER_STATE + np.array([0, 0, 0, 0, 0.01, 0, 0, 0, 0])
    states = [np.stack([DRIVER_STATE, off]), np.stack([DRIVER_STATE, off]), DRIVER_STATE[None]]
    picture = draw_samples(camera, [driver], mask, states, top=55, panel_width=350)
    assert picture.shape[1] == 3 * 350 + 2 * 4
    head = picture.shape[0] - round(camera.height * 0.5)
    u, v = (camera.project(driver.points_cam(DRIVER_STATE, driver.spec.tips[:1]))[0] + 0.5) / 2 - 0.5
    for column in range(3):
        row, left = head + round(v), column * 354 + round(u)
        spot = picture[row - 1 : row + 2, left - 1 : left + 2]
        assert (spot.min(axis=-1) > 200).any(), BEST_COLOUR
    coloured = [np.ptp(picture[head:, c * 354 : c * 354 + 350].astype(int), axis=-1).max() > 100 for c in range(3)]
    assert coloured == [True, True, False]
    only_best = draw_samples(camera, [driver], mask, states[:1], top=1, panel_width=350)
    assert np.ptp(only_best[head:].astype(int), axis=-1).max() < 10


@pytest.fixture
def replay(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Stands for the suite's replaying; holds what it was asked for."""
    asked: dict[str, Any] = {"empty": False}

    def replay_traces(content: dict[str, Any], dataset: InstrumentDataset, frames: list[int]) -> dict[int, Trace]:
        asked[content["spec"]["row_id"]] = (dataset.hash, frames)
        states = [] if asked["empty"] else [np.array([cube_state(50.0), cube_state(55.0)])] * 3
        return {frame: Trace(states, [np.zeros(2)] * len(states)) for frame in frames}

    module = ModuleType("surgbench.tasks.instrument.replay")
    module.replay_traces = replay_traces  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "surgbench.tasks.instrument.replay", module)
    return asked


def test_samples_are_replayed_for_frames_with_estimates(tmp_path: Path, replay: dict[str, Any]) -> None:
    dataset = make_dataset(tmp_path / "bones", bones=True)
    runs = write(tmp_path / "r", run_of(dataset, "cmaes", [50.0] * 3), run_of(dataset, "gd-10", [50.0] * 2))
    options = VideoOptions(samples=True)
    (job,) = plan(read_records_of(InstrumentRecord, [runs]), options)
    written = draw(job, options, tmp_path / "out")
    assert [path.name for path in written] == ["000-left.mp4", "000-left.png", "000-left-samples.png"]
    assert replay["cmaes"] == (dataset.hash, [0, 1, 2])
    assert replay["gd-10"] == (dataset.hash, [0, 1])
    picture = cv2.imread(str(written[2]))
    assert picture is not None
    assert (picture.min(axis=-1) > 200).any()
    replay["empty"] = True
    with pytest.raises(SurgbenchError, match="no tracker here shows its candidates"):
        draw(job, options, tmp_path / "out")


def test_samples_need_a_skeleton(tmp_path: Path, runs: Path) -> None:
    options = VideoOptions(samples=True)
    (job, *_) = plan(read_records_of(InstrumentRecord, [runs]), options)
    with pytest.raises(SurgbenchError, match="instrument 'rigid' has no 'skeleton'"):
        draw(job, options, tmp_path / "out")
