"""Half the jaws' opening or all of it: what nobody says is decided by the masks, or asked for; never guessed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import surgbench

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import JOINTS
from surgbench.tasks.instrument.dataset import InstrumentDataset

CAMERA = Camera(width=175, height=123, fx=226.5, fy=226.2, cx=73.2, cy=59.3)
FRAMES = 3
WRIST_COLUMN = 70  # what lies to its right is the wrist and the jaws
OURS, NAMED, DVRK = "q1,q2,q3", "wrist_pitch,wrist_yaw,half_jaw", "wrist_pitch,wrist_yaw,jaw"
ASKED = "(--jaw half), or the whole angle between the jaws (--jaw full)? The masks do not tell"


def states(jaw_rad: float) -> FloatArray:
    """An instrument that turns about its shaft, from frame to frame."""
    turning = np.tile([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, jaw_rad], (FRAMES, 1))
    turning[:, 1] += 0.15 * np.arange(FRAMES)
    return turning


def recording(root: Path, jaw_rad: float, header: str, factor: float, hidden: bool = False) -> Path:
    """Masks of jaws that open by ``jaw_rad`` to each side, and a file that has ``factor`` times that."""
    (root / "masks").mkdir(parents=True)
    evaluator = SilhouetteEvaluator((load_instrument("large_needle_driver"),), CAMERA)
    rows = []
    for frame, state in enumerate(states(jaw_rad)):
        mask = np.where(evaluator.mask(state), 255, 0).astype(np.uint8)
        if hidden:
            mask[:, WRIST_COLUMN:] = 0
        (root / "masks" / f"{frame}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
        rows.append(",".join(map(str, [frame, *(state[JOINTS] * [1, 1, factor]).tolist()])))
    (root / "joints.csv").write_text("\n".join([f"frame,{header}", *rows]))
    (root / "camera.json").write_text(CAMERA.model_dump_json())
    return root


def imported(root: Path, *options: object) -> FloatArray:
    """The readings' jaw, ``(frames,)``."""
    surgbench("import", "masks", root, "--out", root / "data", *options)
    readings = open_as(InstrumentDataset, root / "data").sequences[0].readings("left")
    assert readings is not None
    return np.asarray(readings[:, 2])


def refused(root: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    surgbench("import", "masks", root, "--out", root / "data", expect=2)
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not (root / "data").exists()
    return error


@pytest.mark.slow
@pytest.mark.parametrize(("header", "right", "option"), [(OURS, 1.0, "full"), (DVRK, 2.0, "half")])
def test_the_masks_decide(
    header: str, right: float, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = imported(recording(tmp_path / "right", 0.3, header, right))
    np.testing.assert_allclose(found, 0.3)
    assert "the masks fit" in capsys.readouterr().err
    wrong = recording(tmp_path / "wrong", 0.3, header, 3.0 - right)
    assert f": --jaw {option}, else --jaw " in refused(wrong, capsys)
    np.testing.assert_allclose(imported(wrong, "--jaw", option), 0.3)


@pytest.mark.slow
def test_jaws_that_no_mask_shows_are_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = recording(tmp_path / "hidden", 0.3, OURS, 1.0, hidden=True)
    assert ASKED in refused(root, capsys)
    np.testing.assert_allclose(imported(root, "--jaw", "half"), 0.3)


@pytest.mark.parametrize(("header", "jaw_rad"), [(NAMED, 0.3), (OURS, 0.04)], ids=["its name says it", "closed"])
def test_what_is_plain_is_not_asked(header: str, jaw_rad: float, tmp_path: Path) -> None:
    root = recording(tmp_path / "plain", jaw_rad, header, 1.0, hidden=True)
    np.testing.assert_allclose(imported(root), jaw_rad)
