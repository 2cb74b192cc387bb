"""Camera arms as data: their files, their kinematics, and every controller on every one of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commandline import surgbench
from hypothesis import given
from hypothesis import strategies as st

from surgbench.config import packaged_names
from surgbench.dataset.manifest import MANIFEST_NAME
from surgbench.dataset.open import open_as
from surgbench.errors import ConfigError
from surgbench.generators.wire_chasers import load_wire_chaser
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.randomness import generator
from surgbench.registry import create, discover, find
from surgbench.tasks.viewpoint.conformance.worlds import circling, random_trial
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.arm_files import CameraArmSpec, load_camera_arm
from surgbench.viewpoint.camera_arm import PSM_CLASSIC, ROLL, CameraArm
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.setting_up import aim, rest, turned_base, unseen
from surgbench.viewpoint.simulator import Simulation, make_scene
from surgbench.viewpoint.trial import Trial

ARMS = {name: load_camera_arm(name).arm() for name in packaged_names("camera_arms")}
ENDOSCOPES = [name for name in ARMS if name.startswith("ecm")]
# Any wire will do, so that it is found at once.
QUICK = (
    *("wire-chaser-mini", "--sequences", 1, "--frames", 120, "--jobs", 1),
    *("--set", "level=custom", "--set", "share=[0,1]", "--set", "name=ours"),
)
# All that run here, but for those that know the future.
CONTROLLERS = sorted(
    name
    for name, found in discover("tracker").items()
    if found.task == "viewpoint" and found.unavailable is None and not getattr(found.cls, "foresees", False)
)

shares = st.lists(st.floats(0.001, 0.999), min_size=6, max_size=6).map(np.array)
arms = st.sampled_from(sorted(ARMS))


def joints_of(arm: CameraArm, share: FloatArray) -> FloatArray:
    return np.asarray(arm.lower + share * (arm.upper - arm.lower))


@cache
def held_by(name: str) -> Trial:
    """A ring that goes round in a circle, and an arm set up to see it."""
    arm, trial = ARMS[name], circling(240)
    base = turned_base(arm, trial.T_world_base, trial.T_world_feature[:1], trial.distance_m)
    touched = trial.touches.world_m
    touches = Touches(touched, (touched - base[:3, 3]) @ base[:3, :3])
    start = aim(arm, base, trial.T_world_feature[0], trial.distance_m).joints
    return replace(trial, arm=arm, T_world_base=base, touches=touches, start=start, truth=None)


def test_the_default_arm_is_the_one_that_there_always_was() -> None:
    assert ARMS["psm_classic"] == PSM_CLASSIC == CameraArm()


@given(arms, shares)
def test_the_closed_form_undoes_the_forward_kinematics_of_every_arm(name: str, share: FloatArray) -> None:
    """Joints come back; near the remote centre, where few millimetres turn the arm, as exactly as these allow."""
    arm = ARMS[name]
    joints = joints_of(arm, share)
    joints[2] = max(joints[2], 0.02 - arm.packed[:2].sum())
    np.testing.assert_allclose(arm.inverse(arm.forward(joints), joints), joints, atol=1e-9)


@given(st.sampled_from(ENDOSCOPES), shares)
def test_an_endoscope_lies_in_its_shaft_and_looks_along_it_or_30_degrees_off(name: str, share: FloatArray) -> None:
    """The robot's files: tip 0.7 mm beyond the remote centre at 0; the bent tips look to the picture's lower or upper
    edge (y axes point up)."""
    arm = ARMS[name]
    joints = joints_of(arm, share)
    pose, shaft = arm.forward(joints), arm.manipulator.forward(joints[:4])
    np.testing.assert_allclose(pose[:3, 3], (joints[2] + 0.0007) * shaft[:3, 2], atol=1e-12)
    turn = {"ecm": 0.0, "ecm_30_down": np.radians(30), "ecm_30_up": -np.radians(30)}[name]
    straight = ARMS["ecm"].forward(np.where(arm.locked, 0.0, joints))
    bent = rotation_from_vector(np.array([turn, 0.0, 0.0]))
    np.testing.assert_allclose(pose[:3, :3], straight[:3, :3] @ bent, atol=1e-12)
    # Its own frame in the robot's words: x = -y4, y = x4 of the roll joint as the robot reads it, a quarter less.
    robot = arm.manipulator.forward(joints[:4] - [0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(straight[:3, 0], -robot[:3, 1], atol=1e-12)
    np.testing.assert_allclose(straight[:3, 1], robot[:3, 0], atol=1e-12)


@pytest.mark.parametrize("name", sorted(ARMS))
def test_every_arm_is_set_up_to_see(name: str) -> None:
    """Level, upright, from about the wanted distance, amid its limits; and at rest where the rules allow."""
    trial = held_by(name)
    scene = make_scene(trial)
    start = rest(trial.T_world_feature[0], trial.distance_m, scene.workspace, trial.arm, scene.T_world_base)
    assert start is not None
    pose = scene.T_world_base @ trial.arm.forward(start)
    view = aim(trial.arm, scene.T_world_base, trial.T_world_feature[0], trial.distance_m)
    assert view.angle_rad < np.radians(0.1)
    assert view.distance_m == pytest.approx(trial.distance_m, abs=1e-3)
    assert abs(pose[2, 0]) < 1e-2
    assert pose[2, 1] > 0
    margin = np.minimum(start - trial.arm.lower, trial.arm.upper - start)[~trial.arm.locked]
    assert (margin > 0).all()
    assert unseen(trial.arm, scene.T_world_base, trial.T_world_feature, trial.distance_m) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["psm_si", "ecm", "ecm_30_down"])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_every_controller_moves_every_arm_within_its_limits(controller: str, name: str) -> None:
    """Round a circle, and in worlds in which features are anywhere: finite, within limits, locked joints at rest."""
    arm = ARMS[name]
    rng = generator(check=f"{controller} {name}")
    for trial in (held_by(name), *(replace(random_trial(rng, 8), arm=arm) for _ in range(8))):
        trial = replace(trial, start=arm.clip(trial.start))
        course = Simulation(create(find("tracker", controller), {}), trial, make_scene(trial), rng, 100).run()
        assert np.isfinite(course.joints).all()
        assert arm.within_limits(course.setpoints, 1e-9).all()
        assert (course.setpoints[:, arm.locked] == arm.lower[arm.locked]).all()
        steps = np.diff(course.setpoints, axis=0) / trial.dt_s
        assert (np.abs(steps) <= np.array(arm.velocity) * (1 + 1e-6)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ENDOSCOPES)
def test_an_endoscope_keeps_the_feature_in_the_middle(name: str) -> None:
    """With four joints the place is not free; where it looks and from how far is."""
    trial = held_by(name)
    scene = make_scene(trial)
    course = Simulation(create(find("tracker", "gaze"), {}), trial, scene, np.random.default_rng(0)).run()
    poses = scene.T_world_base @ trial.arm.forward(course.joints[1:])
    away = trial.T_world_feature[:, :3, 3] - poses[:, :3, 3]
    length = np.linalg.norm(away, axis=1)
    off = np.degrees(np.arccos(np.clip((poses[:, :3, 2] * away).sum(axis=1) / length, -1, 1)))
    assert off.max() < 2.0
    assert np.abs(length - trial.distance_m).max() < 0.005


def test_a_dataset_keeps_its_arm_and_needs_no_file_for_it(tmp_path: Path) -> None:
    """A user's own file is written into the manifest; the default arm is not, and old datasets stay what they are."""
    spec = load_camera_arm("psm_si").model_copy(update={"name": "ours", "camera_m": 0.05})
    own = tmp_path / "ours.yaml"
    own.write_text(spec.model_dump_json(exclude_none=True))
    folder = tmp_path / "data"
    surgbench("generate", *QUICK, "--set", f"camera_arm={own}", "--out", folder)
    own.unlink()
    dataset = open_as(ViewpointDataset, folder)
    assert dataset.trial("000").arm == dataset.arm == spec.arm()
    assert dataset.manifest.configuration["preset"]["camera_arm"]["camera_m"] == 0.05
    surgbench("validate", folder)
    default = load_wire_chaser("wire-chaser-mini", settings={"camera_arm": "psm_classic"})
    assert "camera_arm" not in default.model_dump(mode="json")
    assert default.arm == PSM_CLASSIC


def test_an_arm_that_cannot_reach_the_trial_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At validation, and before a run: 'too short' is 0.2 m short of the feature."""
    folder = tmp_path / "data"
    surgbench("generate", *QUICK, "--out", folder)
    short = load_camera_arm("ecm").model_dump(mode="json", exclude_none=True)
    short |= {"name": "too_short", "roll_offset_m": 0.39}
    short["joints"]["insertion"]["limits"] = [0.0, 0.01]
    path = folder / MANIFEST_NAME
    manifest = open_as(ViewpointDataset, folder).manifest
    start = (0.0, 0.0, 0.005, 1.5, 0.0, 0.0)
    entry = manifest.trials[0].model_copy(update={"start": start, "distance_m": 0.05})
    update = {"camera_arm": CameraArmSpec.model_validate(short), "trials": (entry,)}
    path.write_bytes(manifest.model_copy(update=update).to_bytes())
    capsys.readouterr()
    surgbench("validate", folder, expect=2)
    assert "trial '000': camera arm 'too_short' can look at the feature nowhere" in capsys.readouterr().err
    surgbench("run", "--dataset", folder, "--tracker", "static", "--out", tmp_path / "runs", expect=2)
    error = capsys.readouterr().err
    assert "can look at the feature nowhere from within 0.1 m: its remote centre is" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("joints", "yaw", "limits", [-90, 90]), "are its limits in degrees?"),
        (("joints", "yaw", "limits", [1.0, -1.0]), "limits must be [least, largest]"),
        (("joints", "roll", "velocity", None), "a joint needs limits, velocity and acceleration, or locked"),
        (("joints", "roll", "locked", 0.0), "a joint that is locked has no limits"),
        (("joints", "insertion", "limits", [-0.1, 0.2]), "above the remote centre"),
        (("wrist_lenght_m", 0.01), "did you mean 'wrist_length_m'?"),
        (("roll_offset_m", float("nan")), "roll_offset_m"),
    ],
)
def test_a_wrong_file_is_one_line(change: tuple[object, ...], said: str, tmp_path: Path) -> None:
    content = load_camera_arm("psm_classic").model_dump(mode="json", exclude_none=True)
    here: Any = content
    *sections, key, value = change
    for section in sections:
        here = here[section]
    here[key] = value
    path = tmp_path / "arm.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError) as raised:
        load_camera_arm(path)
    assert said in str(raised.value)
    assert str(path) in str(raised.value)


def test_the_rolls_middle_is_where_the_closed_form_gives_it() -> None:
    """An endoscope's roll goes from 0 to half a turn: no pose that it has is given as out of its limits."""
    arm = ARMS["ecm"]
    joints = np.array([0.3, 0.2, 0.1, 3.0, 0.0, 0.0])
    pose = rigid_transform(np.eye(3), np.zeros(3)) @ arm.forward(joints)
    assert arm.inverse(pose)[ROLL] == pytest.approx(3.0)
