"""Masks that are made of images while a tracker waits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import MASK_MAKERS, RUN, STRANGERS, records, surgbench
from others import put_camera, put_video
from small_dataset import CAMERA, DRIVER, FRAMES, make_pair, paint, states_of

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.errors import InvalidAnswerError
from surgbench.instrument import load_instrument
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.records.reader import read_records
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.suite.asked import Conditions
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.made_masks import check_found
from surgbench.tasks.instrument.plan import complete
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery

SOURCE_ERROR = "mask_source_error"
# What this is about is what it sees, not what it makes of it.
STILL = f"{STRANGERS}:Still"


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair with images of both arms, with truth."""
    return make_pair(tmp_path_factory.mktemp("pictured") / "pair", sequences=1, images=True).path


def run(dataset: Path, out: Path, masks: object, *options: object, expect: int = 0) -> list[dict[str, Any]]:
    surgbench(
        *(*RUN, "--dataset", dataset, "--tracker", STILL, "--masks", masks, "--out", out, *options), expect=expect
    )
    return records(out)


def maker(name: str) -> str:
    return f"{MASK_MAKERS}:{name}"


@pytest.mark.slow
@pytest.mark.parametrize("arms", ["single", "dual"])
def test_true_masks_have_no_error_and_are_never_for_ranking(pictured: Path, tmp_path: Path, arms: str) -> None:
    for record in run(pictured, tmp_path, "truth", "--arms", arms):
        assert record["status"] == "ok"
        assert record["errors"][SOURCE_ERROR] == [0.0] * FRAMES
        assert record["floor"]
        assert "true masks, NOT FOR RANKING" in record["variant"]


def test_masks_made_of_images_are_what_the_tracker_sees(pictured: Path, tmp_path: Path) -> None:
    (record,) = run(pictured, tmp_path, maker("Bright"), "--arms", "dual")
    assert record["status"] == "ok"
    assert record["spec"]["row_id"] == "still-bright"
    # The pictures are painted with the true masks.
    assert record["errors"][SOURCE_ERROR] == [0.0] * FRAMES
    assert record["errors"]["mask_error"] == record["errors"]["mask_error_true"]
    assert all(took > 0 for took in record["frames"]["latency_masks_ms"])
    # What a user waits for counts it.
    parts = ("latency_masks_ms", "latency_optimise_ms", "latency_keypoints_ms", "latency_filter_ms")
    for whole, *each in zip(record["frames"]["latency_ms"], *(record["frames"][name] for name in parts), strict=True):
        assert whole >= sum(each)


@pytest.mark.slow
def test_a_mask_that_is_not_there_is_an_error_of_one(pictured: Path, tmp_path: Path) -> None:
    """A picture of both arms is no mask of one of them: what a source gives is measured against that arm alone."""
    left, right = run(pictured, tmp_path, maker("Bright"))
    sequence = open_as(InstrumentDataset, pictured).sequence("000")
    for record, arm in ((left, "left"), (right, "right")):
        for frame, error in enumerate(record["errors"][SOURCE_ERROR]):
            own, both = sequence.clean_mask(arm, frame), sequence.clean_mask("both", frame)
            assert error == pytest.approx(1 - own.sum() / both.sum())


@pytest.mark.slow
def test_the_dataset_s_own_masks_are_measured_where_that_is_asked(pictured: Path, tmp_path: Path) -> None:
    (record,) = run(pictured, tmp_path / "a", "observed", "--arms", "dual")
    (plain,) = run(pictured, tmp_path / "b", "union", "--arms", "dual")
    assert record["frames"]["state"] == plain["frames"]["state"]
    assert SOURCE_ERROR in record["errors"]
    assert SOURCE_ERROR not in plain["errors"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "status", "line"),
    [
        ("Halved", "invalid", "masks 'halved' returned a mask of shape (31, 44), not (62, 88)"),
        ("Levels", "invalid", "masks 'levels' returned a mask of uint8, not of bool"),
        ("Breaks", "failed", "frame 2: PluginError: masks 'breaks' raised RuntimeError: no more masks"),
    ],
)
def test_what_a_source_does_wrong_is_one_line(
    pictured: Path, tmp_path: Path, source: str, status: str, line: str
) -> None:
    (record,) = run(pictured, tmp_path, maker(source), "--arms", "dual", expect=1)
    assert record["status"] == status
    assert line in record["error"]


@pytest.mark.slow
def test_every_frame_is_asked_about_once_and_in_turn(pictured: Path, tmp_path: Path) -> None:
    (record,) = run(pictured, tmp_path, maker("Counts"), "--arms", "dual")
    assert record["errors"][SOURCE_ERROR] == [0.0] * FRAMES


@pytest.mark.slow
def test_points_on_the_instruments_come_from_the_first_estimate(
    pictured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SURGBENCH_TEST_NOTES", str(tmp_path / "notes"))
    (record,) = run(pictured, tmp_path / "runs", maker("Pointed"), "--arms", "dual")
    assert record["status"] == "ok"
    notes = (tmp_path / "notes").read_text().splitlines()
    points, inside, has_image = json.loads(notes[-1])
    assert has_image
    sequence = open_as(InstrumentDataset, pictured).sequence("000")
    for arm, own, on in zip(("left", "right"), points, inside, strict=True):
        assert own
        assert all(on)
        mask = sequence.clean_mask(arm, 0)
        assert all(mask[int(v), int(u)] for u, v in own)


@pytest.mark.slow
def test_points_from_a_file(pictured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SURGBENCH_TEST_NOTES", str(tmp_path / "notes"))
    sequence = open_as(InstrumentDataset, pictured).sequence("000")
    v, u = (int(values[0]) for values in np.nonzero(sequence.clean_mask("left", 0)))
    b, a = (int(values[-1]) for values in np.nonzero(sequence.clean_mask("right", 0)))
    (tmp_path / "points.csv").write_text(f"sequence,arm,u,v,inside\n000,left,{u},{v},1\n000,right,{a},{b},1\n")
    left, _ = run(pictured, tmp_path / "runs", maker("Pointed"), "--prompts", tmp_path / "points.csv")
    assert left["spec"]["prompts"]["000"][""]["left"] == [[u, v, True]]
    points, inside, _ = json.loads((tmp_path / "notes").read_text().splitlines()[0])
    # Of one arm, what is on the other one is not to be taken for it.
    assert points == [[[u, v], [a, b]]]
    assert inside == [[True, False]]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("sequence,arm,u,v\n000,left,300,10\n", "outside the picture"),
        ("sequence,arm,u,v\n000,left,0,0\n000,right,0,0\n", "lies on the background"),
    ],
)
def test_points_that_cannot_be_meant(
    pictured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, line: str
) -> None:
    (tmp_path / "points.csv").write_text(text)
    run(pictured, tmp_path / "runs", maker("Pointed"), "--prompts", tmp_path / "points.csv", expect=2)
    said = capsys.readouterr().err
    assert "points.csv" in said
    assert line in said
    assert said.count("\n") == 1


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that is nothing but a video."""
    root = tmp_path_factory.mktemp("video")
    put_camera(root, CAMERA)
    evaluator = SilhouetteEvaluator([load_instrument(DRIVER)], CAMERA)
    put_video(root / "suturing.avi", (paint(evaluator.mask(state)) for state in states_of("left")), fps=10.0)
    surgbench("import", "video", root, "--out", root / "data")
    return root / "data"


@pytest.mark.slow
def test_a_video_without_masks_is_tracked_by_masks_made_of_it(video: Path, tmp_path: Path) -> None:
    start = ("--initialiser", "random", "--set", "random.hypotheses=2000")
    (record,) = run(video, tmp_path, maker("Bright"), *start)
    assert record["status"] == "ok"
    # It has no truth: the mask is what the tracker saw.
    assert SOURCE_ERROR not in record["errors"]
    assert np.mean(record["errors"]["mask_error"]) < 0.5
    assert record["errors"]["absent"] == [0.0] * FRAMES


@pytest.mark.parametrize(
    ("masks", "line"),
    [
        ("truth", "needs ground truth"),
        ("observed", "has no masks"),
        (maker("Pointed"), "needs points in the first pictures: --prompts FILE"),
        ("brigth", "unknown mask source 'brigth'"),
    ],
)
def test_what_a_source_lacks_is_said_before_anything_is_run(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], masks: str, line: str
) -> None:
    run(video, tmp_path, masks, expect=2)
    said = capsys.readouterr().err
    assert line in said
    assert said.count("\n") == 1
    assert not records(tmp_path)


def test_images_are_needed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = make_pair(tmp_path / "pair")
    run(dataset.path, tmp_path / "runs", maker("Bright"), expect=2)
    assert "masks bright works on images, and sequence '000'" in capsys.readouterr().err


def test_a_view_that_is_not_there_is_one_line(
    pictured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(pictured, tmp_path, maker("Bright"), "--view", "nowhere", expect=2)
    assert "--view nowhere: 'pairs' has no auxiliary views" in capsys.readouterr().err


def test_answers_are_checked() -> None:
    camera = Camera(width=4, height=3, fx=5, fy=5, cx=2, cy=1)
    mask = np.zeros((3, 4), dtype=bool)
    assert check_found(mask, camera, 1, "it").instance_masks is None
    # Masks of arms are dropped where there is one arm, as `View` has none of a single arm.
    assert check_found(FoundMasks(mask, (mask,)), camera, 1, "it").instance_masks is None
    assert check_found(FoundMasks(mask, (mask, mask)), camera, 2, "it").instance_masks is not None
    confused: Any = FoundMasks(mask, confidence=None)  # type: ignore[arg-type]
    for wrong in (FoundMasks(mask, (mask,)), FoundMasks(mask, confidence=1.5), FoundMasks(mask.T), confused, None):
        with pytest.raises(InvalidAnswerError):
            check_found(wrong, camera, 2, "it")


def test_prompts_that_do_not_match_are_refused() -> None:
    with pytest.raises(ValueError, match="do not match"):
        Prompts([np.zeros((2, 2))], [np.array([True])])


@pytest.mark.slow
def test_pictures_of_a_run_show_the_masks_that_its_tracker_saw(pictured: Path, tmp_path: Path) -> None:
    run(pictured, tmp_path, maker("Bright"))
    run(pictured, tmp_path, "observed")
    dataset = open_as(InstrumentDataset, pictured)
    sequence = dataset.sequence("000")
    found = {record.spec.row_id: record for record in read_records([tmp_path]) if record.spec.unit == "000-left"}
    bright, observed = found["still-bright"], found["still-observed"]
    assert isinstance(bright, InstrumentRecord)
    assert isinstance(observed, InstrumentRecord)
    for first in (bright, observed):
        scenery = Scenery(dataset, first)
        for frame in (2, 0):  # in any order
            # A source that cannot tell arms apart shows both to who tracks one.
            assert np.array_equal(scenery.reference(frame, bright), sequence.clean_mask("both", frame))
            assert np.array_equal(scenery.reference(frame, observed), sequence.mask("left", frame))


@pytest.mark.slow
def test_a_run_with_points_from_a_file_is_drawn(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SURGBENCH_TEST_NOTES", str(tmp_path / "notes"))
    (tmp_path / "points.csv").write_text("arm,u,v\nleft,20,30\n")
    start = ("--initialiser", "random", "--set", "random.hypotheses=500")
    run(video, tmp_path / "runs", maker("Pointed"), "--prompts", tmp_path / "points.csv", *start)
    surgbench("video", tmp_path / "runs", "--frames", 2, "--out", tmp_path / "drawn")
    assert (tmp_path / "drawn/000.png").is_file()
    # Asked with the same points when it is drawn as when it was run.
    assert len({line for line in (tmp_path / "notes").read_text().splitlines()}) == 1


def test_points_on_the_other_arm_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = make_pair(tmp_path / "pair", sequences=1, images=True, visible=("visible_left", "visible_right"))
    b, a = (int(values[-1]) for values in np.nonzero(dataset.sequence("000").clean_mask("visible_right", 0)))
    (tmp_path / "points.csv").write_text(f"arm,u,v\nleft,{a},{b}\nright,{a},{b}\n")
    run(dataset.path, tmp_path / "runs", maker("Pointed"), "--prompts", tmp_path / "points.csv", expect=2)
    assert "lies on the other arm" in capsys.readouterr().err


@pytest.mark.slow
def test_a_video_that_begins_without_an_instrument_is_waited_for(tmp_path: Path) -> None:
    put_camera(tmp_path, CAMERA)
    evaluator = SilhouetteEvaluator([load_instrument(DRIVER)], CAMERA)
    masks = [np.zeros((CAMERA.height, CAMERA.width), dtype=bool)] * 2 + [evaluator.mask(s) for s in states_of("left")]
    put_video(tmp_path / "late.avi", map(paint, masks), fps=10.0)
    surgbench("import", "video", tmp_path, "--out", tmp_path / "data")
    start = ("--initialiser", "random", "--set", "random.hypotheses=500")
    (record,) = run(tmp_path / "data", tmp_path / "runs", maker("Bright"), *start)
    assert record["status"] == "ok"
    assert record["frames"]["lost"][:2] == [True, True]
    assert record["frames"]["latency_ms"][:2] == [None, None]
    assert record["frames"]["latency_ms"][2] > 0
    assert record["errors"]["absent"] == [1.0, 1.0] + [0.0] * FRAMES
    put_video(tmp_path / "dark/never.avi", map(paint, masks[:2] * 2), fps=10.0)
    put_camera(tmp_path / "dark", CAMERA)
    surgbench("import", "video", tmp_path / "dark", "--out", tmp_path / "nothing")
    (record,) = run(tmp_path / "nothing", tmp_path / "none", maker("Bright"), *start, expect=1)
    assert "no instrument shows in any of 4 masks" in record["error"]


def test_tips_are_looked_for_in_the_masks_that_are_made(pictured: Path) -> None:
    dataset = open_as(InstrumentDataset, pictured)
    made, given = (
        complete(InstrumentRow(tracker="cmaes", readings="noisy", masks=masks), Conditions(), dataset)
        for masks in (maker("Bright"), "auto")
    )
    assert made.keypoints.name == "resnet18"
    assert given.keypoints.name == "observed"
