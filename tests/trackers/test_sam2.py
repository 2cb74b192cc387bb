"""The mask source ``sam2``: the real code on tiny networks with random weights. Needs the extra ``sam2``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support import observe, resting_state, scene_of
from tiny_sam2 import SIDE_PX, tiny_network, write_tiny

from surgbench.camera import Camera
from surgbench.contract import Scene
from surgbench.errors import ConfigError, DatasetError
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.processes.torch_threads import one_thread
from surgbench.registry import configure, create, find
from surgbench.trackers.masks.sam2 import Sam2Masks

pytestmark = [pytest.mark.extras, pytest.mark.slow]
torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers", reason="transformers is not installed (surgbench[sam2])")

CAMERA = Camera(width=88, height=62, fx=113.2, fy=113.1, cx=36.3, cy=29.4)
FRAMES = 6
SAME_SHARE = 0.01  # where two objects are as likely, the last digits decide, and they depend on the objects' order
LEFT, RIGHT = (20.0, 30.0), (66.0, 34.0)
KINDS = ("sam2_video", "edgetam_video")


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A checkpoint of each kind."""
    folder = tmp_path_factory.mktemp("tiny")
    for kind in KINDS:
        write_tiny(folder / kind, kind)
    return {kind: folder / kind for kind in KINDS}


@pytest.fixture(autouse=True)
def never_the_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asks the hub fails."""
    import huggingface_hub

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the hub was asked")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    monkeypatch.setattr("transformers.utils.hub.hf_hub_download", refuse)


@pytest.fixture
def damaged(tiny: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a checkpoint that a test may change."""
    return Path(shutil.copytree(tiny["sam2_video"], tmp_path / "damaged"))


def painted(frame: int) -> NDArray[np.uint8]:
    """Two bars on a mottled ground, which move apart."""
    ground = np.random.default_rng(5).integers(60, 120, (CAMERA.height, CAMERA.width, 3))
    picture: Any = cv2.blur(ground.astype(np.uint8), (5, 5))
    for (u, v), step, colour in ((LEFT, -1, (220, 220, 230)), (RIGHT, 1, (40, 30, 35))):
        cv2.rectangle(
            picture, (int(u) - 9 + step * frame, int(v) - 6), (int(u) + 9 + step * frame, int(v) + 6), colour, -1
        )
    return np.asarray(picture, dtype=np.uint8)


def frames(scene: Scene, count: int = FRAMES) -> Iterator[tuple[Any, Any]]:
    """Observation and view of each frame."""
    observation = observe(scene, np.tile(resting_state(), scene.arms))
    for frame in range(count):
        view = replace(scene.views[0], image=partial(painted, frame))
        yield replace(observation, index=frame, views=(view,)), view


def both(left: tuple[float, float] = LEFT, right: tuple[float, float] = RIGHT) -> Prompts:
    return Prompts([np.array([left]), np.array([right])], [np.array([True]), np.array([True])])


def followed(model: Path, prompts: Prompts | None = None, count: int = FRAMES, **options: Any) -> list[FoundMasks]:
    """All masks of the painted video."""
    scene, prompts = scene_of(CAMERA, arms=2), prompts or both()
    source = create(find("mask_source", "sam2"), {"model": str(model), **options})
    source.reset(scene, next(frames(scene))[1], prompts)
    return [source.segment(observation, view) for observation, view in frames(scene, count)]


def same(one: list[FoundMasks], other: list[FoundMasks]) -> bool:
    return all(
        np.array_equal(a.mask, b.mask) and np.array_equal(a.instance_masks or (), b.instance_masks or ())
        for a, b in zip(one, other, strict=True)
    )


def apart(found: list[FoundMasks]) -> NDArray[np.bool_]:
    """``(frames, arms, height, width)``."""
    return np.array([one.instance_masks for one in found])


# --- masks


@pytest.mark.parametrize("kind", KINDS)
def test_masks_are_of_the_cameras_size_and_always_the_same(tiny: dict[str, Path], kind: str) -> None:
    found = followed(tiny[kind])
    for one in found:
        assert one.instance_masks is not None
        left, right = one.instance_masks
        assert left.shape == right.shape == one.mask.shape == (CAMERA.height, CAMERA.width)
        assert one.mask.dtype == bool
        assert not (left & right).any()
        np.testing.assert_array_equal(one.mask, left | right)
        assert 0 < one.confidence < 1
    assert 0 < np.mean([one.mask.mean() for one in found]) < 1
    assert not same(found[:1] * 5, found[1:])  # each frame is looked at
    again = followed(tiny[kind])
    assert same(found, again)
    assert [one.confidence for one in found] == [one.confidence for one in again]


@pytest.mark.parametrize("kind", KINDS)
def test_prompts_decide_what_is_found(tiny: dict[str, Path], kind: str) -> None:
    found = apart(followed(tiny[kind], count=3))
    exchanged = apart(followed(tiny[kind], both(RIGHT, LEFT), count=3))
    assert (found != exchanged[:, ::-1]).mean() < SAME_SHARE
    assert (found != exchanged).mean() > 5 * SAME_SHARE
    moved = apart(followed(tiny[kind], both((20.0, 12.0), (60.0, 50.0)), count=3))
    assert (found != moved).mean() > 5 * SAME_SHARE


def test_points_beside_an_arm_and_on_the_other_are_what_it_is_not(tiny: dict[str, Path]) -> None:
    from surgbench.trackers.masks.sam2_video.checkpoint import load_network
    from surgbench.trackers.masks.sam2_video.objects import VideoObjects

    points = [np.array([LEFT, (5.0, 5.0)]), np.array([RIGHT])]
    found = followed(tiny["sam2_video"], Prompts(points, [np.array([True, False]), np.array([True])]), count=2)
    objects = VideoObjects(load_network(tiny["sam2_video"], "", "cpu", None), CAMERA.height, CAMERA.width)
    objects.prompt(np.array([LEFT, (5.0, 5.0), RIGHT]), np.array([True, False, False]))
    objects.prompt(np.array([RIGHT, LEFT]), np.array([True, False]))
    for frame, one in enumerate(found):
        logits = objects.step(painted(frame)).logits
        assert one.instance_masks is not None
        np.testing.assert_array_equal(one.instance_masks[0], (logits[0] > 0) & (logits[0] >= logits[1]))
        np.testing.assert_array_equal(one.instance_masks[1], (logits[1] > 0) & (logits[1] > logits[0]))


def test_an_arm_without_points_is_not_looked_for(tiny: dict[str, Path]) -> None:
    alone = Prompts([np.zeros((0, 2)), np.array([RIGHT])], [np.zeros(0, dtype=bool), np.array([True])])
    for one in followed(tiny["sam2_video"], alone):
        assert one.instance_masks is not None
        assert not one.instance_masks[0].any()
        np.testing.assert_array_equal(one.mask, one.instance_masks[1])


def test_the_threshold_is_one_of_logits(tiny: dict[str, Path]) -> None:
    lower, usual, higher = (followed(tiny["sam2_video"], threshold=value, count=2) for value in (-1e4, 0.0, 1e4))
    for low, middle, high in zip(lower, usual, higher, strict=True):
        assert low.mask.all()
        assert not high.mask.any()
        assert (low.mask | middle.mask).sum() > middle.mask.sum() > 0


def test_what_is_said_to_be_hidden_has_no_mask_and_is_as_sure(tmp_path: Path) -> None:
    write_tiny(tmp_path / "hidden", "sam2_video", presence=-20.0)
    for one in followed(tmp_path / "hidden", count=3):
        assert not one.mask.any()
        assert one.confidence > 0.99


# --- memory


def test_what_is_remembered_does_not_grow(tiny: dict[str, Path]) -> None:
    """And nothing is forgotten that the library, which keeps all, would look at again."""
    from surgbench.trackers.masks.sam2_video.checkpoint import load_network
    from surgbench.trackers.masks.sam2_video.objects import VideoObjects, network_input

    for kind in KINDS:
        network = load_network(tiny[kind], "", "cpu", None)
        objects = VideoObjects(network, CAMERA.height, CAMERA.width)
        keeps_all = getattr(transformers, type(network).__name__.replace("Model", "InferenceSession"))(
            video_height=CAMERA.height, video_width=CAMERA.width, dtype=torch.float32
        )
        objects.prompt(np.array([LEFT]), np.array([True]))
        scale = SIDE_PX / np.array([CAMERA.width, CAMERA.height])
        keeps_all.add_point_inputs(
            keeps_all.obj_id_to_idx(0),
            0,
            {
                "point_coords": torch.tensor(np.array([[[LEFT]]]) * scale, dtype=torch.float32),
                "point_labels": torch.ones((1, 1, 1), dtype=torch.int32),
            },
        )
        keeps_all.obj_with_new_inputs = [0]
        sizes = []
        for frame in range(14):
            logits = objects.step(painted(frame)).logits
            with one_thread():  # as the source: with several, last digits differ
                expected = network(inference_session=keeps_all, frame=network_input(painted(frame), SIDE_PX, "cpu"))
            resized = torch.nn.functional.interpolate(expected.pred_masks, logits.shape[1:], mode="bilinear")
            np.testing.assert_array_equal(logits, resized[:, 0].numpy())
            sizes.append(stored(objects._session))
        assert sizes[2] < sizes[-1] == sizes[6]
        assert stored(keeps_all) > 3 * sizes[-1]


def stored(session: Any) -> int:
    """Numbers in the tensors that a session keeps, and how much else it counts frames in."""
    seen: dict[int, int] = {}

    def look(value: Any) -> int:
        if isinstance(value, torch.Tensor):
            storage = value.untyped_storage()
            seen[storage.data_ptr()] = storage.nbytes()
            return 0
        if isinstance(value, dict):
            return len(value) + sum(map(look, value.values()))
        return sum(map(look, value)) if isinstance(value, list | tuple) else 0

    entries = sum(map(look, vars(session).values())) + look(vars(session.cache))
    return sum(seen.values()) + entries


def test_frames_before_count_as_many_as_are_remembered(tiny: dict[str, Path]) -> None:
    usual = followed(tiny["sam2_video"])
    fewer = followed(tiny["sam2_video"], memory_frames=1)
    assert same(usual[:2], fewer[:2])  # until then there is no more than the prompted frame
    assert not same(usual, fewer)
    assert same(usual, followed(tiny["sam2_video"], memory_on="cpu"))
    with pytest.raises(ConfigError, match="remembers 3 frames at most, not 4"):
        followed(tiny["sam2_video"], memory_frames=4)


# --- pictures


def test_pictures_are_resized_and_normalised_as_the_library_says() -> None:
    from surgbench.trackers.masks.sam2_video.objects import MEAN, STANDARD_DEVIATION, network_input

    def grey_levels(image: NDArray[np.uint8], side: int) -> NDArray[np.float64]:
        made = network_input(image, side, "cpu")[0].permute(1, 2, 0).double().numpy()
        levels: NDArray[np.float64] = (made * STANDARD_DEVIATION + MEAN) * 255
        return levels

    larger = grey_levels(painted(0), 200)
    np.testing.assert_allclose(larger, cv2.resize(painted(0), (200, 200), interpolation=cv2.INTER_LINEAR), atol=1.01)
    np.testing.assert_allclose(larger, np.rint(larger), atol=1e-3)  # 8 bits
    fine = (
        np.indices((64, 64)).sum(axis=0) % 2 * np.uint8(255)
    )  # a pattern that shows where every other pixel is left out
    smaller = grey_levels(np.repeat(fine[..., None], 3, axis=2).astype(np.uint8), 16)
    np.testing.assert_allclose(smaller[1:-1, 1:-1], 127.5, atol=1)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_finds_what_a_cpu_finds(tiny: dict[str, Path]) -> None:
    scene = replace(scene_of(CAMERA, arms=2), device="cuda")
    for kind in KINDS:
        source = Sam2Masks(Sam2Masks.Config(model=str(tiny[kind])))
        source.reset(scene, next(frames(scene))[1], both())
        for (observation, view), expected in zip(frames(scene), followed(tiny[kind]), strict=True):
            assert (source.segment(observation, view).mask != expected.mask).mean() < 0.01


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (None, "frame 3 has no image"),
        (np.zeros((64, 88, 3), np.uint8), "frame 3: the image is 88 x 64 pixels, not 88 x 62"),
    ],
)
def test_frames_without_an_image_of_the_size_are_named(tiny: dict[str, Path], image: Any, message: str) -> None:
    scene = scene_of(CAMERA, arms=2)
    source = Sam2Masks(Sam2Masks.Config(model=str(tiny["sam2_video"])))
    source.reset(scene, next(frames(scene))[1], both())
    observation, view = list(frames(scene))[3]
    with pytest.raises(DatasetError, match=message):
        source.segment(observation, replace(view, image=lambda: image))


@pytest.mark.parametrize(
    ("prompts", "message"),
    [
        (None, "points on the first frame for 2 arms, and there are none"),
        (Prompts([np.array([LEFT])], [np.array([True])]), "for 2 arms, and there are those of 1"),
        (both((88.0, 20.0)), r"the point \(88, 20\) lies outside the picture of 88x62 pixels"),
        (Prompts([np.array([LEFT])] * 2, [np.array([False])] * 2), "a point on an arm"),
    ],
)
def test_prompts_that_will_not_do_are_refused(tiny: dict[str, Path], prompts: Prompts | None, message: str) -> None:
    scene = scene_of(CAMERA, arms=2)
    source = Sam2Masks(Sam2Masks.Config(model=str(tiny["sam2_video"])))
    with pytest.raises(ConfigError, match=message):
        source.reset(scene, next(frames(scene))[1], prompts)


# --- checkpoints


def refused(model: Path | str, **options: Any) -> str:
    """The line that a checkpoint is refused with, when it is asked for or when it is loaded."""
    with pytest.raises(ConfigError) as caught:
        followed(model, count=1, **options)  # type: ignore[arg-type]
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_records_say_which_weights_they_were_made_with(tiny: dict[str, Path]) -> None:
    config: Any = configure(find("mask_source", "sam2"), {"model": str(tiny["sam2_video"])})
    assert len(config.model_sha256) == 16
    assert config.model_sha256 in refused(tiny["edgetam_video"], model_sha256=config.model_sha256)


def test_without_a_model_it_says_how_to_name_one() -> None:
    assert "--set sam2.model=FOLDER, or a name on the hub such as facebook/" in refused("")


def test_files_and_folders_that_are_none_are_named(tmp_path: Path, tiny: dict[str, Path]) -> None:
    assert f"{tmp_path / 'nowhere'}: no such folder" in refused(tmp_path / "nowhere")
    assert f"{tmp_path}/config.json: cannot be read (no such file" in refused(tmp_path)
    weights = tiny["sam2_video"] / "model.safetensors"
    assert "expected a folder, which `surgbench convert sam2` makes" in refused(weights)


def test_a_relative_folder_that_is_missing_is_no_name_on_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    assert "models/mine: no such folder" in refused("models/mine")


def test_the_hub_is_asked_for_a_name_alone(
    tiny: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub

    asked = []

    def fetch(name: str, *, revision: str, allow_patterns: list[str]) -> str:
        asked.append((name, revision))
        if revision != "main":
            raise OSError("no such revision\nfurther lines")
        return str(tiny["sam2_video"])

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", fetch)
    configure(find("mask_source", "sam2"), {"model": "somebody/sam2"})
    assert not asked  # until it is needed
    assert same(followed("somebody/sam2", count=2), followed(tiny["sam2_video"], count=2))  # type: ignore[arg-type]
    assert asked == [("somebody/sam2", "main")]
    assert refused("somebody/sam2", revision="old") == (
        "somebody/sam2: cannot be fetched from the hub (no such revision)"
    )


def rewrite(folder: Path, **changes: Any) -> None:
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **changes}), encoding="utf-8")


def test_a_checkpoint_in_several_files_is_read(tiny: dict[str, Path], tmp_path: Path) -> None:
    tiny_network("sam2_video").save_pretrained(tmp_path / "parts", max_shard_size="1MB")
    parts = sorted((tmp_path / "parts").glob("*.safetensors"))
    assert len(parts) > 1
    assert same(followed(tmp_path / "parts", count=2), followed(tiny["sam2_video"], count=2))
    parts[0].unlink()
    assert f"{parts[0]}: no such file" in refused(tmp_path / "parts")


def test_another_architecture_is_named(damaged: Path) -> None:
    rewrite(damaged, model_type="sam2")
    assert refused(damaged).endswith(
        f"{damaged}/config.json: the checkpoint is of the architecture 'sam2'; expected 'sam2_video' or 'edgetam_video'"
    )
    (damaged / "config.json").write_text("{", encoding="utf-8")
    assert f"{damaged}/config.json: not valid JSON" in refused(damaged)


def test_damaged_weights_are_named(damaged: Path) -> None:
    weights = damaged / "model.safetensors"
    data = weights.read_bytes()
    weights.write_bytes(data[: len(data) // 2])
    assert f"{weights}: damaged, or no safetensors file" in refused(damaged)
    weights.unlink()
    assert f"{weights}: no such file; expected the weights" in refused(damaged)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"add": "stranger"}, "'stranger' is unknown"),
        ({"remove": "no_memory_embedding"}, "'no_memory_embedding' is missing"),
        ({"cut": "memory_attention.layers.0.linear1.bias"}, r"'.*linear1.bias' is of shape (16,), not (32,)"),
    ],
)
def test_weights_of_another_network_are_named(damaged: Path, change: dict[str, str], message: str) -> None:
    from safetensors.torch import load_file, save_file

    weights = damaged / "model.safetensors"
    tensors = load_file(weights)
    if "add" in change:
        tensors[change["add"]] = torch.zeros(1)
    if "remove" in change:
        del tensors[change["remove"]]
    if "cut" in change:
        tensors[change["cut"]] = tensors[change["cut"]][:16].clone()
    save_file(tensors, weights, {"format": "pt"})
    line = refused(damaged)
    assert line.startswith(f"{weights}: not the weights of what config.json describes")
    assert message.replace(".*", "memory_attention.layers.0.") in line


def test_an_encoder_of_timms_needs_timm(damaged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.trackers.masks.sam2_video.checkpoint.missing", lambda modules: "timm is missing")
    rewrite(damaged, vision_config={"backbone_config": {"model_type": "timm_wrapper"}})
    assert "its image encoder is one of timm's, and timm is not installed: pip install timm" in refused(damaged)


def test_configurations_as_older_versions_wrote_them_are_read(damaged: Path, tiny: dict[str, Path]) -> None:
    config = json.loads((damaged / "config.json").read_text(encoding="utf-8"))
    config.pop("rope_parameters", None)
    config |= {"memory_attention_rope_theta": 10000, "torch_dtype": "float32"}
    (damaged / "config.json").write_text(json.dumps(config), encoding="utf-8")
    assert same(followed(damaged, count=3), followed(tiny["sam2_video"], count=3))
