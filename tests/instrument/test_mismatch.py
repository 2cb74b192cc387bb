"""What is rendered differs from what is declared, as the preset says and no more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support import resting_state

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.lens import Lens
from surgbench.generators.mismatch import NO_MISMATCH, real_camera, real_instrument
from surgbench.generators.presets import Preset, load_preset
from surgbench.generators.sections import Mismatch
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.tasks.instrument.dataset import InstrumentDataset

SMALL = Camera(width=175, height=123, fx=226.5, fy=224.0, cx=73.2, cy=59.3)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


def test_no_mismatch_is_the_very_same(instrument: Instrument) -> None:
    assert real_instrument(instrument, NO_MISMATCH) is instrument
    assert real_camera(SMALL, NO_MISMATCH) == SMALL
    lens = Lens(SMALL)
    assert lens.pinhole == SMALL
    mask = generator(test=0).random((123, 175)) < 0.5
    assert lens.see(mask) is mask
    assert plan_dataset(load_preset("paper-rcm")).marker.keys() == {"format", "preset", "instrument_sha256"}


@pytest.mark.parametrize("k1", [0.3, -0.3])
def test_a_lens_moves_masks_and_points_alike(k1: float) -> None:
    camera = SMALL.model_copy(update={"distortion": (k1, 0.05, 0.002, -0.001)})
    lens = Lens(camera)
    rng = generator(test="lens")
    # What lies in a half plane of rays, seen by the pinhole camera and then through the lens.
    for _ in range(8):
        normal = rng.normal(size=3) * [1.0, 1.0, 0.3]
        rows, columns = np.mgrid[: lens.pinhole.height, : lens.pinhole.width]
        x = (columns - lens.pinhole.cx) / lens.pinhole.fx
        y = (rows - lens.pinhole.cy) / lens.pinhole.fy
        seen = lens.see(normal[0] * x + normal[1] * y + normal[2] > 0)
        assert seen.shape == (camera.height, camera.width)
        rays = np.column_stack([rng.uniform(-0.5, 0.7, 4000), rng.uniform(-0.4, 0.4, 4000), np.ones(4000)])
        pixels = camera.see(rays)
        inside = camera.contains(pixels)
        # Half a pixel here, half a pixel there, and some magnification.
        sure = np.abs(rays @ normal) > 1.3 * np.linalg.norm(normal[:2]) / camera.fx
        column, row = np.rint(pixels[inside & sure]).astype(int).T
        assert np.array_equal(seen[row, column], (rays @ normal > 0)[inside & sure])
        assert len(row) > 1000
    # All that the lens shows is there, at the corners too.
    assert (lens.pinhole.width > camera.width) == (k1 < 0)


def test_projection_is_opencvs_formula() -> None:
    k1, k2, p1, p2, k3 = 0.1, -0.05, 0.01, 0.02, 0.03
    camera = SMALL.model_copy(update={"distortion": (k1, k2, p1, p2, k3)})
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = [camera.fx * bent_x + camera.cx, camera.fy * bent_y + camera.cy]
    points = np.array([[[0.3, -0.2, 1.0], [0.03, -0.02, 0.1]]])
    np.testing.assert_allclose(camera.see(points)[0], [expected, expected], atol=1e-9)
    np.testing.assert_array_equal(SMALL.see(points), SMALL.project(points))


def test_the_presets_lens_is_off_by_one_or_two_pixels_at_the_corners() -> None:
    preset = load_preset("mismatch")
    camera = real_camera(preset.camera, preset.mismatch)
    straight = camera.model_copy(update={"distortion": ()})
    corners = np.array([[0, 0], [699, 0], [0, 492], [699, 492]])
    rays = np.column_stack([(corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(4)])
    moved_px = np.linalg.norm(camera.see(rays) - straight.project(rays), axis=1)
    assert ((moved_px > 1) & (moved_px < 2.5)).all()


def test_the_real_instrument_is_as_told(instrument: Instrument) -> None:
    mismatch = Mismatch(body_scale=1.02, shaft_radius_scale=1.05, jaw_extra_m=0.0005)
    real = real_instrument(instrument, mismatch)
    for name, mesh in real.meshes.items():
        before = instrument.meshes[name]
        assert np.array_equal(mesh.faces, before.faces)
        body = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
        assert body.is_watertight
        assert body.volume > trimesh.Trimesh(before.vertices_m, before.faces).volume
    np.testing.assert_allclose(
        real.meshes["shaft"].vertices_m, instrument.meshes["shaft"].vertices_m * [1.05, 1.05, 1.0], atol=1e-8
    )
    # Straight ahead: wrist to yaw axis, and on to the tips.
    straight = np.array([0, 0, 0, 0, 0, 0.1, 0, 0, 0.0])
    yaw = real.link_transforms(straight)[real.link_index["yaw"], 2, 3]
    tips = real.tips_cam(straight)[:, 2]
    np.testing.assert_allclose([yaw, *tips], 0.1 + 1.02 * 0.0091 + np.array([0, 1, 1]) * (1.02 * 0.009 + 0.0005))
    for name in ("jaw_left", "jaw_right"):
        longer = real.meshes[name].vertices_m[:, 1].max() - 1.02 * instrument.meshes[name].vertices_m[:, 1].max()
        assert longer == pytest.approx(0.0005 * 0.0098 / 0.009, rel=1e-3)
        np.testing.assert_allclose(
            real.meshes[name].vertices_m[:, 1].min(), 1.02 * instrument.meshes[name].vertices_m[:, 1].min(), rtol=1e-4
        )
    assert np.array_equal(real.search_limits.upper_rad, instrument.search_limits.upper_rad)
    assert [link.joint for link in real.spec.links] == [link.joint for link in instrument.spec.links]


def test_the_preset_puts_the_mask_off_by_some_percent(instrument: Instrument) -> None:
    preset = load_preset("mismatch")
    camera = real_camera(preset.camera, preset.mismatch)
    real = SilhouetteEvaluator([real_instrument(instrument, preset.mismatch)], Lens(camera).pinhole)
    seen = Lens(camera).see(real.mask(resting_state()))
    declared = SilhouetteEvaluator([instrument], preset.camera).mask(resting_state())
    assert 0.02 < 1 - (seen & declared).sum() / (seen | declared).sum() < 0.2


def test_a_dataset_declares_the_nominal_and_shows_the_real(tmp_path: Path, instrument: Instrument) -> None:
    mismatch = Mismatch(
        body_scale=1.05,
        shaft_radius_scale=1.1,
        jaw_extra_m=0.001,
        focal_scale=(1.05, 0.97),
        centre_offset_px=(4.0, -3.0),
        distortion=(0.2, 0.0, 0.0, 0.0),
        joint_offset_rad=(0.3, -0.2, 0.1),
    )
    quiet = {"corruption": "none", "keypoints": {"noise_px": 0.0, "dropout": 0.0}}
    errors = {"bias_rad": 0.0, "drift_rad": 0.0, "noise_rad": 0.0}
    (tmp_path / "own.yaml").write_text("name: own\npairs: 1\nframes: 4\n")
    own = load_preset(tmp_path / "own.yaml", corruption="none").model_dump(mode="json")
    own |= {"camera": SMALL, "keypoints": quiet["keypoints"], "readings": errors, "mismatch": mismatch}
    plan = plan_dataset(Preset.model_validate(own))
    assert generate(plan, tmp_path / "made")
    assert generate(plan, tmp_path / "made") is False
    assert validate(tmp_path / "made") == []
    dataset = open_as(InstrumentDataset, tmp_path / "made")
    sequence = dataset.sequences[0]
    assert sequence.camera == SMALL
    declared = dataset.instrument("large_needle_driver")
    for name, mesh in instrument.meshes.items():
        assert np.array_equal(declared.meshes[name].vertices_m, mesh.vertices_m)
    assert declared.spec.tips == instrument.spec.tips
    rendered = dataset.manifest.configuration["rendered"]
    camera = Camera.model_validate(rendered["camera"])
    assert camera == real_camera(SMALL, mismatch)
    assert rendered["instrument"]["tips"][0]["point_m"][1] == pytest.approx(1.05 * 0.009 + 0.001)
    hashes = dataset.manifest.configuration["instrument_sha256"]
    assert rendered["instrument_sha256"].keys() == hashes.keys()
    assert all(rendered["instrument_sha256"][path] != hashes[path] for path in hashes)

    lens, real = Lens(camera), real_instrument(instrument, mismatch)
    evaluator = SilhouetteEvaluator([real], lens.pinhole)
    nominal = SilhouetteEvaluator([instrument], SMALL)
    for arm in sequence.arms:
        states, readings = sequence.states(arm), sequence.readings(arm)
        assert states is not None
        assert readings is not None
        np.testing.assert_allclose(readings - states[:, 6:], np.tile(mismatch.joint_offset_rad, (4, 1)), atol=1e-12)
        tips = camera.see(real.tips_cam(states))
        seen = sequence.keypoints(arm)
        np.testing.assert_allclose(np.sort(seen, axis=1), np.sort(tips, axis=1), atol=1e-9)
        for frame in range(4):
            clean = sequence.clean_mask(arm, frame)
            assert np.array_equal(clean, sequence.mask(arm, frame))
            assert np.count_nonzero(clean != lens.see(evaluator.mask(states[frame]))) <= 1
            assert np.count_nonzero(clean != nominal.mask(states[frame])) > 100
