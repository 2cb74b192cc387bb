"""The PyTorch evaluator against the compiled one, and ``--device`` from the command line to the tracker.

Everything runs on torch's CPU device, and again on a GPU where there is one.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support import observe, resting_state, rigid_instrument, scene_of

from surgbench.camera import Camera
from surgbench.cli import main
from surgbench.dataset.open import open_as
from surgbench.errors import ConfigError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.presets import load_preset
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import Reference, RowSums, SilhouetteEvaluator
from surgbench.suite.asked import Conditions, RowRequest
from surgbench.suite.plan import complete, jobs
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.execute import child_setup, unit_data

if TYPE_CHECKING:
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

# Sines, and the points at the near plane, may differ from the compiled engine's in the last bit, so that a crossing
# within rounding of a pixel centre may fall on either side of it.
TOLERANCE_PX = 2


@pytest.fixture(scope="module", params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA GPU on this machine, or a PyTorch without CUDA")
    name: str = request.param
    return name


def evaluators(
    instruments: list[Instrument], camera: Camera, device: str, **options: Any
) -> tuple[SilhouetteEvaluator, TorchSilhouetteEvaluator]:
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

    return SilhouetteEvaluator(instruments, camera), TorchSilhouetteEvaluator(
        instruments, camera, device=device, **options
    )


def batch_tolerance_px(device: str) -> int:
    """None on a CPU; on a GPU the library may multiply matrices in another way for another batch."""
    return 0 if device == "cpu" else TOLERANCE_PX


def checker(camera: Camera) -> np.ndarray:
    pattern: np.ndarray = (np.indices((camera.height, camera.width)).sum(axis=0) // 3) % 2 == 0
    return pattern


def assert_same_counts(
    ours: SilhouetteEvaluator, theirs: TorchSilhouetteEvaluator, states: FloatArray, tolerance_px: int = TOLERANCE_PX
) -> None:
    reference = Reference(checker(ours.camera))
    expected, found = ours.score(states, reference), theirs.score(states, reference)
    assert found.area.dtype == found.overlap.dtype == np.int64
    np.testing.assert_allclose(found.area, expected.area, rtol=0, atol=tolerance_px)
    np.testing.assert_allclose(found.overlap, expected.overlap, rtol=0, atol=tolerance_px)


def scattered(rng: np.random.Generator, count: int, arms: int = 1) -> FloatArray:
    """States near the camera, behind it, across the near plane and outside the image."""
    low = [-np.pi, -np.pi, -np.pi, -0.08, -0.08, -0.05, -1.57, -1.39, 0.0]
    high = [np.pi, np.pi, np.pi, 0.08, 0.08, 0.25, 1.57, 1.39, 1.57]
    return rng.uniform(low * arms, high * arms, (count, 9 * arms))


@pytest.mark.slow
@pytest.mark.parametrize("arms", [1, 2])
def test_counts_are_the_compiled_engines(camera: Camera, device: str, arms: int) -> None:
    instruments = [load_instrument("large_needle_driver")] * arms
    states = scattered(np.random.default_rng(arms), 300, arms)
    ours, theirs = evaluators(instruments, camera, device)
    assert theirs.triangles == ours.triangles
    areas = theirs.score(states, Reference(checker(camera))).area
    assert 0 < np.count_nonzero(areas) < len(states), "some are seen and some are not"
    assert_same_counts(ours, theirs, states)


angle = st.floats(-np.pi, np.pi)
needle_driver_states = st.tuples(
    angle, angle, angle, st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.05, 0.25),
    st.floats(-1.57, 1.57), st.floats(-1.39, 1.39), st.floats(0.0, 1.57),
).map(np.array)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=40)
@given(state=needle_driver_states)
def test_any_pose_has_the_compiled_engines_mask(small_camera: Camera, device: str, state: FloatArray) -> None:
    ours, theirs = evaluators([load_instrument("large_needle_driver")], small_camera, device)
    mask = theirs.mask(state)
    assert np.count_nonzero(mask != ours.mask(state)) <= TOLERANCE_PX
    reference = Reference(checker(small_camera))
    score = theirs.score(state[None], reference)
    assert score.area[0] == np.count_nonzero(mask)
    assert score.overlap[0] == np.count_nonzero(mask & reference.mask)


@pytest.mark.slow
@settings(max_examples=30)
@given(left=needle_driver_states, right=needle_driver_states)
def test_two_arms_count_their_union_once(
    small_camera: Camera, device: str, left: FloatArray, right: FloatArray
) -> None:
    instrument = load_instrument("large_needle_driver")
    one, pair = (evaluators([instrument] * arms, small_camera, device)[1] for arms in (1, 2))
    union = one.mask(left) | one.mask(right)
    assert np.count_nonzero(pair.mask(np.concatenate([left, right])) != union) <= batch_tolerance_px(device)


@pytest.mark.slow
def test_bodies_that_the_near_plane_cuts(small_camera: Camera, device: str) -> None:
    """Holes, concave outlines and parts within each other, with the plane anywhere in them."""
    box, ring = trimesh.creation.box((0.02, 0.03, 0.05)), trimesh.creation.torus(0.02, 0.006, 12, 8)
    states = scattered(np.random.default_rng(5), 400)
    states[:, 3:6] *= 0.3
    both: Any = trimesh.util.concatenate([box, ring])
    for mesh in (box, ring, both):
        assert_same_counts(*evaluators([rigid_instrument(mesh)], small_camera, device), states)


def test_camera_inside_a_solid_sees_nothing_else(small_camera: Camera, device: str) -> None:
    room = rigid_instrument(trimesh.creation.box((0.1, 0.1, 0.1)))
    assert evaluators([room], small_camera, device)[1].mask(np.zeros(9)).all()


def test_vertices_on_pixel_centres_are_counted_half_open(device: str) -> None:
    camera = Camera(width=16, height=16, fx=1.0, fy=1.0, cx=2.0, cy=2.0)
    box = trimesh.creation.box(bounds=[[0, 0, 0], [3, 3, 1]])
    mask = evaluators([rigid_instrument(box)], camera, device)[1].mask(np.array([0, 0, 0, 0, 0, 1.0, 0, 0, 0]))
    expected = np.zeros((16, 16), dtype=bool)
    expected[2:5, 2:5] = True
    assert np.array_equal(mask, expected)


def test_an_edge_too_flat_to_have_a_slope_spoils_nothing(device: str) -> None:
    """Columns per row overflow between rows 0 and 1e-310: no index may come of it."""
    camera = Camera(width=16, height=16, fx=1.0, fy=1.0, cx=2.0, cy=0.0)
    box = trimesh.creation.box(bounds=[[0, 0, 0], [3, 3, 1]])
    box.vertices[np.flatnonzero((box.vertices == [3, 0, 0]).all(axis=1))] = [3, 1e-310, 0]
    mask = evaluators([rigid_instrument(box)], camera, device)[1].mask(np.array([0, 0, 0, 0, 0, 1.0, 0, 0, 0]))
    expected = np.zeros((16, 16), dtype=bool)
    expected[1:3, 2:5] = True
    assert np.array_equal(mask[1:], expected[1:])


def test_impossible_states_cover_nothing_and_harm_no_other(small_camera: Camera, device: str) -> None:
    """One sum runs over the crossings of all candidates: a broken one must not spoil those after it."""
    evaluator = evaluators([load_instrument("large_needle_driver")], small_camera, device)[1]
    reference = Reference(checker(small_camera))
    sound = resting_state() + 0.004 * np.arange(8)[:, None]
    alone = evaluator.score(sound, reference)
    assert alone.area.all()
    mixed = np.repeat(sound, 2, axis=0)
    mixed[0::2] = resting_state()
    mixed[[0, 2, 4], [1, 5, 8]] = np.nan, np.inf, -np.inf
    mixed[[6, 8, 10, 12, 14], [3, 5, 3, 4, 5]] = 1e155, 1e300, 1e100, -1e150, -1.0
    together = evaluator.score(mixed, reference)
    assert together.area[0::2].tolist() == together.overlap[0::2].tolist() == [0] * 8
    tolerance_px = batch_tolerance_px(device)
    np.testing.assert_allclose(together.area[1::2], alone.area, rtol=0, atol=tolerance_px)
    np.testing.assert_allclose(together.overlap[1::2], alone.overlap, rtol=0, atol=tolerance_px)
    assert not evaluator.mask(mixed[0]).any()


@pytest.mark.slow
def test_batches_and_memory_change_nothing(small_camera: Camera, device: str) -> None:
    instruments = [load_instrument("large_needle_driver")]
    states = scattered(np.random.default_rng(7), 61)
    reference = Reference(checker(small_camera))
    expected = evaluators(instruments, small_camera, device)[1].score(states, reference)
    tolerance_px = batch_tolerance_px(device)
    # Room for one candidate at a time; for some; for all but for too many crossings, which are then split.
    for memory_bytes in (1, 3_000_000, 1 << 30):
        evaluator = evaluators(instruments, small_camera, device, memory_bytes=memory_bytes)[1]
        if memory_bytes == 1 << 30:
            evaluator._most_crossings = 500
        found = evaluator.score(states, reference)
        np.testing.assert_allclose(found.area, expected.area, rtol=0, atol=tolerance_px)
        np.testing.assert_allclose(found.overlap, expected.overlap, rtol=0, atol=tolerance_px)


@pytest.mark.slow
def test_integer_images_are_summed(small_camera: Camera, device: str) -> None:
    ours, theirs = evaluators([load_instrument("large_needle_driver")], small_camera, device)
    states = resting_state() + 0.01 * np.arange(6)[:, None]
    image = np.random.default_rng(2).integers(-5000, 9000, (small_camera.height, small_camera.width))
    images = RowSums(image), RowSums(image[::-1])
    for sums in (*images, *images):  # another image at every turn: none may be taken for the one before
        (area, total), (expected_area, expected) = theirs.sum_over(states, sums), ours.sum_over(states, sums)
        np.testing.assert_allclose(area, expected_area, rtol=0, atol=TOLERANCE_PX)
        np.testing.assert_allclose(total, expected, rtol=0, atol=9000 * TOLERANCE_PX)


def test_tensors_stay_on_their_device(small_camera: Camera, device: str) -> None:
    evaluator = evaluators([load_instrument("large_needle_driver")], small_camera, device)[1]
    states = resting_state() + 0.01 * np.arange(6)[:, None]
    reference = Reference(checker(small_camera))
    expected = evaluator.score(states, reference)
    tensor = torch.tensor(states, device=device, requires_grad=True)
    area, overlap = evaluator.counts(tensor, evaluator.upload(reference))
    assert area.device.type == overlap.device.type == device
    assert area.tolist() == expected.area.tolist()
    assert overlap.tolist() == expected.overlap.tolist()
    assert evaluator.score(tensor, reference).area.tolist() == expected.area.tolist()
    assert evaluator.score(np.empty((0, 9)), reference).area.shape == (0,)


def test_wrong_shapes_are_refused(small_camera: Camera, device: str) -> None:
    evaluator = evaluators([load_instrument("large_needle_driver")], small_camera, device)[1]
    with pytest.raises(ValueError, match="size 9"):
        evaluator.mask(np.zeros(18))
    with pytest.raises(ValueError, match="2 dimensions"):
        evaluator.score(np.zeros(9), Reference(checker(small_camera)))
    with pytest.raises(ValueError, match="the camera"):
        evaluator.score(np.zeros((1, 9)), Reference(np.zeros((5, 5), bool)))


def test_the_objective_scores_on_the_scenes_device(
    small_camera: Camera, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from surgbench.silhouette import torch_evaluator

    scene = scene_of(small_camera)
    frame = observe(scene, resting_state())
    states = resting_state() + 0.01 * np.arange(6)[:, None]
    if device == "cpu":  # what a scene calls "cpu" is the compiled engine
        monkeypatch.setattr(torch_evaluator, "check_device", lambda _: torch.device("cpu"))
    objectives = [Objective(replace(scene, device=name), LossWeights()) for name in ("cpu", "cuda")]
    assert isinstance(objectives[1].evaluator, torch_evaluator.TorchSilhouetteEvaluator)
    losses = []
    for objective in objectives:
        objective.observe(frame)
        losses.append(objective(states)[0])
    np.testing.assert_allclose(losses[1], losses[0], rtol=0, atol=3 * TOLERANCE_PX)


# From the command line to the tracker


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "mini"
    generate(plan_dataset(load_preset("mini", frames=2)), folder)
    return folder


class NoTorch:
    """What the import system asks first: there is no such package."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "torch":
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


def without_torch(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "meta_path", [NoTorch(), *sys.meta_path])
    for module in ("torch", "surgbench.silhouette.torch_evaluator"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    return "pip install torch"


def without_gpu(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    return "use device 'cpu'"


@pytest.mark.parametrize("missing", [without_torch, without_gpu])
def test_a_device_that_is_not_there_is_answered_in_one_line(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], missing: Any
) -> None:
    advice = missing(monkeypatch)
    out = tmp_path / "runs"
    arguments = ["run", "--dataset", str(dataset), "--tracker", "cmaes", "--device", "cuda", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["surgbench", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    complaint = capsys.readouterr().err
    assert "device 'cuda'" in complaint
    assert advice in complaint
    assert complaint.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda:99"])
def test_unknown_devices_are_refused(name: str) -> None:
    from surgbench.silhouette.torch_evaluator import check_device

    with pytest.raises(ConfigError, match=f"'{name}'"):
        check_device(name)


def test_the_device_is_part_of_the_settings_only_where_it_is_no_cpu(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hashes of runs on the CPU are those from before there was a choice."""
    monkeypatch.setattr("surgbench.silhouette.torch_evaluator.check_device", lambda _: None)
    data = open_as(InstrumentDataset, dataset)
    on_cpu, on_gpu = (complete(RowRequest(tracker="cmaes"), Conditions(device=name), data) for name in ("cpu", "cuda"))
    assert "device" not in on_cpu.spec()
    assert on_gpu.spec() == {**on_cpu.spec(), "device": "cuda"}
    assert on_cpu.hash != on_gpu.hash
    assert "device cuda" in on_gpu.variant
    assert "device" not in on_cpu.variant
    for chosen, name in ((on_cpu, "cpu"), (on_gpu, "cuda")):
        job = jobs(chosen, data)[0]
        assert child_setup(job, unit_data(job, data)).scene.device == name


@pytest.mark.parametrize("device", ["cuda"], indirect=True)
def test_a_run_on_the_gpu_is_recorded_with_its_card(
    dataset: Path, tmp_path: Path, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["run", "--dataset", str(dataset), "--tracker", "cmaes", "--device", device, "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["surgbench", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    records = [json.loads(path.read_text()) for path in tmp_path.rglob("*-r*.json")]
    assert records
    for record in records:
        assert record["status"] == "ok"
        assert record["spec"]["device"] == "cuda"
        assert record["environment"]["machine"]["gpu"]["driver"]
