"""BOP's scenes: objects become arms, and poses become states where it is said what joints they follow from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commandline import surgbench
from others import (
    CAMERA,
    LINKS,
    STATES,
    bar,
    grey,
    imported,
    put,
    put_articulated,
    put_json,
    put_scene,
    refused,
)  # fmt: skip

from surgbench.kinds import KINDS
from surgbench.tasks.instrument.dataset import InstrumentDataset


def test_objects_become_arms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = put_scene(tmp_path / "lnd/test/000003", [[5, 7], [5, 7]])
    for image in range(2):
        put(scene / f"rgb/{image:06d}.jpg", grey(image))
    dataset = imported("bop", tmp_path / "lnd", "--objects", "7=left,5=right", "--fps", 10, out=tmp_path / "data")
    assert "poses are left out" in capsys.readouterr().err
    (sequence,) = dataset.sequences
    assert (sequence.id, sequence.camera, sequence.entry.kinds) == ("000003", CAMERA, ("left", "right", "both"))
    assert sequence.states("left") is None
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1])
    assert np.array_equal(sequence.mask("right", 1), bar(1, 4))
    assert np.array_equal(sequence.mask("left", 1), bar(1, 14))
    picture = sequence.image(1)
    assert picture is not None
    assert picture.mean() == pytest.approx(30, abs=2)


def test_one_object_twice_is_told_apart_by_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = put_scene(tmp_path / "000000", [[1, 1], [1, 1]])
    assert "has object 1 twice; --order left,right" in refused(capsys, "bop", scene, out=tmp_path / "data")
    sequence = imported("bop", scene, "--order", "right,left", out=tmp_path / "data").sequences[0]
    assert np.array_equal(sequence.mask("left", 0), bar(0, 14))


def test_a_single_object_is_one_arm_and_leaves(tmp_path: Path) -> None:
    scene = put_scene(tmp_path / "000000", [[3], []])
    sequence = imported("bop", scene, "--arms", "right", out=tmp_path / "data").sequences[0]
    assert (sequence.arms, sequence.entry.kinds) == (("right",), ("right",))
    assert not sequence.mask("right", 1).any()


def test_joints_beside_poses_become_true_states(tmp_path: Path) -> None:
    sequence = imported("bop", put_articulated(tmp_path / "lnd"), out=tmp_path / "data").sequences[0]
    for arm, first in (("right", 0), ("left", len(LINKS))):
        states = sequence.states(arm)  # type: ignore[arg-type]
        assert states is not None
        np.testing.assert_array_equal(states, STATES[arm])
        whole = np.logical_or.reduce([bar(1, 4 + 10 * (first + k)) for k in range(len(LINKS))])
        assert np.array_equal(sequence.mask(arm, 1), whole)
        assert np.array_equal(sequence.clean_mask(arm, 1), whole)


def test_joints_that_are_not_of_the_poses_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = put_articulated(tmp_path / "lnd")
    state = STATES["left"] + [0, 0, 0, 0.001, 0, 0, 0, 0, 0]
    joints = {
        str(frame): [{"arm": "right", "state": STATES["right"][frame].tolist()}, {"arm": "left", "state": row.tolist()}]
        for frame, row in enumerate(state)
    }
    put_json(root / "test/000000/scene_joints.json", joints)
    assert "the left arm's state puts" in refused(capsys, "bop", root, out=tmp_path / "data")


def test_what_does_not_fit_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    root = tmp_path / "lnd"
    scene = put_scene(root / "test/000000", [[5, 7], [5, 7]])
    assert "--objects 5=left,7=right says which is which arm" in refused(capsys, "bop", root, out=out)
    told = ("--objects", "5=left")
    assert "--objects: must be like" in refused(capsys, "bop", root, "--objects", "five=left", out=out)
    assert "--masks visible" in refused(capsys, "bop", root, *told, "--masks", "whole", out=out)
    put_scene(root / "train/000000", [[5]])
    assert "--split test takes one" in refused(capsys, "bop", root, *told, out=out)
    assert "--split val" in refused(capsys, "bop", root, *told, "--split", "val", out=out)
    (scene / "mask_visib/000001_000000.png").unlink()
    assert "000001_000000.png: missing" in refused(capsys, "bop", scene, *told, out=out)
    put_json(scene / "scene_gt.json", {"0": []})
    assert "image 1 is missing" in refused(capsys, "bop", scene, *told, out=out)
    put_json(scene / "scene_camera.json", {"0": {"cam_K": [1, 2]}})
    assert "'cam_K' must be 9 numbers" in refused(capsys, "bop", scene, *told, out=out)
    assert "holds no scenes" in refused(capsys, "bop", root / "test" / "000000" / "mask_visib", *told, out=out)


@pytest.mark.slow
@pytest.mark.skipif("exporter" not in KINDS, reason="there are no exporters")
def test_what_is_exported_comes_back(tmp_path: Path) -> None:
    """To the last bit: states, and masks as if nothing hid an arm."""
    first = imported("bop", put_articulated(tmp_path / "lnd"), out=tmp_path / "first")
    surgbench("export", first.path, "--format", "bop", "--out", tmp_path / "bop")
    second: InstrumentDataset = imported("bop", tmp_path / "bop", out=tmp_path / "second")
    for arm in ("left", "right"):
        np.testing.assert_array_equal(second.sequences[0].states(arm), STATES[arm])
    assert second.sequences[0].camera == first.sequences[0].camera
