"""Recordings have no truth: what they are scored by instead, and which frames do not count."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fabricate import record, write
from support import resting_state

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.exchange.masks import import_masks
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.report import render
from surgbench.report.field import keys
from surgbench.report.frame import csv_text
from surgbench.report.notebook import leaderboard
from surgbench.report.rows import read_rows
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JOINTS, twin
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.execute import _errors, _mask_errors, out_of_view
from surgbench.tasks.instrument.records import (
    ABSENT,
    REFERENCE_ERRORS,
    REFERENCE_JOINTS,
    REFERENCE_KEYPOINTS,
    REFERENCE_TIPS,
)
from surgbench.tasks.instrument.rows import INSTRUMENT_COLUMNS, RECORDING_COLUMNS
from surgbench.tasks.instrument.units import UnitData
from surgbench.tasks.instrument.worker import Answer

CAMERA = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
FRAMES = 4
AWAY = (2,)  # the frame without an instrument
FLOWN = resting_state() + np.array([0, 0, 0, 1.0, 0, 0, 0, 0, 0])  # out of the picture


@pytest.fixture(scope="module")
def driver() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def data(driver: Instrument, tmp_path_factory: pytest.TempPathFactory) -> UnitData:
    """A recording of an instrument at rest, away in one frame; its tips are marked, one of them in the last frame."""
    root = tmp_path_factory.mktemp("recording")
    state = resting_state()
    mask = SilhouetteEvaluator((driver,), CAMERA).mask(state)
    (root / "masks").mkdir()
    (u1, v1), (u2, v2) = CAMERA.project(driver.tips_cam(state))
    tips, joints = ["frame,u1,v1,u2,v2"], ["frame,q1,q2,q3"]
    for frame in range(FRAMES):
        picture = np.zeros_like(mask) if frame in AWAY else mask
        stray = picture.astype(np.uint8) * 255
        stray[0, :2] = 255  # two pixels are no instrument
        (root / "masks" / f"{frame}.png").write_bytes(cv2.imencode(".png", stray)[1].tobytes())
        second = "0,0" if frame == FRAMES - 1 else f"{u2},{v2}"
        tips.append(f"{frame},{u1},{v1},{second}")
        joints.append(f"{frame},{state[6]},{state[7]},{state[8]}")
    (root / "tips.csv").write_text("\n".join(tips))
    (root / "joints.csv").write_text("\n".join(joints))
    (root / "camera.json").write_text(CAMERA.model_dump_json())
    import_masks(root, root / "out")
    dataset = open_as(InstrumentDataset, root / "out")
    return UnitData(dataset, dataset.units()[0], "none")


def answer(state: FloatArray, lost: bool = False) -> Answer:
    return Answer(state, state, 1.0, lost, None, 1.0, 1.0, 0.0, 0.0)


def errors_of(data: UnitData, answers: list[Answer]) -> dict[str, Any]:
    evaluator = SilhouetteEvaluator(data.instruments, CAMERA)
    masks = [data.sequence.mask("left", frame) for frame in range(len(answers))]
    return _errors(
        data,
        answers,
        [_mask_errors(evaluator, one.state, mask, None) for one, mask in zip(answers, masks, strict=True)],
        None,
        out_of_view(data, len(answers)),
    )


@pytest.mark.parametrize("estimate", [resting_state(), twin(resting_state())], ids=["itself", "twin"])
def test_what_a_recording_holds_has_no_error(data: UnitData, estimate: FloatArray) -> None:
    errors = errors_of(data, [answer(estimate)] * FRAMES)
    for name in REFERENCE_ERRORS:
        values = np.array(errors[name], dtype=np.float64)
        # In the last frame one tip is marked.
        lacking = {*AWAY, FRAMES - 1} if name == REFERENCE_KEYPOINTS else AWAY
        assert np.isnan(values).any(axis=1).tolist() == [frame in lacking for frame in range(FRAMES)]
        atol = 2e-4 if name in (REFERENCE_TIPS, REFERENCE_KEYPOINTS) else 1e-12
        np.testing.assert_allclose(values[~np.isnan(values)], 0.0, atol=atol)
    assert errors["rotation_error_rad"] is None
    assert errors["mask_error_true"] is None


def test_errors_are_those_of_the_tips_and_joints(data: UnitData, driver: Instrument) -> None:
    estimate = resting_state() + np.array([0, 0, 0, 0.001, 0, 0, 0.05, 0, 0.1])
    errors = errors_of(data, [answer(estimate)] * FRAMES)
    assert [errors[name][0] for name in REFERENCE_JOINTS] == [pytest.approx([off]) for off in (0.05, 0.0, 0.1)]
    off = np.linalg.norm(
        CAMERA.project(driver.tips_cam(estimate)) - CAMERA.project(driver.tips_cam(resting_state())), axis=1
    )
    assert errors[REFERENCE_TIPS][0] == pytest.approx([off.mean()], rel=1e-3)
    assert errors[REFERENCE_KEYPOINTS][0] == pytest.approx([off.sum()], rel=1e-3)
    assert errors[REFERENCE_TIPS][FRAMES - 1] == pytest.approx([off[0]], rel=1e-3)  # where one tip is marked


def test_who_flies_away_is_no_better_than_who_waits(data: UnitData) -> None:
    """A frame without the instrument counts in no error; whether it was noticed is a question of its own."""
    here = [answer(resting_state())] * FRAMES
    waits = [replace(one, lost=frame in AWAY) for frame, one in enumerate(here)]
    flies = [answer(FLOWN) if frame in AWAY else one for frame, one in enumerate(here)]
    for answers, recall in ((waits, 1.0), (flies, 0.0)):
        errors = errors_of(data, answers)
        assert [error is None for error in errors["mask_error"]] == [frame in AWAY for frame in range(FRAMES)]
        assert max(error for error in errors["mask_error"] if error is not None) < 0.01
        assert errors[ABSENT] == [float(frame in AWAY) for frame in range(FRAMES)]
        assert [value for value in errors["lost_recall"] if value is not None] == [recall]
    assert [value for value in errors_of(data, waits)["lost_precision"] if value is not None] == [1.0]
    assert errors_of(data, []).keys() == errors_of(data, waits).keys()


def test_the_joints_of_the_readings_are_clipped_as_trackers_see_them(data: UnitData, driver: Instrument) -> None:
    """Jaws that press read below 0; an estimate of closed jaws agrees with them."""
    from surgbench.references import reference_joint_errors

    pressing = np.array([[0.3, -0.2, -0.3], [np.nan] * 3])
    closed = np.tile(resting_state(), (2, 1))
    closed[:, JOINTS] = [0.3, -0.2, 0.0]
    errors = reference_joint_errors(closed, pressing, driver.search_limits, driver.observed)
    np.testing.assert_allclose(errors[0], 0.0, atol=1e-12)
    assert np.isnan(errors[1]).all()


# --- in the leaderboard


def recording(**axes: Any) -> dict[str, Any]:
    content: dict[str, Any] = record(truth=False, dataset=("real", "cd" * 32), frames=4, **axes)
    content["errors"] |= {
        ABSENT: [0.0, 0.0, 1.0, 0.0],
        REFERENCE_TIPS: [[2.0], [4.0], [None], [6.0]],
        **{name: [[0.1], [0.2], [None], [0.3]] for name in REFERENCE_JOINTS},
    }
    return content


def test_a_recordings_row_has_columns_of_its_own(tmp_path: Path) -> None:
    (row,) = read_rows([write(tmp_path, recording())])
    assert row["absent_frames"] == 1
    assert row["reference_tip_error_px"] == pytest.approx(4.0)
    assert row["reference_tip_error_px_std"] == pytest.approx(np.std([2, 4, 6]))
    assert row["reference_q3_error_rad"] == pytest.approx(0.2)
    assert row["tip_error_m"] is None
    header = render.csv([row]).partition("\n")[0].split(",")
    assert header == [field.key for field in (*INSTRUMENT_COLUMNS, *RECORDING_COLUMNS) if field.key in header]
    assert {"absent_frames", "reference_tip_error_px", "reference_q1_error_rad_sem"} <= {*header, *row}
    assert json.loads(render.json([row]))[0]["reference_tip_error_px"] == pytest.approx(4.0)
    assert "marked tips [px]" in render.markdown([row])
    assert csv_text(leaderboard(tmp_path)) == render.csv([row])


def test_rows_with_truth_have_none_of_them(tmp_path: Path) -> None:
    """So that tables made before stay what they are."""
    (row,) = read_rows([write(tmp_path / "synthetic", record())])
    lost = ("time_lost_share", "losses", "regained")
    assert render.csv([row]).partition("\n")[0] == ",".join((*keys(INSTRUMENT_COLUMNS), *lost))
    assert "reference" not in render.json([row])
    both = read_rows([tmp_path / "synthetic", write(tmp_path / "real", recording())])
    assert len(both) == 2
    tips = {row["dataset"]: row["reference_tip_error_px"] for row in json.loads(render.json(both))}
    assert tips == {"mini": None, "real": pytest.approx(4.0)}
    shown = render.markdown(both)
    assert shown.count("marked tips") == 1
    assert shown.index("### mini") < shown.index("### real") < shown.index("marked tips")


def test_the_silhouette_of_a_recordings_state_is_its_mask(data: UnitData) -> None:
    """The fixture is what it says."""
    reference = Reference(data.sequence.mask("left", 0))
    score = SilhouetteEvaluator(data.instruments, CAMERA).score(resting_state()[None], reference)
    assert score.overlap[0] == score.area[0]
