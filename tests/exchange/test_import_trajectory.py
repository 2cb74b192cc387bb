"""One's own motion becomes trials: as recorded, in a scene that is told or put around it, and doubted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from commandline import surgbench
from others import refused
from scipy.spatial.transform import Rotation
from trajectories import STEPS, feature, put_table

from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.generators.wire_chaser.presets import Measurement, WireChaser
from surgbench.generators.wire_chaser.trial import make_trial
from surgbench.geometry import inverse_transform, rigid_transform
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.arm_files import load_camera_arm
from surgbench.viewpoint.placement import look_at
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.simulator import Simulation, make_scene

ZONE = [[-0.041, -0.038, 0.0], [0.041, -0.038, 0.0], [0.041, 0.038, 0.0], [-0.041, 0.038, 0.0], [0.0, 0.0, 0.0494]]
# Any wire will do, so that it is found at once; with gaps.
GENERATED = WireChaser(
    task="viewpoint", name="small", trials=1, samples=250, level="custom", share=(0.0, 1.0),
    measurement=Measurement(dropout=0.02),
)  # fmt: skip
OFFSET = rigid_transform(np.eye(3), np.array([0.0, 0.0, 0.033]))


def imported(source: Path | list[Path], *options: object, out: Path) -> ViewpointDataset:
    """What the command makes of it; sound, and with nothing left beside it."""
    sources = [source] if isinstance(source, Path) else source
    surgbench("import", "trajectory", *sources, *options, "--out", out)
    assert validate(out) == []
    assert not list(out.parent.glob(".*"))
    return open_as(ViewpointDataset, out)


def put_scene(path: Path, **content: object) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The feature's own poses."""
    return put_table(tmp_path / "path.csv", *feature())


def test_a_generated_trials_motion_comes_back(tmp_path: Path) -> None:
    """Written as a table, and in again: the same poses at the same times, gaps included."""
    trial = make_trial(GENERATED, "000")
    measured = trial.measured
    assert not measured.all()
    table = put_table(tmp_path / "000.csv", trial.timestamps_s[measured], trial.T_world_feature[measured])
    again = imported(table, "--of", "feature", "--gap", 0.02, out=tmp_path / "data").trial("000")
    last = int(np.flatnonzero(measured)[-1]) + 1
    assert np.array_equal(again.measured, measured[:last])
    np.testing.assert_allclose(again.timestamps_s, trial.timestamps_s[:last], atol=1e-12)
    np.testing.assert_allclose(again.T_world_feature, trial.T_world_feature[:last], atol=1e-12)


def test_a_motion_alone_gets_a_scene_that_works(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The camera looks from where the rules allow it, and what was assumed is one line."""
    dataset = imported(path, "--of", "feature", out=tmp_path / "data")
    told = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("assumed: ") for line in told) == 1
    assert not [line for line in told if "warning" in line]
    assert (dataset.name, [trial.id for trial in dataset.trials]) == ("path", ["path"])
    assert dataset.manifest.origin == "imported"
    trial = dataset.trial("path")
    scene = make_scene(trial)
    assert trial.truth is None
    assert scene.registration_error_m < 1e-12
    assert naive_violations(trial, scene).any.mean() < 0.05
    assert (scene.workspace.zone.depth(trial.T_world_feature[:, :3, 3]) > 0).all()
    pose = scene.T_world_base @ trial.arm.forward(trial.start)
    towards = trial.T_world_feature[0, :3, 3] - pose[:3, 3]
    assert np.linalg.norm(towards) == pytest.approx(trial.distance_m)
    assert pose[:3, 2] @ towards == pytest.approx(trial.distance_m)


def test_the_scene_goes_with_the_motion(path: Path, tmp_path: Path) -> None:
    """A motion that is turned about the vertical and moved gets the same scene, turned and moved."""
    times, poses = feature()
    turn = rigid_transform(Rotation.from_euler("z", 2.0).as_matrix(), np.array([0.3, -0.2, 0.1]))
    other = put_table(tmp_path / "other.csv", times, turn @ poses)
    one = imported(path, "--of", "feature", out=tmp_path / "one").trial("path")
    two = imported(other, "--of", "feature", out=tmp_path / "two").trial("other")
    np.testing.assert_allclose(two.zone_m, one.zone_m @ turn[:3, :3].T + turn[:3, 3], atol=1e-9)
    np.testing.assert_allclose(two.T_world_base[:3, 3], (turn @ one.T_world_base)[:3, 3], atol=1e-9)
    rules = [naive_violations(trial, make_scene(trial)).any.mean() for trial in (one, two)]
    assert rules[0] == rules[1]


def test_the_feature_is_where_the_tool_holds_it(tmp_path: Path) -> None:
    """33 mm along the tool's z, its normal the tool's y; other axes and offsets may be told."""
    times, poses = feature()
    tool = put_table(tmp_path / "tool.csv", times, poses @ inverse_transform(OFFSET))
    trial = imported(tool, out=tmp_path / "data").trial("tool")
    np.testing.assert_allclose(trial.T_world_feature, poses, atol=1e-12)
    scene = put_scene(tmp_path / "scene.yaml", feature={"offset_m": [0.01, 0.0, 0.0], "normal": "-x"})
    again = imported(tool, "--scene", scene, out=tmp_path / "again").trial("tool").T_world_feature
    tools = poses @ inverse_transform(OFFSET)
    np.testing.assert_allclose(again[:, :3, 1], -tools[:, :3, 0], atol=1e-12)
    np.testing.assert_allclose(again[:, :3, 2], tools[:, :3, 2], atol=1e-12)
    np.testing.assert_allclose(again[:, :3, 3], tools[:, :3, 3] + 0.01 * tools[:, :3, 0], atol=1e-12)


def test_poses_in_another_frame_are_brought_into_the_world(tmp_path: Path) -> None:
    times, poses = feature()
    cart = {"position_m": [0.165, -0.118, 0.22], "quaternion_xyzw": [0.0, 0.0, 0.28, 0.96]}
    place = rigid_transform(Rotation.from_quat([0, 0, 0.28, 0.96]).as_matrix(), np.array([0.165, -0.118, 0.22]))
    table = put_table(tmp_path / "path.csv", times, inverse_transform(place) @ poses)
    scene = put_scene(tmp_path / "scene.yaml", frames={"cart": cart}, base=cart)
    for frame in ("cart", "camera-base"):
        out = tmp_path / frame
        trial = imported(table, "--of", "feature", "--scene", scene, "--frame", frame, out=out).trial("path")
        np.testing.assert_allclose(trial.T_world_feature, poses, atol=1e-12)


def test_a_whole_scene_may_be_told(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Base, touches, zone, rules, start: nothing is assumed then, and all of it is in the dataset."""
    base = rigid_transform(np.eye(3), np.array([0.165, -0.118, 0.22]))
    arm = load_camera_arm("psm_si").arm()
    first = feature()[1][0]
    place = first[:3, 3] + 0.12 * first[:3, 1]
    start = arm.inverse(inverse_transform(base) @ look_at(place, first[:3, 3]))
    touched = np.array(ZONE) + np.array([0.0, 0.0, 0.02])
    scene = put_scene(
        tmp_path / "scene.yaml",
        camera_arm="psm_si",
        base={"position_m": base[:3, 3].tolist()},
        touches={"world_m": touched.tolist(), "base_m": (touched - base[:3, 3]).tolist()},
        zone_m=ZONE,
        start=start.tolist(),
        distance_m=0.12,
        floor_m=0.03,
        proximity_m=0.07,
        preferred_side=[2.0, 0.0, 0.0],
    )
    dataset = imported(path, "--of", "feature", "--scene", scene, "--dt", 0.02, out=tmp_path / "data")
    assert "assumed" not in capsys.readouterr().err
    trial = dataset.trial("path")
    assert trial.arm == arm == dataset.arm
    assert (trial.distance_m, trial.floor_m, trial.proximity_m, trial.dt_s) == (0.12, 0.03, 0.07, 0.02)
    assert trial.preferred_side == (1.0, 0.0, 0.0)
    np.testing.assert_array_equal(trial.zone_m, ZONE)
    np.testing.assert_array_equal(trial.T_world_base, base)
    np.testing.assert_array_equal(trial.start, start)


def test_touches_alone_say_where_the_base_is(path: Path, tmp_path: Path) -> None:
    turn = Rotation.from_euler("xyz", [0.05, -0.1, 0.4]).as_matrix()
    base = rigid_transform(turn, np.array([0.165, -0.118, 0.22]))
    touched = np.array(ZONE)
    touches = {"world_m": touched.tolist(), "base_m": ((touched - base[:3, 3]) @ turn).tolist()}
    scene = put_scene(tmp_path / "scene.yaml", touches=touches)
    trial = imported(path, "--of", "feature", "--scene", scene, out=tmp_path / "data").trial("path")
    np.testing.assert_allclose(trial.T_world_base, base, atol=1e-9)


def test_several_files_are_several_trials_of_one_scene(path: Path, tmp_path: Path) -> None:
    times, poses = feature()
    (tmp_path / "more").mkdir()
    put_table(tmp_path / "more" / "second one.csv", times[:100], poses[:100] @ OFFSET)
    put_table(tmp_path / "more" / "third.csv", times[:80], poses[:80])
    (tmp_path / "more" / "notes.md").write_text("none of these")
    dataset = imported([path, tmp_path / "more"], "--of", "feature", out=tmp_path / "data")
    assert [(one.id, one.frames) for one in dataset.trials] == [("path", STEPS), ("second-one", 100), ("third", 80)]
    zones = {dataset.trial(one.id).zone_m.tobytes() for one in dataset.trials}
    assert len(zones) == 1


def test_gaps_are_held_and_jumps_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """While nothing is measured the controller is not asked, and the arm rests."""
    times, poses = feature()
    poses[120:, :3, 3] += [0.02, 0.0, 0.0]
    keep = np.ones(STEPS, dtype=bool)
    keep[40:70] = False
    table = put_table(tmp_path / "path.csv", times[keep], poses[keep])
    trial = imported(table, "--of", "feature", out=tmp_path / "data").trial("path")
    told = capsys.readouterr().err
    assert "1 gap longer than 0.1 s, together 0.391 s, count as not measured; the longest, of 0.391 s, is after" in told
    assert "warning: path.csv: 1 of 160 samples are faster than 0.5 m/s" in told
    assert np.array_equal(trial.measured, keep)
    scene = make_scene(trial)
    course = Simulation(create(find("tracker", "naive"), {}), trial, scene, np.random.default_rng(0)).run()
    assert np.array_equal(course.asked, keep)
    assert np.isfinite(course.joints).all()
    assert (course.setpoints[60] == course.setpoints[70]).all()


@pytest.mark.parametrize("name", ["ecm", "psm_si"])
def test_the_scene_suits_the_arm(name: str, path: Path, tmp_path: Path) -> None:
    dataset = imported(path, "--of", "feature", "--camera-arm", name, out=tmp_path / "data")
    trial = dataset.trial("path")
    assert dataset.manifest.camera_arm == load_camera_arm(name)
    pose = make_scene(trial).T_world_base @ trial.arm.forward(trial.start)
    towards = trial.T_world_feature[0, :3, 3] - pose[:3, 3]
    assert np.linalg.norm(np.cross(pose[:3, 2], towards)) < 0.001


def test_bad_recordings_are_one_line(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    times, poses = feature()
    assert "no such file or folder" in refused(capsys, "trajectory", tmp_path / "none.csv", out=out)
    (tmp_path / "empty").mkdir()
    assert "holds no recording; expected .csv" in refused(capsys, "trajectory", tmp_path / "empty", out=out)
    poses_mm = poses.copy()
    poses_mm[:, :3, 3] *= 1e3
    millimetres = put_table(tmp_path / "mm.csv", times, poses_mm, "t,x,y,z,qx,qy,qz,qw")
    assert "did you give millimetres? --unit mm" in refused(capsys, "trajectory", millimetres, out=out)
    assert "--columns: unknown field 'tiem'; did you mean 'time'?" in refused(
        capsys, "trajectory", path, "--columns", "tiem=t", out=out
    )
    assert "--frame: unknown frame 'cart'" in refused(capsys, "trajectory", path, "--frame", "cart", out=out)
    assert "needs 'base' in the file of --scene" in refused(
        capsys, "trajectory", path, "--frame", "camera-base", out=out
    )
    assert "did you mean 'psm_classic'" in refused(capsys, "trajectory", path, "--camera-arm", "psm_clasic", out=out)
    surgbench("import", "trajectory", path, path, "--out", out, expect=2)
    assert "there are two recordings called 'path'" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"zone_m": [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0, 0, 0.05]]}, "base points are collinear"),
        ({"zone_m": [[*point[:2], 0.0] for point in ZONE]}, "zone has no height"),
        ({"zone_m": ZONE[:4]}, "'zone_m'"),
        ({"zoen_m": ZONE}, "did you mean 'zone_m'"),
        ({"base": {"position_m": [0, 0, 0.2], "quaternion_xyzw": [0, 0, 0, 0]}}, "a quaternion must not be zero"),
        ({"base": {"position_m": [5, 0, 0.2]}}, "camera arm 'psm_classic' can look at the feature nowhere"),
        ({"start": [0, 0, 9, 0, 0, 0]}, "start joint 3 is 9, outside its limits [0, 0.24]"),
        ({"touches": {"world_m": [[0, 0, 0]], "base_m": []}}, "world_m has 1 points and base_m 0"),
        ({"zone_m": [[1e3 * x for x in point] for point in ZONE]}, "is it in millimetres?"),
        (
            {"zone_m": [*ZONE[:4], [0, 0, -0.05]]},
            "its fifth point is as high as the zone's top, and must be above its base",
        ),
        ({"base": {"position_m": [1e300, 0, 0.2]}}, "base.position_m is 1e+300 m off"),
        ({"touches": {"world_m": [[0, 0, 0]], "base_m": [[0, 290.0, 0]]}}, "touches.base_m is 290 m off"),
        ({"distance_m": 0.05}, "distance_m is 0.05, but proximity_m keeps the camera 0.08 away"),
        ({"touches": {"world_m": [[0, 0, 0]], "base_m": [[0, 0, 0]]}}, "touches say where the base is"),
        ({"preferred_side": [0, 0, 0]}, "preferred_side must not be zero"),
        ({"feature": {"normal": "w"}}, "normal"),
        ({"distance_m": -1}, "distance_m"),
        ({"frames": {"world": {"position_m": [0, 0, 0]}}}, "are known already"),
    ],
)
def test_scenes_that_cannot_be_are_one_line(
    content: dict[str, object], said: str, path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = put_scene(tmp_path / "scene.yaml", **content)
    assert said in refused(capsys, "trajectory", path, "--of", "feature", "--scene", scene, out=tmp_path / "data")


def test_touched_points_in_another_order_are_doubted(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.08, 0.0], [0.0, 0.0, 0.03]]
    away = [[x - 0.2, y, z - 0.19] for x, y, z in world]
    for number, (touched, doubted) in enumerate(((away, False), (away[::-1], True))):
        touches = {"world_m": world, "base_m": touched}
        scene = put_scene(tmp_path / "scene.yaml", touches=touches, base={"position_m": [0.2, 0, 0.19]})
        surgbench("import", "trajectory", path, "--of", "feature", "--scene", scene, "--out", tmp_path / f"{number}")
        assert ("are world_m and base_m in the same order?" in capsys.readouterr().err) == doubted


def test_a_hostile_scene_is_one_line(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text("a: &a [x, x]\nb: &b [*a, *a]\n" + "[" * 5000)
    assert "not valid YAML" in refused(capsys, "trajectory", path, "--scene", scene, out=tmp_path / "data")


def test_normals_that_point_down_are_doubted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times, poses = feature()
    down = rigid_transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    table = put_table(tmp_path / "path.csv", times, poses @ down)
    imported(table, "--of", "feature", out=tmp_path / "data")
    assert "warning: the feature's normal points down on average" in capsys.readouterr().err
    other = imported(table, "--of", "feature", "--normal", "-y", out=tmp_path / "other")
    assert "warning" not in capsys.readouterr().err
    np.testing.assert_allclose(other.trial("path").T_world_feature[:, :3, 1], poses[:, :3, 1], atol=1e-12)
