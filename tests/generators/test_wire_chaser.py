"""The wire chaser: wires that a ring can pass, a hand like AutoCam's users', and datasets that are made whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commandline import kill_before, surgbench

from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError, DatasetError
from surgbench.generation import GenerationRequest
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.presets import load_preset
from surgbench.generators.resumable import generate
from surgbench.generators.wire_chaser import job as module
from surgbench.generators.wire_chaser.hand import draw_travel, wandering
from surgbench.generators.wire_chaser.job import WirePlan
from surgbench.generators.wire_chaser.presets import SHARES, Hand, Measurement, WireChaser, WireSettings
from surgbench.generators.wire_chaser.trial import make_trial, measure
from surgbench.generators.wire_chaser.wire import WireShape, tool_axes
from surgbench.generators.wire_chasers import load_wire_chaser
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, rotation_angle, rotation_vector
from surgbench.processes.pool import ProcessPool
from surgbench.randomness import generator
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.hand.contact import lasting_contacts
from surgbench.viewpoint.motion import describe_motion, extents_m
from surgbench.viewpoint.placement import CONSTRAINTS, naive_pose, violations
from surgbench.viewpoint.registration import register, residual_m
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.setting_up import rest
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial, Wire
from surgbench.viewpoint.workspace import NoGoZone

# Fast to make: any wire will do.
ANY = WireChaser(task="viewpoint", name="any", trials=3, samples=300, level="custom", share=(0.0, 1.0))


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    """Full trials of the presets: two of the level standard, those that are found soon, and five of the level hard."""
    standard, hard = load_wire_chaser("wire-chaser"), load_wire_chaser("wire-chaser-hard")
    made = [make_trial(standard, trial_id) for trial_id in ("004", "005")]
    return made + [make_trial(hard, f"{index:03d}") for index in range(5)]


def wire_of(trial: Trial) -> Wire:
    assert trial.truth is not None
    assert trial.truth.wire is not None
    return trial.truth.wire


def true_poses(trial: Trial) -> FloatArray:
    assert trial.truth is not None
    return trial.truth.T_world_feature


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Wires


@pytest.mark.slow
def test_wires_are_such_as_the_ring_can_pass_and_lie_in_the_zone(trials: list[Trial]) -> None:
    settings = WireSettings()
    for trial in trials:
        wire = wire_of(trial)
        steps = np.diff(wire.points_m, axis=0)
        spacing = np.linalg.norm(steps, axis=1)
        along = np.append(0.0, np.cumsum(spacing))
        assert 0.134 < along[-1] < 0.251
        # Bends: the angle from step to step over the length of a step.
        unit = steps / spacing[:, None]
        turn = np.arccos(np.clip((unit[1:] * unit[:-1]).sum(axis=1), -1, 1))
        assert (spacing[1:] / turn).min() > 0.95 * settings.bend_radius_m
        assert settings.bend_radius_m > wire.ring_radius_m + wire.tube_radius_m
        zone = NoGoZone(trial.zone_m)
        assert zone.depth(wire.points_m).min() > 0
        height = (wire.points_m - zone.points[0]) @ zone.up
        assert height.min() > wire.ring_radius_m  # above the base
        apart = np.abs(along[:, None] - along) > np.pi * settings.apart_m
        gaps = np.linalg.norm(wire.points_m[:, None] - wire.points_m, axis=2)[apart]
        assert gaps.min(initial=1.0) > 0.95 * settings.apart_m > 2 * (wire.ring_radius_m + wire.tube_radius_m)


@pytest.mark.slow
def test_the_zone_has_the_published_size_and_lies_about_level(trials: list[Trial]) -> None:
    for trial in trials:
        zone = NoGoZone(trial.zone_m)
        sides = 1e3 * np.linalg.norm(np.diff(zone.points[[0, 1, 2, 3, 0]], axis=0), axis=1)
        np.testing.assert_allclose(sides, [82.3, 74.0, 82.4, 76.7], atol=2.0)
        assert 1e3 * np.linalg.norm(zone.height) == pytest.approx(49.4, abs=2.0)
        assert np.ptp(zone.points[:4, 2]) < 0.014
        assert zone.up[2] > 0.98


def test_the_tool_turns_smoothly_even_where_the_wire_points_at_its_trocar() -> None:
    angle = np.linspace(0.0, np.pi, 400)
    arc = np.stack([0.03 * np.cos(angle), np.zeros(400), 0.03 * np.sin(angle)], axis=1)
    tangent = np.stack([-np.sin(angle), np.zeros(400), np.cos(angle)], axis=1)
    wire = WireShape(0.03 * angle, arc, tangent, np.full(400, 1 / 0.03))
    axes = tool_axes(wire, np.array([0.03, 0.0, 0.2]))  # straight above the start, where the wire goes up
    np.testing.assert_allclose((axes * tangent).sum(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-9)
    assert np.linalg.norm(np.diff(axes, axis=0), axis=1).max() < 0.03
    assert (axes[200:] @ [0.0, 0.0, -1.0]).min() > 0.2 or axes[-1] @ tangent[-1] == pytest.approx(0.0)


# The hand


@pytest.mark.slow
def test_the_ring_never_goes_through_the_wire(trials: list[Trial]) -> None:
    """The circle in the ring's tube keeps the radii of tube and wire from the wire, and touches it where it says so."""
    angle = np.linspace(0.0, 2.0 * np.pi, 240, endpoint=False)
    for trial in trials[::3]:
        wire, poses = wire_of(trial), true_poses(trial)
        circle = wire.ring_radius_m * np.stack([np.cos(angle), np.zeros(240), np.sin(angle)], axis=1)
        contact = trial.truth.contact if trial.truth else None
        assert contact is not None
        gaps = []
        for pose in poses[::120]:
            near = wire.points_m[np.linalg.norm(wire.points_m - pose[:3, 3], axis=1) < 0.012]
            ring = circle @ pose[:3, :3].T + pose[:3, 3]
            gaps.append(np.linalg.norm(ring[:, None] - near, axis=2).min() - wire.radius_m - wire.tube_radius_m)
        assert min(gaps) > -2e-4  # the wire is bent, which the ellipse leaves out
        touching = np.array(gaps)[contact[::120]]
        apart = np.array(gaps)[~contact[::120]]
        assert np.median(touching) < 1.5e-4 < np.median(apart)


@pytest.mark.slow
def test_the_ring_goes_there_and_back(trials: list[Trial]) -> None:
    for trial in trials:
        wire, way = wire_of(trial), true_poses(trial)[:, :3, 3]
        nearest = np.linalg.norm(way[::50, None] - wire.points_m, axis=2).argmin(axis=1) / len(wire.points_m)
        turned = int(np.argmax(nearest))
        assert nearest[0] < 0.05
        assert nearest[turned] > 0.95
        assert nearest[-1] < 0.05
        assert 0.25 < turned / len(nearest) < 0.75
        assert (np.diff(nearest[:turned]) > -0.06).all()


@pytest.mark.slow
def test_the_normal_is_continuous_and_seen_by_the_camera_arm(trials: list[Trial]) -> None:
    for trial in trials:
        poses = true_poses(trial)
        assert all(is_rigid(pose) for pose in poses[::500])
        # No flips: from sample to sample the frame turns a little, here and where the wire is passed again.
        assert rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).max() < 0.1
        assert trial.truth is not None
        towards = trial.truth.T_world_base[:3, 3] - trial.zone_m.mean(axis=0)
        assert poses[:, :3, 1].mean(axis=0) @ towards > 0


@pytest.mark.slow
def test_the_hand_is_like_those_of_autocams_users(trials: list[Trial]) -> None:
    figures = describe_motion(trials)
    assert 60 < figures["duration_s"][0] < 90  # 74.3 +- 17.4
    assert 4 < figures["mean_speed_mm_s"][0] < 7
    tenth, median, *_ = figures["speed_mm_s_percentiles"]  # 4 and 9 mm/s
    assert 3 < tenth < 5
    assert 7 < median < 11
    assert 9 < figures["turn_deg_s_percentiles"][1] < 16  # 11.5 deg/s
    assert 18 < figures["contacts"][0] < 31  # 24.5 +- 6.4
    assert 20 < figures["contact_s"][0] < 50  # 34.9 +- 14.8
    for trial in trials:
        long, middle, short = 1e3 * extents_m(wire_of(trial).points_m)
        assert 60 <= long <= 93.5
        assert 22 <= middle <= 44
        assert 20 <= short <= 41


@pytest.mark.slow
def test_speed_follows_the_curvature_to_the_power_of_minus_a_third() -> None:
    """On a wire of two arcs, the sharper one is passed the slower by the cube root of the ratio of their radii."""
    along = np.linspace(0.0, 0.2, 401)
    curvature = np.where(along < 0.1, 1 / 0.04, 1 / 0.08)
    nowhere = np.zeros((401, 3))
    wire = WireShape(along, nowhere, nowhere, curvature)
    speeds: list[list[float]] = [[], []]
    for index in range(40):
        way = draw_travel(wire, 6000, 0.0126, Hand(), generator(test=index)).along_m
        speed = np.abs(np.diff(way)) / 0.0126
        for half, values in enumerate(speeds):
            values.append(float(speed[(way[1:] > 0.1) == bool(half)].max()))
    assert np.mean(speeds[0]) / np.mean(speeds[1]) == pytest.approx((0.04 / 0.08) ** (1 / 3), rel=0.05)


def test_wandering_has_unit_variance_and_the_rate_of_its_time_constant() -> None:
    noise = wandering(0.01 * np.arange(200_000), 0.5, 0.01, 2, generator(test="wandering"))
    np.testing.assert_allclose(noise.std(axis=0), 1.0, rtol=0.08)
    np.testing.assert_allclose(np.gradient(noise, 0.01, axis=0).std(axis=0), 1 / 0.5, rtol=0.08)


def test_contacts_do_not_chatter() -> None:
    pressed = np.full(200, -1e-3)
    pressed[50:100] = np.where(np.arange(50) % 2, 1e-5, -5e-5)  # chatters within the release distance
    pressed[104:120] = 1e-3  # and is left for less than 0.1 s
    pressed[150:153] = 1e-3  # too short
    contact = lasting_contacts(pressed, 0.0126, release_m=1e-4, shortest_s=0.1)
    assert np.flatnonzero(np.diff(contact)).tolist() == [50, 119]


def test_reports_have_a_constant_error_noise_and_gaps() -> None:
    poses = np.tile(np.eye(4), (4000, 1, 1))
    shifts, turns = [], []
    for index in range(60):
        reported = measure(poses, Measurement(), 0.0126, generator(test=index))
        shifts.append(np.linalg.norm(reported[:, :3, 3].mean(axis=0)))
        turns.append(np.linalg.norm(rotation_vector(reported[:, :3, :3]).mean(axis=0)))
    assert 1e3 * np.mean(shifts) == pytest.approx(0.5, rel=0.2)
    assert np.degrees(np.mean(turns)) == pytest.approx(0.3, rel=0.2)
    noise = reported[:, :3, 3] - reported[:, :3, 3].mean(axis=0)
    assert 1e3 * noise.std() == pytest.approx(0.03, rel=0.05)
    lost = np.isnan(measure(poses, Measurement(dropout=0.005, dropout_s=0.1), 0.0126, generator(test=0)))
    assert (lost.any(axis=(1, 2)) == lost.all(axis=(1, 2))).all()
    assert 0.01 < lost.mean() < 0.08


@pytest.mark.parametrize(
    "hand",
    [
        Hand(rest_share=(0.0, 0.0), resting_pace=0.0),
        Hand(wobble_rad=(0.0, 0.0), twist_rad=0.0, tremor_m=0.0, lean=0.0),
        Hand(speed_m_s=1e-6),
        Hand(clutch_every_s=0.1, rest_share=(0.9, 0.9)),
    ],
)
def test_the_steadiest_and_the_laziest_hands_make_whole_trials(hand: Hand) -> None:
    trial = make_trial(ANY.model_copy(update={"hand": hand}), "000")
    assert np.isfinite(true_poses(trial)).all()
    assert trial.measured.all()
    way = np.linalg.norm(np.diff(true_poses(trial)[:, :3, 3], axis=0), axis=1)
    assert way.max() < 0.2 * trial.dt_s


@pytest.mark.slow
def test_a_ring_that_is_never_measured_makes_no_trial() -> None:
    with pytest.raises(ConfigError, match="trial '000'"):
        make_trial(ANY.model_copy(update={"measurement": Measurement(dropout=1.0), "tries": 300}), "000")


# The camera arm, and how often it is constrained


@pytest.mark.slow
def test_every_trial_is_as_constrained_as_its_level_says(trials: list[Trial]) -> None:
    for trial, level in zip(trials, ["standard"] * 2 + ["hard"] * 5, strict=True):
        low, high = SHARES[level]
        assert low <= naive_violations(trial, make_scene(trial)).any.mean() <= high


@pytest.mark.slow
def test_registrations_leave_what_they_left_on_the_robot(trials: list[Trial]) -> None:
    published = {"translation": (3.3, 7.6), "rigid": (1.6, 3.6)}  # mm, of two sets of touches
    for method, (low, high) in published.items():
        residuals = [
            1e3 * residual_m(register(one.T_world_base, one.touches, method), one.touches)  # type: ignore[arg-type]
            for one in trials
        ]
        assert low < np.mean(residuals) < high
        assert min(residuals) > 0.4 * low
        assert max(residuals) < 1.3 * high
    turns, shifts = [], []
    for one in trials:
        assert one.truth is not None
        wrong = one.T_world_base @ inverse_transform(one.truth.T_world_base)
        turns.append(float(np.degrees(rotation_angle(wrong[:3, :3]))))
        shifts.append(float(np.linalg.norm(one.T_world_base[:3, 3] - one.truth.T_world_base[:3, 3])))
        remote = one.truth.T_world_base[:3, 3] - (NoGoZone(one.zone_m).corners.mean(axis=0))
        assert (remote > [0.119, -0.141, 0.148]).all()
        assert (remote < [0.189, -0.075, 0.209]).all()
    assert np.mean(turns) == pytest.approx(10.0, abs=2.0)
    assert np.mean(shifts) == pytest.approx(0.3, abs=0.04)


@pytest.mark.slow
def test_the_arm_rests_where_it_is_allowed_and_looks_at_the_ring(trials: list[Trial]) -> None:
    for trial in trials:
        scene = make_scene(trial)
        pose = scene.T_world_base @ scene.arm.forward(trial.start)
        feature = trial.T_world_feature[0, :3, 3]
        found = violations(pose[None], feature[None], scene.workspace, scene.arm, scene.T_world_base)
        assert not found.any[0]
        assert scene.arm.within_limits(trial.start)
        towards = feature - pose[:3, 3]
        assert towards @ pose[:3, 2] / np.linalg.norm(towards) == pytest.approx(1.0, abs=1e-9)
        if not naive_violations(trial, scene, 1).any[0]:
            np.testing.assert_allclose(pose, naive_pose(trial.T_world_feature[0]), atol=1e-9)


@pytest.mark.slow
def test_where_nothing_is_allowed_the_arm_cannot_rest(trials: list[Trial]) -> None:
    scene = make_scene(trials[0])
    far = trials[0].T_world_feature[0].copy()
    far[:3, 3] += 2.0
    assert rest(far, 0.11, scene.workspace, CameraArm(), scene.T_world_base) is None
    assert len(CONSTRAINTS) == 5


# Presets and the whole job


def test_presets_say_what_they_are() -> None:
    full, mini = load_wire_chaser("wire-chaser"), load_wire_chaser("wire-chaser-mini")
    assert (full.trials, full.level, full.samples) == (12, "standard", None)
    assert (mini.trials, mini.samples) == (3, 700)
    assert load_wire_chaser("wire-chaser-easy").constrained == (0.05, 0.15)
    counts = [count * 0.0126 for count in WirePlan(full.model_copy(update={"trials": 200})).samples.values()]
    assert np.mean(counts) == pytest.approx(74.3, abs=3.0)
    assert np.std(counts) == pytest.approx(15.0, abs=2.5)  # the published 17.4, without its ends
    few = GenerationRequest(sequences=2, frames=200)
    assert plan_preset("wire-chaser-mini", few).counts == "2 trials, 400 samples"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trials: 1\nwires: {}\n", "unknown key 'wires'; did you mean 'wire'?"),
        ("trials: 1\nlevel: standart\n", "'level': input should be 'easy', 'standard', 'hard' or 'custom'"),
        ("trials: 1\nlevel: custom\n", "share is for the level custom, which needs it"),
        ("trials: 1\nwire: {ring_radius_m: 0.001}\n", "the ring does not fit on the wire"),
        ("trials: 1\nwire: {bend_radius_m: 0.004}\n", "bend_radius_m must be more than the ring's outer radius"),
        ("trials: 1\nhand: {duration_range_s: [80, 90]}\n", "duration_s: its mean must lie within the range"),
        ("trials: 1\ndt_s: 0.05\n", "hand.tremor_hz must be below half the sample rate, 10"),
        ("trials: 1\nrules: {preferred_side: [1, 1, 0]}\n", "preferred_side must be of unit length"),
    ],
)
def test_a_wrong_preset_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text(f"task: viewpoint\nname: x\n{text}")
    with pytest.raises(ConfigError) as caught:
        plan_preset(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_presets_of_one_task_are_not_those_of_the_other(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a preset of the viewpoint task; expected one of the instrument task"):
        load_preset("wire-chaser")
    surgbench("generate", "wire-chaser", "--out", tmp_path / "a", "--corruption", "none", expect=2)
    assert "wire-chaser.yaml' is of the viewpoint task, which has no masks" in capsys.readouterr().err
    surgbench("generate", "wire-chaser", "--out", tmp_path / "a", "--sequences", 0, expect=2)
    assert "--sequences: input should be greater than or equal to 1, not 0" in capsys.readouterr().err


@pytest.mark.slow
def test_what_cannot_be_met_is_said_and_leaves_no_folder(tmp_path: Path) -> None:
    preset = ANY.model_copy(update={"share": (0.0, 0.0), "tries": 40})
    with pytest.raises(ConfigError, match=r"preset 'any': trial '000': none of 40 wires .* widen wire\.extent_m"):
        generate(WirePlan(preset), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_same_bytes_again_for_any_number_of_jobs_and_others_for_another_seed(tmp_path: Path) -> None:
    done: list[float] = []
    for name, jobs in (("one", 1), ("two", 2)):
        assert generate(WirePlan(ANY), tmp_path / name, workers=ProcessPool(jobs), progress=done.append)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert sum(done) == 2 * 3 * 300
    assert validate(tmp_path / "one") == []
    assert generate(WirePlan(ANY), tmp_path / "one") is False
    generate(WirePlan(ANY.model_copy(update={"seed": 1})), tmp_path / "other")
    one, other = contents(tmp_path / "one"), contents(tmp_path / "other")
    assert one.keys() == other.keys()
    assert not [name for name in one if one[name] == other[name]]
    assert not (tmp_path / "one" / "generating").exists()
    # A trial does not depend on the others.
    generate(WirePlan(ANY.model_copy(update={"trials": 1})), tmp_path / "first")
    name = "truth/000/feature.parquet"
    assert contents(tmp_path / "first")[name] == one[name]


@pytest.mark.slow
def test_a_crash_is_resumed_with_the_trial_in_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make: Callable[[WireChaser, str], Trial] = module.make_trial
    made: list[str] = []

    def failing(preset: WireChaser, trial_id: str, go_on: object) -> Trial:
        if trial_id == "001" and not made.count("001"):
            made.append(trial_id)
            raise RuntimeError("crash")
        made.append(trial_id)
        return make(preset, trial_id)

    monkeypatch.setattr(module, "make_trial", failing)
    with pytest.raises(RuntimeError, match="crash"):
        generate(WirePlan(ANY), tmp_path / "out")
    # What a power cut may leave.
    (tmp_path / "out" / "truth/000/scene.json").write_bytes(b"")
    # What a version before the ledgers left, which is not read.
    (tmp_path / "out" / "generating" / "000.json").write_text("{}")
    assert generate(WirePlan(ANY), tmp_path / "out")
    assert made == ["000", "001", "000", "001", "002"]
    assert generate(WirePlan(ANY), tmp_path / "undisturbed")
    assert contents(tmp_path / "out") == contents(tmp_path / "undisturbed")


@pytest.mark.slow
def test_what_is_damaged_after_it_was_written_is_not_blessed(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def damage(_: float) -> None:
        (out / "truth/000/scene.json").write_bytes(b"{}")

    assert generate(WirePlan(ANY), out, progress=damage)
    assert validate(out) == [f"{out}/truth/000/scene.json: truncated, 2 bytes; dataset.json says {size(out)}"]
    assert generate(WirePlan(ANY), tmp_path / "undisturbed")
    name = "dataset.json"
    assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()


def size(out: Path) -> int:
    """What the manifest says of the scene of the first trial."""
    bytes_: int = open_as(ViewpointDataset, out).manifest.files["truth/000/scene.json"].bytes
    return bytes_


@pytest.mark.slow
def test_killed_and_started_again_as_a_user_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "task: viewpoint\nname: few\ntrials: 25\nsamples: 200\nlevel: custom\nshare: [0, 1]\n"
    (tmp_path / "preset.yaml").write_text(text)
    out = tmp_path / "out"
    kill_before("scene.json", 4, "generate", tmp_path / "preset.yaml", "--out", out, "--jobs", 1)
    assert len(list(out.rglob("scene.json"))) == 3
    assert not (out / "dataset.json").exists()
    with pytest.raises(DatasetError, match="not complete; run the same"):
        open_as(ViewpointDataset, out)
    surgbench("generate", tmp_path / "preset.yaml", "--out", out, "--jobs", 1)
    assert "of its files are there already" in capsys.readouterr().err
    surgbench("validate", out)
    assert "sound; 'few', 25 trials, 5000 samples, 75 files, hash " in capsys.readouterr().out


def test_a_workers_trial_is_called_off(tmp_path: Path) -> None:
    class Stop:
        value = True

    worker = module._Worker(ANY, tmp_path, Stop())
    assert worker.write("000") == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_disk_estimate_covers_what_is_written(tmp_path: Path) -> None:
    plan = WirePlan(ANY.model_copy(update={"samples": 3000, "trials": 1}))
    generate(plan, tmp_path / "out")
    written = sum(-(-len(data) // 4096) * 4096 for data in contents(tmp_path / "out").values())
    assert written < plan.disk_bytes < 6 * written
