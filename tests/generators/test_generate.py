from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import AMPLE_S, kill_before, stopped, surgbench, wait_until

from surgbench.camera import Camera
from surgbench.config import locate, packaged_names, read_yaml
from surgbench.contract import Mask
from surgbench.dataset import writer
from surgbench.dataset.open import open_as
from surgbench.dataset.storage import check_new
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError, DatasetError, NotFoundError, SurgbenchError
from surgbench.files import write_atomic
from surgbench.generators import resumable
from surgbench.generators.corruption import corrupt
from surgbench.generators.frames import FrameWriter
from surgbench.generators.generate import Part, Plan, generate, plan_dataset
from surgbench.generators.observations import observe_joints, observe_keypoints
from surgbench.generators.presets import (
    CORRUPTION_LEVELS,
    Keypoints,
    Preset,
    Readings,
    load_preset,
)
from surgbench.generators.render import MaskRenderer, visible_box
from surgbench.generators.sequence import make_tables
from surgbench.generators.trajectories import make_pair
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.locks import sole_writer
from surgbench.processes.pool import ProcessPool
from surgbench.randomness import generator
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import JOINTS, POSITION
from surgbench.tasks.instrument.dataset import InstrumentDataset

SMALL = Camera(width=175, height=123, fx=226.5, fy=224.0, cx=73.2, cy=59.3)
FEW = Preset(name="few", pairs=2, frames=3, camera=SMALL)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset made without disturbance."""
    out = tmp_path_factory.mktemp("made") / "few"
    assert generate(plan_dataset(FEW), out)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def states_around_the_camera(count: int) -> FloatArray:
    """Most with the shaft crossing the camera's plane, some partly or wholly behind it or outside the image."""
    rng = generator(test="around")
    states = np.empty((count, 9))
    states[:, :3] = rng.uniform([-1.5, -3.1, -3.1], [1.5, 3.1, 3.1], (count, 3))
    states[:, POSITION] = rng.uniform([-0.04, -0.03, -0.02], [0.04, 0.03, 0.15], (count, 3))
    states[:, JOINTS] = rng.uniform([-1.4, -1.4, 0.0], [1.4, 1.4, 0.7], (count, 3))
    return states


# Rendering


def brute_force(instrument: Instrument, state: FloatArray, camera: Camera) -> np.ndarray:
    """Which pixel centres' rays meet a triangle in front of the camera, in float64."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], axis=-1)
    rays = rays.reshape(-1, 3)
    hit = np.zeros(len(rays), dtype=bool)
    transforms = instrument.link_transforms(state)
    for name, mesh in instrument.meshes.items():
        transform = transforms[instrument.link_index[name]]
        vertices = mesh.vertices_m @ transform[:3, :3].T + transform[:3, 3]
        for corners in vertices[mesh.faces]:
            sides = np.stack([np.cross(corners[i], corners[(i + 1) % 3]) @ rays.T for i in range(3)])
            inside = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
            if not inside.any():
                continue
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = (normal @ corners[0]) / (rays @ normal)
            hit |= inside & (depth > 0.001)
    return hit.reshape(rows.shape)


@pytest.mark.slow
def test_rendered_masks_are_those_of_a_pixel_centre_rasteriser(instrument: Instrument) -> None:
    camera = Camera(width=88, height=62, fx=113.2, fy=109.1, cx=36.3, cy=29.4)
    renderer = MaskRenderer([instrument], camera)
    seen = 0
    for state in [*states_around_the_camera(6), np.array([-0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])]:
        expected = brute_force(instrument, state, camera)
        assert np.count_nonzero(renderer.mask(state) != expected) <= 1
        seen += bool(expected.any())
    assert seen >= 3


@pytest.mark.slow
def test_rendered_masks_are_those_of_the_evaluator(instrument: Instrument, camera: Camera) -> None:
    renderer, evaluator = MaskRenderer([instrument], camera), SilhouetteEvaluator([instrument], camera)
    pair = make_pair(load_preset("paper-wide"), instrument, "fast", 200, generator(test=0))
    states = [*pair[::40].reshape(-1, 9), *states_around_the_camera(80)]
    crossing = visible = 0
    for state in states:
        expected = evaluator.mask(state)
        area = np.count_nonzero(expected)
        assert np.count_nonzero(renderer.mask(state) != expected) <= max(1, 0.001 * area)
        vertices = instrument.meshes["shaft"].vertices_m @ instrument.link_transforms(state)[0, 2, :3]
        vertices += state[5]
        crossing += bool(area and vertices.min() < 0 < vertices.max())
        visible += bool(area)
    assert crossing >= 20
    assert visible < len(states)


@pytest.mark.slow
def test_union_of_the_arms_is_what_mitsuba_renders_of_both(instrument: Instrument, camera: Camera) -> None:
    both, one = MaskRenderer([instrument, instrument], camera), MaskRenderer([instrument], camera)
    for states in make_pair(load_preset("paper-wide"), instrument, "nominal", 100, generator(test=1))[::25]:
        union = one.mask(states[0]) | one.mask(states[1])
        # The film's crop moves rays by a rounding error: ties at edges may fall either way.
        assert np.count_nonzero(both.mask(states) != union) <= 2
        assert union.sum() > 5000


def test_the_box_that_is_rendered_holds_all_that_is_covered() -> None:
    camera = Camera(width=20, height=14, fx=22.0, fy=21.0, cx=8.7, cy=7.2)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], axis=-1)
    rng = generator(test="box")
    face = np.array([[0, 1, 2]], np.int32)
    covering = corners = 0
    for _ in range(200):
        # Many cross the camera's plane, some cover corners of the image, or all of it.
        vertices = rng.normal(size=(3, 3)) * [0.1, 0.1, 0.15] + [0.0, 0.0, 0.1]
        low, high = visible_box(vertices, face, face[0, [[0, 1], [1, 2], [0, 2]]], camera)
        sides = np.stack([rays @ np.cross(vertices[i], vertices[(i + 1) % 3]) for i in range(3)])
        inside = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
        normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
        hit = inside & ((normal @ vertices[0]) / (rays @ normal) > 0.001)
        if hit.any():
            assert (low <= [columns[hit].min(), rows[hit].min()]).all()
            assert (high >= [columns[hit].max(), rows[hit].max()]).all()
            covering += 1
            corners += bool(hit[[0, 0, -1, -1], [0, -1, 0, -1]].any())
    assert covering > 60
    assert corners > 30


def test_a_renderer_does_not_remember(instrument: Instrument) -> None:
    renderer = MaskRenderer([instrument], SMALL)
    states = make_pair(FEW, instrument, "nominal", 40, generator(test=2))[::13, 0]
    first = [renderer.mask(state) for state in states]
    again = [renderer.mask(state) for state in states[::-1]][::-1]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], first[-1])


# Corruption, keypoints, readings


@pytest.fixture(scope="module")
def clean(instrument: Instrument, camera: Camera) -> Mask:
    mask: Mask = MaskRenderer([instrument], camera).mask(np.array([-0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3]))
    return mask


def mask_error(clean: Mask, corrupted: Mask) -> float:
    return 1.0 - float((clean & corrupted).sum() / (clean | corrupted).sum())


@pytest.mark.slow
def test_corruption_levels(clean: Mask) -> None:
    errors = {
        level: [mask_error(clean, corrupt(clean, settings, generator(test=index))) for index in range(150)]
        for level, settings in CORRUPTION_LEVELS.items()
    }
    assert max(errors["none"]) == 0
    # P(no 3x3 morphology) P(no blobs of any size) = 0.957 * 0.684, and a few Poisson draws of 0 or discs all rejected.
    assert np.mean(np.array(errors["published"]) == 0) == pytest.approx(0.66, abs=0.08)
    assert 0.001 < np.mean(errors["published"]) < 0.02
    assert 0.03 < np.mean(errors["strong"]) < 0.12


def test_published_blobs_only_add_and_strong_ones_also_cut(clean: Mask) -> None:
    def changes(level: str) -> tuple[int, int]:
        settings = CORRUPTION_LEVELS[level].model_copy(update={"morphology": ()})
        masks = [corrupt(clean, settings, generator(test=index)) for index in range(60)]
        return sum(int((~clean & mask).sum()) for mask in masks), sum(int((clean & ~mask).sum()) for mask in masks)

    added, removed = changes("published")
    assert added > 0
    assert removed == 0
    added, removed = changes("strong")
    assert 0.5 < added / removed < 2


def test_corruption_leaves_the_clean_mask_alone_and_survives_an_empty_one(clean: Mask) -> None:
    before = clean.copy()
    for index in range(20):
        corrupt(clean, CORRUPTION_LEVELS["strong"], generator(test=index))
        assert not corrupt(np.zeros_like(clean), CORRUPTION_LEVELS["strong"], generator(test=index)).any()
    assert np.array_equal(clean, before)


def test_keypoints_are_noisy_unordered_and_drop_out(instrument: Instrument, camera: Camera) -> None:
    state = np.array([-0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])
    tips = camera.project(instrument.tips_cam(state))
    states = np.tile(state, (2000, 1))
    settings = Keypoints(noise_px=2.0, dropout=0.1)
    seen = observe_keypoints(states, instrument, camera, settings, generator(test="keypoints"))
    lost = np.isnan(seen)
    assert (lost.any(axis=2) == lost.all(axis=2)).all()
    assert lost.all(axis=2).mean() == pytest.approx(0.1, abs=0.02)
    pairs = seen[~lost.any(axis=(1, 2))]
    swapped = np.linalg.norm(pairs[:, 0] - tips[1], axis=1) < np.linalg.norm(pairs[:, 0] - tips[0], axis=1)
    assert swapped.mean() == pytest.approx(0.5, abs=0.05)
    pairs[swapped] = pairs[swapped][:, ::-1]
    assert (pairs - tips).std() == pytest.approx(2.0, abs=0.1)
    states[:, 3] = 0.2  # out of the image
    assert np.isnan(observe_keypoints(states, instrument, camera, settings, generator(test=0))).all()


def test_readings_have_bias_drift_and_noise() -> None:
    states = np.zeros((1000, 9))
    settings = Readings(bias_rad=0.02, drift_rad=0.01, noise_rad=0.002)
    readings = np.stack([observe_joints(states, settings, 1 / 30, generator(test=index)) for index in range(100)])
    assert readings.shape == (100, 1000, 3)
    assert readings.std() == pytest.approx(np.sqrt(0.02**2 + 0.01**2 + 0.002**2), rel=0.15)
    assert np.diff(readings, axis=1).std() == pytest.approx(np.sqrt(2 * 0.002**2 + 2 * 0.005 * 0.01**2), rel=0.1)
    assert readings.min() < 0  # raw: not clipped to the jaw's limit


# Presets


def test_every_preset_loads() -> None:
    views = ["auxiliary-view", "auxiliary-view-exact", "auxiliary-view-uncalibrated"]
    chasers = ["wire-chaser", "wire-chaser-easy", "wire-chaser-hard", "wire-chaser-mini"]
    assert packaged_names("presets") == [
        "agile",
        *views,
        "endoscope",
        "in-and-out",
        "markers",
        "mini",
        "mismatch",
        "occlusion",
        "occlusion-long",
        "occlusion-rcm",
        "paper",
        "paper-dual",
        "paper-rcm",
        "paper-wide",
        *chasers,
    ]
    mini, paper = load_preset("mini"), load_preset("paper")
    assert (mini.pairs, mini.frames) == (1, 60)
    assert (paper.pairs, paper.frames) == (16, 1000)
    wide = load_preset("paper-wide")
    assert [entry.speed for entry in plan_dataset(wide).sequences] == ["nominal"] * 8 + ["fast"] * 8
    # Stretched over twice as many frames, waypoints of fast recordings make no fast motion.
    assert {entry.speed for entry in plan_dataset(paper).sequences} == {"nominal"}
    assert [paper.half(index) for index in range(16)] == ["nominal"] * 8 + ["fast"] * 8
    assert [entry.speed for entry in plan_dataset(mini).sequences] == ["nominal"]
    for name in ("agile", "in-and-out"):
        preset = load_preset(name)
        assert (preset.pairs, preset.frames) == (4, 500)
    for name, frames in (("paper-rcm", 500), ("mismatch", 300)):
        preset = load_preset(name)
        assert (preset.pairs, preset.frames, preset.motion.kind) == (4, frames, "rcm")


def test_paper_wide_yaml_spells_out_the_defaults() -> None:
    assert load_preset("paper-wide") == Preset(name="paper-wide", pairs=16, frames=1000)
    written = read_yaml(locate("presets", "preset", "paper-wide"), "preset")

    def missing(model: dict[str, Any], text: dict[str, Any]) -> list[str]:
        nested = [missing(value, text[key]) for key, value in model.items() if isinstance(text.get(key), dict)]
        return [*(key for key in model if key not in text), *(key for keys in nested for key in keys)]

    # The camera has none, and may not.
    assert missing(load_preset("paper-wide").model_dump(), written) == ["distortion"]


def test_options_override_the_preset() -> None:
    preset = load_preset("mini", pairs=3, frames=7, seed=5, corruption="strong")
    assert (preset.pairs, preset.frames, preset.seed) == (3, 7, 5)
    assert preset.corruption == CORRUPTION_LEVELS["strong"]


HEAD = "name: x\npairs: 1\nframes: 3\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\npairz: 1\nframes: 3\n", "unknown key 'pairz'; did you mean 'pairs'?"),
        (HEAD + "motion: {ou_roh: 0.9}\n", "unknown key 'motion.ou_roh'; did you mean 'ou_rho'?"),
        (HEAD + "motion: {kind: rmc}\n", "'motion.kind': input should be 'free' or 'rcm', not 'rmc'"),
        (HEAD + "mismatch: {distortion: [0.1]}\n", "distortion must have 4 or 5 coefficients, k1, k2, p1, p2 and k3"),
        (HEAD + "camera: {widht: 3}\n", "unknown key 'camera.widht'; did you mean 'width'?"),
        (HEAD + "corruption: {blobs: [{radius: 3}]}\n", "unknown key 'corruption.blobs.0.radius'; did you mean"),
        ("name: x\nframes: 3\n", "key 'pairs' is missing"),
        ("name: x\npairs: many\nframes: 3\n", "'pairs': input should be a valid integer"),
        (HEAD + "seed: -1\n", "'seed': input should be greater than or equal to 0, not -1"),
        (HEAD + "corruption: strnog\n", "unknown corruption level 'strnog'; did you mean 'strong'?"),
        (HEAD + "workspace: {reach: [0.6, 0.2]}\n", "'workspace': reach must be [lower, upper] with lower < upper"),
        (HEAD + "motion: {lowpass_cutoff_hz: 15}\n", "motion.lowpass_cutoff_hz must be below half the frame rate, 15"),
        (HEAD + "dt_s: .nan\n", "'dt_s': "),
        ("[1, 2]\n", "a preset file must be a mapping of keys"),
        ("name: [x\n", "not valid YAML"),
    ],
)
def test_a_wrong_preset_file_is_one_line_that_names_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_preset(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert message in line
    assert "\n" not in line


def test_an_instrument_file_is_found_beside_the_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plans = []
    for name in ("a", "b"):
        folder = tmp_path / name
        save_instrument(load_instrument("large_needle_driver"), folder / "own")
        (folder / "preset.yaml").write_text(HEAD + "instrument: own/instrument.yaml\n")
        plans.append(plan_dataset(load_preset(f"{name}/preset.yaml", seed=3)))
    assert plans[0].instrument.name == "large_needle_driver"
    # Wherever it lies, it is the same dataset.
    assert plans[0].marker == plans[1].marker
    (tmp_path / "a" / "own" / "instrument.yaml").unlink()
    with pytest.raises(ConfigError, match=r"a/own/instrument\.yaml: instrument file cannot be read"):
        plan_dataset(load_preset("a/preset.yaml"))


def test_unknown_and_missing_presets() -> None:
    with pytest.raises(NotFoundError, match="unknown preset 'mni'; did you mean 'mini'"):
        load_preset("mni")
    with pytest.raises(ConfigError, match=r"none\.yaml: preset file cannot be read"):
        load_preset("none.yaml")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pairs": 0}, "--sequences: input should be greater than or equal to 1, not 0"),
        ({"frames": 1}, "--frames: input should be greater than or equal to 2, not 1"),
        ({"seed": -1}, "--seed: input should be"),
        ({"corruption": "storng"}, "--corruption: unknown corruption level 'storng'; did you mean 'strong'?"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_preset("mini", **options)
    assert str(caught.value).startswith(message)


# The whole job


def test_a_generated_dataset_is_sound_and_complete(made: Path, instrument: Instrument) -> None:
    assert validate(made) == []
    dataset = open_as(InstrumentDataset, made)
    assert [sequence.speed for sequence in dataset.sequences] == ["nominal", "fast"]
    sequence = dataset.sequences[1]
    evaluator = SilhouetteEvaluator([dataset.instrument("large_needle_driver")], SMALL)
    for arm in sequence.arms:
        states, readings = sequence.states(arm), sequence.readings(arm)
        assert states is not None
        assert readings is not None
        assert np.abs(readings - states[:, JOINTS]).max() < 0.15
        assert np.abs(readings - states[:, JOINTS]).min() > 0
        tips = SMALL.project(instrument.tips_cam(states))
        assert np.abs(np.nanmean(sequence.keypoints(arm), axis=1) - tips.mean(axis=1)).max() < 20
        for frame in range(sequence.frames):
            clean = sequence.clean_mask(arm, frame)
            assert np.count_nonzero(clean != evaluator.mask(states[frame])) <= 1
            assert mask_error(clean, sequence.mask(arm, frame)) < 0.7
    assert np.array_equal(
        sequence.clean_mask("both", 2), sequence.clean_mask("left", 2) | sequence.clean_mask("right", 2)
    )
    assert dataset.manifest.seed == 0
    assert dataset.manifest.configuration["preset"] == FEW.model_dump(mode="json")


def fingerprint(columns: dict[str, FloatArray]) -> str:
    """Of numbers to 1e-7, so that it is the same on all processors."""
    digest = hashlib.sha256()
    for name, values in sorted(columns.items()):
        counts = np.where(np.isnan(values), 2**31 - 1, np.rint(np.nan_to_num(values) * 1e7))
        digest.update(name.encode() + counts.astype("<i8").tobytes())
    return digest.hexdigest()


def test_free_motion_keeps_the_numbers_it_had_before_there_were_kinematics(made: Path) -> None:
    plan = plan_dataset(load_preset("mini"))
    numbers = make_tables(plan.preset, plan.sequences[0], plan.real_instrument, plan.real_camera)
    assert fingerprint(numbers.truth) == "39df2d4dd57b1e461cd2c077f529bc385d433094f1ea554c1c0dd812512747cb"
    before = {name: values for name, values in numbers.observed.items() if "_base_" not in name}
    assert fingerprint(before) == "4977f366890ee8f65dfcf7fd673f7d348c592a613303f99216236c3e1bdcae13"
    areas = [
        [int(mask(kind, 2).sum()) for mask in (sequence.clean_mask, sequence.mask) for kind in sequence.entry.kinds]
        for sequence in open_as(InstrumentDataset, made).sequences
    ]
    # Ties at edges may fall either way on another processor.
    np.testing.assert_allclose(areas, [[1812, 575, 2387, 1812, 575, 2387], [1082, 693, 1775, 1082, 524, 1775]], atol=3)


@pytest.mark.slow
def test_same_bytes_again_and_other_bytes_for_another_seed(made: Path, tmp_path: Path) -> None:
    generate(plan_dataset(FEW), tmp_path / "again")
    assert contents(tmp_path / "again") == contents(made)
    generate(plan_dataset(FEW.model_copy(update={"seed": 1})), tmp_path / "other")
    other = contents(tmp_path / "other")
    same = [path for path, data in contents(made).items() if path.startswith("truth/") and data == other[path]]
    assert same == []


@pytest.mark.slow
def test_two_jobs_write_what_one_writes(tmp_path: Path) -> None:
    preset = FEW.model_copy(update={"pairs": 1, "frames": 22, "camera": SMALL})
    done: list[float] = []
    generate(plan_dataset(preset), tmp_path / "one")
    generate(plan_dataset(preset), tmp_path / "two", workers=ProcessPool(2), progress=done.append)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert sum(done) == 22


@pytest.mark.slow
def test_killed_and_started_again_gives_the_same_bytes(tmp_path: Path) -> None:
    text = f"name: few\npairs: 1\nframes: 30\ncamera: {SMALL.model_dump_json(exclude={'distortion'})}\n"
    (tmp_path / "preset.yaml").write_text(text)
    killed = tmp_path / "killed"
    kill_before("*.png", 21, "generate", tmp_path / "preset.yaml", "--out", killed, "--jobs", 1)
    assert len(list(killed.rglob("*.png"))) == 20
    assert not (killed / "dataset.json").exists()
    with pytest.raises(DatasetError, match="not complete; run the same"):
        open_as(InstrumentDataset, killed)
    # What a kill in the middle of a write, and a power cut, leave behind.
    stray = killed / "truth/000/masks/left/000001.png.1.partial"
    stray.write_bytes(b"half")
    empty = killed / "sequences/000/observed/left/000000.png"
    empty.write_bytes(b"")

    plan = plan_dataset(load_preset(tmp_path / "preset.yaml"))
    said: list[str] = []
    assert generate(plan, killed, say=said.append)
    assert "are there already" in said[0]
    assert generate(plan, tmp_path / "undisturbed")
    assert contents(killed) == contents(tmp_path / "undisturbed")
    assert validate(killed) == []


def interrupted(command: list[str], out: Path, masks: int) -> tuple[int, str]:
    """Ctrl-C once a command has written so many masks: its exit code, and what it says."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait_until(lambda: len(list(out.rglob("*.png"))) >= masks or process.poll() is not None)
    os.killpg(process.pid, signal.SIGINT)
    # Ends only when no process holds the pipe any more, a worker left behind neither.
    _, said = process.communicate(timeout=AMPLE_S)
    return process.returncode, said


@pytest.mark.slow
@pytest.mark.long
def test_ctrl_c_with_workers_leaves_no_wrong_mask(tmp_path: Path) -> None:
    (tmp_path / "preset.yaml").write_text("name: few\npairs: 1\nframes: 32\n")
    plan = plan_dataset(load_preset(tmp_path / "preset.yaml"))
    out = tmp_path / "interrupted"
    command = stopped("wait", "dataset.json", 1, "generate", tmp_path / "preset.yaml", "--out", out, "--jobs", 2)
    masks = sum(path.endswith(".png") for path in plan.paths)
    for _ in range(3):
        before = len(list(out.rglob("*.png")))
        if before == masks:  # this machine does not come to it any sooner
            break
        code, said = interrupted(command, out, min(before + 9, masks))
        assert code == 130
        assert "Traceback" not in said
        assert not (out / "dataset.json").exists()
    assert generate(plan, out)
    assert generate(plan, tmp_path / "undisturbed")
    assert contents(out) == contents(tmp_path / "undisturbed")


@pytest.mark.slow
def test_where_ctrl_c_is_ignored_one_job_renders_in_a_worker(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FrameWriter, "render", None)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert generate(plan_dataset(FEW), tmp_path / "out")
    finally:
        signal.signal(signal.SIGINT, before)
    assert contents(tmp_path / "out") == contents(made)


@pytest.mark.slow
def test_a_crash_after_some_frames_is_resumed_without_rendering_them_again(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered: list[str] = []

    def failing(path: Path, data: bytes) -> None:
        rendered.append(path.name)
        if len([name for name in rendered if name.endswith(".png")]) > 15:
            raise RuntimeError("crash")
        write_atomic(path, data)

    monkeypatch.setattr(writer, "write_atomic", failing)
    with pytest.raises(RuntimeError, match="crash"):
        generate(plan_dataset(FEW), tmp_path / "out")
    rendered.clear()

    def counting(path: Path, data: bytes) -> None:
        rendered.append(path.name)
        write_atomic(path, data)

    monkeypatch.setattr(writer, "write_atomic", counting)
    assert generate(plan_dataset(FEW), tmp_path / "out")
    # 36 masks, of which two whole frames of six were there.
    assert len([name for name in rendered if name.endswith(".png")]) == 24
    assert contents(tmp_path / "out") == contents(made)


def interrupt(plan: Plan, out: Path, after: int) -> None:
    """Make a dataset in this process, but for what comes after so many frames."""

    def stop(_: float) -> None:
        nonlocal after
        after -= 1
        if not after:
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        generate(plan, out, progress=stop)


def masks_made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by the frame with every frame rendered."""
    made: list[int] = []
    render = FrameWriter._frame

    def counting(self: Any, sequence: str, frame: int, states: FloatArray) -> dict[str, bytes]:
        made.append(frame)
        files: dict[str, bytes] = render(self, sequence, frame, states)
        return files

    monkeypatch.setattr(FrameWriter, "_frame", counting)
    return made


@pytest.mark.slow
def test_what_was_damaged_between_two_goes_is_made_again(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, plan = tmp_path / "out", plan_dataset(FEW)
    interrupt(plan, out, after=5)
    # Whole pictures, but not those that were written; and a table of another length.
    shutil.copy(out / "truth/000/masks/left/000000.png", out / "truth/000/masks/right/000000.png")
    (out / "truth/001/masks/both/000001.png").unlink()
    (out / "truth/000/states.parquet").write_bytes(b"")
    rendered = masks_made(monkeypatch)
    assert generate(plan, out)
    assert rendered == [0, 1, 2]
    assert contents(out) == contents(made)


@pytest.mark.slow
def test_a_ledger_that_was_torn_costs_the_frame_that_it_lost(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, plan = tmp_path / "out", plan_dataset(FEW)
    interrupt(plan, out, after=5)
    ledger = out / "generating" / "000-000000.jsonl"
    ledger.write_bytes(ledger.read_bytes()[:-40])
    rendered = masks_made(monkeypatch)
    interrupt(plan, out, after=4)
    assert rendered == [2]
    # What was noted after the torn line counts.
    assert generate(plan, out)
    assert rendered == [2, 2]
    assert contents(out) == contents(made)


@pytest.mark.slow
def test_what_no_ledger_names_is_made_again(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a folder that an earlier version has begun."""
    out, plan = tmp_path / "out", plan_dataset(FEW)
    interrupt(plan, out, after=5)
    shutil.rmtree(out / "generating")
    rendered = masks_made(monkeypatch)
    assert generate(plan, out)
    assert rendered == [0, 1, 2] * 2
    assert contents(out) == contents(made)


def test_what_is_damaged_after_it_was_written_is_not_blessed(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    files = [out / "truth/000/masks/left/000000.png", out / "instruments/large_needle_driver/instrument.yaml"]
    files.append(out / "sequences/000/observations.parquet")

    def damage(_: float) -> None:
        for file in files:
            file.write_bytes(file.read_bytes()[:-1] + b"?")

    assert generate(plan_dataset(FEW), out, progress=damage)
    # The manifest says what was meant.
    assert (out / "dataset.json").read_bytes() == (made / "dataset.json").read_bytes()
    assert validate(out) == [f"{file}: altered, its SHA-256 is not the one in dataset.json" for file in sorted(files)]


@pytest.mark.slow
def test_a_ledger_that_is_taken_away_meanwhile_is_one_line(tmp_path: Path) -> None:
    out, plan = tmp_path / "out", plan_dataset(FEW)

    def remove(_: float) -> None:
        shutil.rmtree(out / "generating", ignore_errors=True)

    with pytest.raises(DatasetError, match=r"^[^\n]*: not in the ledgers in [^\n]*; run the same command again[^\n]*$"):
        generate(plan, out, progress=remove)
    assert generate(plan, out)


def test_complete_already(made: Path, tmp_path: Path) -> None:
    before = contents(made)
    assert generate(plan_dataset(FEW), made) is False
    # Killed between the manifest and the marker's removal.
    (made / "generating.json").write_text("{}")
    assert generate(plan_dataset(FEW), made) is False
    assert contents(made) == before


@pytest.mark.parametrize("cut", [False, True])
def test_a_finished_dataset_that_lost_a_file_is_not_complete(made: Path, tmp_path: Path, cut: bool) -> None:
    out = tmp_path / "out"
    shutil.copytree(made, out)
    lost = out / "sequences/001/observed/left/000001.png"
    if cut:
        lost.write_bytes(lost.read_bytes()[:-1])
    else:
        lost.unlink()
    message = refused(FEW, out)
    assert message.startswith(f"{lost}: ")
    assert message.endswith(f"see 'surgbench validate {out}', or choose another --out")


def test_one_pair_is_said_in_the_singular(tmp_path: Path) -> None:
    said = resumable._check_disk(plan_dataset(FEW.model_copy(update={"pairs": 1})), tmp_path, 0.0)
    assert said.startswith("few: 1 pair of trajectories, 3 frames, ")


def refused(plan: Preset, out: Path) -> str:
    before = contents(out) if out.is_dir() else None
    with pytest.raises(SurgbenchError) as caught:
        generate(plan_dataset(plan), out)
    assert (contents(out) if out.is_dir() else None) == before
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_folder_that_holds_something_else_is_left_alone(made: Path, tmp_path: Path) -> None:
    other = FEW.model_copy(update={"seed": 9})
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    assert refused(FEW, tmp_path / "photos").endswith(
        "holds something else ('cat.jpg'); --out needs a new or empty folder"
    )
    assert "is a file" in refused(FEW, tmp_path / "photos" / "cat.jpg")
    assert "holds another dataset ('few', other settings)" in refused(other, made)
    part = tmp_path / "part"
    shutil.copytree(made, part)
    (part / "dataset.json").unlink()
    plan = plan_dataset(FEW)
    (part / "generating.json").write_text(json.dumps(plan.marker))
    assert "an unfinished dataset with other settings" in refused(other, part)
    (part / "truth" / "notes.txt").write_text("mine")
    assert "notes.txt: does not belong to this dataset" in refused(FEW, part)


def test_two_generations_do_not_share_a_folder(tmp_path: Path) -> None:
    refusal = pytest.raises(DatasetError, match="another 'surgbench generate' is at work here")
    with sole_writer(tmp_path, "generate"), refusal:
        generate(plan_dataset(FEW), tmp_path)


def test_a_disk_that_lacks_room_is_refused_before_anything_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(resumable.shutil, "disk_usage", lambda path: usage(10**9, 10**9 - 1000, 1000))
    said: list[str] = []
    out = tmp_path / "deep" / "out"
    plan = plan_dataset(load_preset("paper"))
    with pytest.raises(SurgbenchError, match=r"^[^\n]*the disk has 0 MB free but \d+ MB are needed[^\n]*$"):
        generate(plan, out, say=said.append)
    assert not said
    assert not (tmp_path / "deep").exists()


def test_nothing_is_planned_aloud_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_only(path: Path, data: bytes) -> None:
        raise OSError(30, "Read-only file system", str(path))

    said: list[str] = []
    monkeypatch.setattr(resumable, "write_atomic", read_only)
    with pytest.raises(SurgbenchError, match=r"generating\.json: cannot be written \(Read-only file system\)$"):
        generate(plan_dataset(FEW), tmp_path, say=said.append)
    assert not said


def test_the_disk_estimate_covers_what_is_written(made: Path) -> None:
    blocks = sum(-(-path.stat().st_size // 4096) * 4096 for path in made.rglob("*") if path.is_file())
    meshes = sum(path.stat().st_size for path in (made / "instruments").rglob("*") if path.is_file())
    tables = 4 * 8192  # a Parquet file of three rows is all header
    assert blocks <= plan_dataset(FEW).disk_bytes + 2 * meshes + tables


@pytest.mark.slow
def test_a_full_disk_in_the_middle_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 0

    def full(path: Path, data: bytes) -> None:
        nonlocal count
        count += 1
        if count > 15:
            raise OSError(28, "No space left on device", str(path))
        write_atomic(path, data)

    said: list[str] = []
    monkeypatch.setattr(writer, "write_atomic", full)
    with pytest.raises(
        SurgbenchError, match=r"^[^\n]*out: the disk is full; make room, then run the same command again"
    ):
        generate(plan_dataset(FEW), tmp_path / "out", say=said.append)
    assert "pairs of trajectories, " in said[0]


def test_an_impossible_preset_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.generators.trajectories.PATHS", 1)
    workspace = FEW.workspace.model_copy(update={"clearance_m": 0.5})
    with pytest.raises(ConfigError, match="no feasible nominal trajectory"):
        generate(plan_dataset(FEW.model_copy(update={"workspace": workspace})), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unknown_instrument_is_named() -> None:
    with pytest.raises(NotFoundError, match="unknown instrument 'large_nedle_driver'; did you mean"):
        plan_dataset(FEW.model_copy(update={"instrument": "large_nedle_driver"}))


@pytest.mark.slow
def test_a_part_has_the_same_files_as_the_whole(made: Path, tmp_path: Path) -> None:
    generate(plan_dataset(FEW, Part(("001",), 2)), tmp_path / "part")
    whole, part = contents(made), contents(tmp_path / "part")
    pictures = [name for name in part if name.endswith(".png")]
    assert len(pictures) == 2 * 2 * 3
    assert all(part[name] == whole[name] for name in pictures)
    first, all_of_it = (open_as(InstrumentDataset, folder).sequence("001") for folder in (tmp_path / "part", made))
    assert first.entry == all_of_it.entry.model_copy(update={"frames": 2})
    for arm in first.arms:
        for table in ("states", "readings", "keypoints"):
            np.testing.assert_array_equal(getattr(first, table)(arm), getattr(all_of_it, table)(arm)[:2])


def test_a_part_of_something_else_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown sequence '002'; did you mean '00"):
        plan_dataset(FEW, Part(("002",), 2))


@pytest.mark.slow
def test_dry_run_tells_time_and_disk_and_makes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("generate", "mini", "--out", tmp_path / "mini", "--jobs", 2, "--dry-run")
    assert list(tmp_path.iterdir()) == []
    said = capsys.readouterr().err
    assert re.fullmatch(r"mini: 1 pair of trajectories, 60 frames, about 2 MB and \d+ s with --jobs 2\n", said)


@pytest.mark.slow
def test_what_keeps_a_worker_from_beginning_is_told(tmp_path: Path) -> None:
    """As where Mitsuba lacks a system library: nothing was killed, and memory is not to blame."""
    (tmp_path / "something").touch()
    with pytest.raises(DatasetError, match="holds something already"):
        ProcessPool(2).do([1, 2], abs, check_new, (tmp_path,), lambda done: None)
