"""``surgbench convert sam2``: names and shapes of SAM 2's own repository, on tensors with random values."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import surgbench
from tiny_sam2 import tiny_network

from surgbench.errors import ConfigError

pytestmark = [pytest.mark.extras, pytest.mark.slow]
torch = pytest.importorskip("torch")
pytest.importorskip("transformers", reason="transformers is not installed (surgbench[sam2])")

# Bytes of the files that Meta distributes: four for each weight, and a hundred or two thousand for names and places.
PUBLISHED = {
    ("tiny", False): 155_906_050,
    ("small", False): 184_309_650,
    ("base-plus", False): 323_493_298,
    ("large", False): 897_952_466,
    ("tiny", True): 156_008_466,
    ("small", True): 184_416_285,
    ("base-plus", True): 323_606_802,
    ("large", True): 898_083_611,
}
# Of the repository's configurations: embed_dim, stages, window_pos_embed_bkg_spatial_size.
HIERA = {
    "tiny": (96, (1, 2, 7, 2), 7),
    "small": (96, (1, 2, 11, 2), 7),
    "base-plus": (112, (2, 3, 16, 3), 14),
    "large": (144, (2, 6, 36, 4), 7),
}
Shape = tuple[int, ...]


def layer(name: str, *shape: int) -> Iterator[tuple[str, Shape]]:
    """A weight, and a bias of its first dimension."""
    yield f"{name}.weight", shape
    yield f"{name}.bias", shape[:1]


def mlp(name: str, *sizes: int) -> Iterator[tuple[str, Shape]]:
    for number, (before, after) in enumerate(pairwise(sizes)):
        yield from layer(f"{name}.layers.{number}", after, before)


def attention(name: str, inner: int, memory: int = 256) -> Iterator[tuple[str, Shape]]:
    yield from layer(f"{name}.q_proj", inner, 256)
    yield from layer(f"{name}.k_proj", inner, memory)
    yield from layer(f"{name}.v_proj", inner, memory)
    yield from layer(f"{name}.out_proj", 256, inner)


def image_encoder(size: str) -> Iterator[tuple[str, Shape]]:
    width, stages, background = HIERA[size]
    trunk = "image_encoder.trunk"
    yield f"{trunk}.pos_embed", (1, width, background, background)
    yield f"{trunk}.pos_embed_window", (1, width, 8, 8)
    yield from layer(f"{trunk}.patch_embed.proj", width, 3, 7, 7)
    before, number = width, 0
    for stage, blocks in enumerate(stages):
        after = width * 2**stage
        for _ in range(blocks):
            block = f"{trunk}.blocks.{number}"
            yield from layer(f"{block}.norm1", before)
            yield from layer(f"{block}.attn.qkv", 3 * after, before)
            yield from layer(f"{block}.attn.proj", after, after)
            yield from layer(f"{block}.norm2", after)
            yield from mlp(f"{block}.mlp", after, 4 * after, after)
            if before != after:
                yield from layer(f"{block}.proj", after, before)
            before, number = after, number + 1
    for level in range(4):
        yield from layer(f"image_encoder.neck.convs.{level}.conv", 256, width * 2 ** (3 - level), 1, 1)


def memory() -> Iterator[tuple[str, Shape]]:
    for number in range(4):
        block = f"memory_attention.layers.{number}"
        yield from attention(f"{block}.self_attn", 256)
        yield from attention(f"{block}.cross_attn_image", 256, 64)
        yield from layer(f"{block}.linear1", 2048, 256)
        yield from layer(f"{block}.linear2", 256, 2048)
        for norm in (1, 2, 3):
            yield from layer(f"{block}.norm{norm}", 256)
    yield from layer("memory_attention.norm", 256)
    encoder = "memory_encoder.mask_downsampler.encoder"
    for step in range(4):
        yield from layer(f"{encoder}.{3 * step}", 4 ** (step + 1), 4**step, 3, 3)
        yield from layer(f"{encoder}.{3 * step + 1}", 4 ** (step + 1))
    yield from layer(f"{encoder}.12", 256, 256, 1, 1)
    yield from layer("memory_encoder.pix_feat_proj", 256, 256, 1, 1)
    for number in range(2):
        block = f"memory_encoder.fuser.layers.{number}"
        yield f"{block}.gamma", (256,)
        yield from layer(f"{block}.dwconv", 256, 1, 7, 7)
        yield from layer(f"{block}.norm", 256)
        yield from layer(f"{block}.pwconv1", 1024, 256)
        yield from layer(f"{block}.pwconv2", 256, 1024)
    yield from layer("memory_encoder.out_proj", 64, 256, 1, 1)


def heads() -> Iterator[tuple[str, Shape]]:
    prompts, decoder = "sam_prompt_encoder", "sam_mask_decoder"
    yield f"{prompts}.pe_layer.positional_encoding_gaussian_matrix", (2, 128)
    for point in range(4):
        yield f"{prompts}.point_embeddings.{point}.weight", (1, 256)
    yield f"{prompts}.not_a_point_embed.weight", (1, 256)
    yield f"{prompts}.no_mask_embed.weight", (1, 256)
    yield from layer(f"{prompts}.mask_downscaling.0", 4, 1, 2, 2)
    yield from layer(f"{prompts}.mask_downscaling.1", 4)
    yield from layer(f"{prompts}.mask_downscaling.3", 16, 4, 2, 2)
    yield from layer(f"{prompts}.mask_downscaling.4", 16)
    yield from layer(f"{prompts}.mask_downscaling.6", 256, 16, 1, 1)
    for number in range(2):
        block = f"{decoder}.transformer.layers.{number}"
        yield from attention(f"{block}.self_attn", 256)
        yield from attention(f"{block}.cross_attn_token_to_image", 128)
        yield from attention(f"{block}.cross_attn_image_to_token", 128)
        yield from mlp(f"{block}.mlp", 256, 2048, 256)
        for norm in (1, 2, 3, 4):
            yield from layer(f"{block}.norm{norm}", 256)
    yield from attention(f"{decoder}.transformer.final_attn_token_to_image", 128)
    yield from layer(f"{decoder}.transformer.norm_final_attn", 256)
    yield f"{decoder}.iou_token.weight", (1, 256)
    yield f"{decoder}.mask_tokens.weight", (4, 256)
    yield f"{decoder}.obj_score_token.weight", (1, 256)
    for number, shape in ((0, (256, 64, 2, 2)), (3, (64, 32, 2, 2))):
        yield f"{decoder}.output_upscaling.{number}.weight", shape
        yield f"{decoder}.output_upscaling.{number}.bias", shape[1:2]
    yield from layer(f"{decoder}.output_upscaling.1", 64)
    yield from layer(f"{decoder}.conv_s0", 32, 256, 1, 1)
    yield from layer(f"{decoder}.conv_s1", 64, 256, 1, 1)
    for token in range(4):
        yield from mlp(f"{decoder}.output_hypernetworks_mlps.{token}", 256, 256, 256, 32)
    yield from mlp(f"{decoder}.iou_prediction_head", 256, 256, 256, 4)
    yield from mlp(f"{decoder}.pred_obj_score_head", 256, 256, 256, 1)


def original(size: str, newer: bool) -> dict[str, Any]:
    """Names and shapes of a checkpoint of SAM 2, or 2.1, as the modules of the repository make them."""
    shapes: dict[str, Shape] = {
        "maskmem_tpos_enc": (7, 1, 1, 64),
        "no_mem_embed": (1, 1, 256),
        "no_mem_pos_enc": (1, 1, 256),
        "no_obj_ptr": (1, 256),
        **dict(image_encoder(size)),
        **dict(layer("mask_downsample", 1, 1, 4, 4)),
        **dict(memory()),
        **dict(heads()),
        **dict(mlp("obj_ptr_proj", 256, 256, 256, 256)),
    }
    if newer:
        shapes |= {"no_obj_embed_spatial": (1, 64), **dict(layer("obj_ptr_tpos_proj", 64, 256))}
    return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


@pytest.mark.parametrize(("size", "newer"), PUBLISHED)
def test_every_tensor_of_the_published_sizes_has_its_place(size: Any, newer: bool) -> None:
    from surgbench.trackers.masks.sam2_video.original import convert, video_config

    tensors = original(size, newer)
    config = video_config(size, 1024, tensors)
    converted = convert(tensors, config, "original.pt")
    assert config.enable_occlusion_spatial_embedding is newer
    assert config.enable_temporal_pos_encoding_for_object_pointers is newer
    weights = sum(value.numel() for value in tensors.values())
    assert sum(value.numel() for value in converted.values()) == weights + 2 * 128  # the grid of positions twice
    overhead = PUBLISHED[size, newer] - 4 * weights
    assert 100 * len(tensors) < overhead < 400 * len(tensors)


@pytest.mark.parametrize(
    ("name", "becomes"),
    [
        ("maskmem_tpos_enc", "memory_temporal_positional_encoding"),
        ("no_mem_embed", "no_memory_embedding"),
        ("no_obj_ptr", "no_object_pointer"),
        ("no_obj_embed_spatial", "occlusion_spatial_embedding_parameter"),
        ("image_encoder.trunk.pos_embed_window", "vision_encoder.backbone.pos_embed_window"),
        ("image_encoder.trunk.patch_embed.proj.weight", "vision_encoder.backbone.patch_embed.projection.weight"),
        ("image_encoder.trunk.blocks.0.attn.qkv.weight", "vision_encoder.backbone.blocks.0.attn.qkv.weight"),
        ("image_encoder.trunk.blocks.0.attn.proj.bias", "vision_encoder.backbone.blocks.0.attn.proj.bias"),
        ("image_encoder.trunk.blocks.3.norm2.bias", "vision_encoder.backbone.blocks.3.layer_norm2.bias"),
        ("image_encoder.trunk.blocks.10.mlp.layers.1.weight", "vision_encoder.backbone.blocks.10.mlp.proj_out.weight"),
        ("image_encoder.neck.convs.2.conv.bias", "vision_encoder.neck.convs.2.bias"),
        ("memory_attention.layers.0.self_attn.q_proj.weight", "memory_attention.layers.0.self_attn.q_proj.weight"),
        (
            "memory_attention.layers.3.cross_attn_image.out_proj.bias",
            "memory_attention.layers.3.cross_attn_image.o_proj.bias",
        ),
        ("memory_attention.norm.weight", "memory_attention.layer_norm.weight"),
        (
            "memory_encoder.mask_downsampler.encoder.4.weight",
            "memory_encoder.mask_downsampler.layers.1.layer_norm.weight",
        ),
        ("memory_encoder.mask_downsampler.encoder.9.bias", "memory_encoder.mask_downsampler.layers.3.conv.bias"),
        ("memory_encoder.mask_downsampler.encoder.12.bias", "memory_encoder.mask_downsampler.final_conv.bias"),
        ("memory_encoder.fuser.layers.1.gamma", "memory_encoder.memory_fuser.layers.1.scale"),
        ("memory_encoder.fuser.layers.0.pwconv2.bias", "memory_encoder.memory_fuser.layers.0.pointwise_conv2.bias"),
        ("memory_encoder.fuser.layers.0.norm.bias", "memory_encoder.memory_fuser.layers.0.layer_norm.bias"),
        ("memory_encoder.out_proj.weight", "memory_encoder.projection.weight"),
        ("sam_prompt_encoder.mask_downscaling.4.weight", "prompt_encoder.mask_embed.layer_norm2.weight"),
        ("sam_mask_decoder.transformer.layers.1.norm4.weight", "mask_decoder.transformer.layers.1.layer_norm4.weight"),
        (
            "sam_mask_decoder.transformer.layers.0.mlp.layers.0.bias",
            "mask_decoder.transformer.layers.0.mlp.proj_in.bias",
        ),
        ("sam_mask_decoder.transformer.norm_final_attn.bias", "mask_decoder.transformer.layer_norm_final_attn.bias"),
        ("sam_mask_decoder.output_upscaling.3.bias", "mask_decoder.upscale_conv2.bias"),
        (
            "sam_mask_decoder.output_hypernetworks_mlps.2.layers.1.bias",
            "mask_decoder.output_hypernetworks_mlps.2.layers.0.bias",
        ),
        ("sam_mask_decoder.iou_prediction_head.layers.2.bias", "mask_decoder.iou_prediction_head.proj_out.bias"),
        ("sam_mask_decoder.pred_obj_score_head.layers.0.weight", "mask_decoder.pred_obj_score_head.proj_in.weight"),
        ("sam_mask_decoder.conv_s1.weight", "mask_decoder.conv_s1.weight"),
        ("obj_ptr_proj.layers.1.weight", "object_pointer_proj.layers.0.weight"),
        ("obj_ptr_tpos_proj.bias", "temporal_positional_encoding_projection_layer.bias"),
    ],
)
def test_names_of_the_repository_become_those_of_the_library(name: str, becomes: str) -> None:
    from surgbench.trackers.masks.sam2_video.original import converted_name

    assert converted_name(name) == becomes
    assert name in original("tiny", True)


# The way back, for a small network of which no original is.
BACK = (
    (r"^memory_temporal_positional_encoding$", "maskmem_tpos_enc"),
    (r"^no_memory_embedding$", "no_mem_embed"),
    (r"^no_memory_positional_encoding$", "no_mem_pos_enc"),
    (r"^no_object_pointer$", "no_obj_ptr"),
    (r"^occlusion_spatial_embedding_parameter$", "no_obj_embed_spatial"),
    (r"^temporal_positional_encoding_projection_layer", "obj_ptr_tpos_proj"),
    (r"shared_embedding.positional_embedding", "pe_layer.positional_encoding_gaussian_matrix"),
    (r"^vision_encoder.backbone", "image_encoder.trunk"),
    (r"patch_embed.projection", "patch_embed.proj"),
    (r"^vision_encoder.neck.convs.(\d)", r"image_encoder.neck.convs.\1.conv"),
    (r"^memory_encoder.projection", "memory_encoder.out_proj"),
    (r"feature_projection", "pix_feat_proj"),
    (r"memory_fuser(.*)layer_norm", r"fuser\1norm"),
    (r"memory_fuser", "fuser"),
    (r"(fuser.*)scale", r"\1gamma"),
    (r"depthwise_conv", "dwconv"),
    (r"pointwise_conv", "pwconv"),
    *((rf"mask_downsampler.layers.{step}.conv", f"mask_downsampler.encoder.{3 * step}") for step in range(4)),
    *((rf"mask_downsampler.layers.{step}.layer_norm", f"mask_downsampler.encoder.{3 * step + 1}") for step in range(4)),
    (r"final_conv", "encoder.12"),
    (r"mask_embed.conv1", "mask_downscaling.0"),
    (r"mask_embed.layer_norm1", "mask_downscaling.1"),
    (r"mask_embed.conv2", "mask_downscaling.3"),
    (r"mask_embed.layer_norm2", "mask_downscaling.4"),
    (r"mask_embed.conv3", "mask_downscaling.6"),
    (r"upscale_conv1", "output_upscaling.0"),
    (r"upscale_layer_norm", "output_upscaling.1"),
    (r"upscale_conv2", "output_upscaling.3"),
    (r"layer_norm", "norm"),
    (r"^prompt_encoder", "sam_prompt_encoder"),
    (r"^mask_decoder", "sam_mask_decoder"),
    (r"^object_pointer_proj", "obj_ptr_proj"),
    (r"o_proj", "out_proj"),
    (r"((?:head|mlps.\d|obj_ptr_proj)).layers.0", r"\1.layers.1"),
    (r"((?:head|mlps.\d|obj_ptr_proj)).proj_out", r"\1.layers.2"),
    (r"proj_out", "layers.1"),
    (r"proj_in", "layers.0"),
)


def as_original(network: Any) -> dict[str, Any]:
    """A network's tensors as the repository would have named them."""
    tensors: dict[str, Any] = {}
    for name, value in network.state_dict().items():
        if name == "shared_image_embedding.positional_embedding":
            continue
        if name == "prompt_encoder.point_embed.weight":
            points = {f"sam_prompt_encoder.point_embeddings.{i}.weight": value[i : i + 1].clone() for i in range(4)}
            tensors |= points
            continue
        for pattern, old in BACK:
            name = re.sub(pattern, old, name)
        tensors[name] = value.clone()
    return tensors


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint of a tiny network in the original layout, whose size is that of ``--config tiny`` here."""
    network = tiny_network("sam2_video", seed=3)
    torch.save({"model": as_original(network)}, tmp_path / "tiny.pt")
    settings = network.config
    monkeypatch.setattr(
        "surgbench.trackers.masks.sam2_video.original.video_config", lambda size, side, tensors: settings
    )
    return tmp_path / "tiny.pt"


def test_a_converted_network_is_the_same_one(checkpoint: Path, tmp_path: Path) -> None:
    from surgbench.trackers.masks.sam2_video.checkpoint import load_network
    from surgbench.trackers.masks.sam2_video.objects import VideoObjects

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "model.safetensors").write_bytes(b"interrupted before there was a configuration")
    surgbench("convert", "sam2", checkpoint, "--config", "tiny", "--out", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "model.safetensors"]
    converted, network = load_network(tmp_path / "out", "", "cpu", None), tiny_network("sam2_video", seed=3)
    for name, value in network.state_dict().items():
        assert torch.equal(value, converted.state_dict()[name]), name
    images = np.random.default_rng(0).integers(0, 255, (3, 40, 50, 3), dtype=np.uint8)
    found = []
    for one in (converted, network):
        objects = VideoObjects(one, 40, 50)
        objects.prompt(np.array([[20.0, 15.0], [3.0, 3.0]]), np.array([True, False]))
        found.append(np.array([objects.step(image).logits for image in images]))
    assert np.ptp(found[0]) > 0
    # To the last digits: how a sum is taken depends on where in memory its terms lie.
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stranger.weight": torch.zeros(1)}, "'stranger.weight' is no tensor of this architecture and size"),
        ({"no_mem_embed": None}, "the tensor that becomes 'no_memory_embedding' is missing"),
        ({"sam_prompt_encoder.point_embeddings.2.weight": None}, "point_embeddings.2.weight' is missing"),
        ({"sam_prompt_encoder.point_embeddings.1.weight": torch.zeros(1, 3)}, "is of shape (1, 3), not (1, 128) as"),
        ({"obj_ptr_proj.layers.1.bias": torch.zeros(3)}, "'obj_ptr_proj.layers.1.bias' is of shape (3,), not (128,)"),
        ({"maskmem_tpos_enc": "text"}, "holds no tensors by name"),
    ],
)
def test_tensors_that_do_not_fit_are_named(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], message: str
) -> None:
    tensors = {**torch.load(checkpoint, weights_only=True)["model"], **change}
    torch.save({name: value for name, value in tensors.items() if value is not None}, checkpoint)
    surgbench("convert", "sam2", checkpoint, "--config", "tiny", "--out", tmp_path / "out", expect=2)
    said = capsys.readouterr().err
    assert said.startswith(f"surgbench: {checkpoint}: ")
    assert said.count("\n") == 1
    assert message in said
    assert not (tmp_path / "out").exists()


class Hostile:
    """Pickled, it touches a file when it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_nothing_that_is_pickled_runs(tmp_path: Path) -> None:
    from surgbench.trackers.masks.sam2_video.original import read_original

    torch.save({"model": Hostile(tmp_path / "touched")}, tmp_path / "hostile.pt")
    with pytest.raises(ConfigError, match=r"hostile.pt: damaged, or it holds more than tensors"):
        read_original(tmp_path / "hostile.pt")
    assert not (tmp_path / "touched").exists()
    pickle.loads(pickle.dumps(Hostile(tmp_path / "touched")))
    assert (tmp_path / "touched").exists()  # or the test would show nothing


def test_files_that_are_no_checkpoint_are_named(checkpoint: Path, tmp_path: Path) -> None:
    from surgbench.trackers.masks.sam2_video.original import read_original

    cut = tmp_path / "cut.pt"
    for data in (checkpoint.read_bytes()[:100_000], b"", b"no checkpoint", b"PK\x03\x04"):
        cut.write_bytes(data)
        with pytest.raises(ConfigError, match=r"cut.pt: damaged") as caught:
            read_original(cut)
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"nowhere.pt: no such file"):
        read_original(tmp_path / "nowhere.pt")


def test_other_squares_have_other_features() -> None:
    from surgbench.trackers.masks.sam2_video.original import convert, video_config

    tensors = original("small", True)
    config = video_config("small", 512, tensors)  # Surgical SAM 2's
    assert config.vision_config.backbone_feature_sizes == [[128, 128], [64, 64], [32, 32]]
    assert list(config.memory_attention_rope_feat_sizes) == [32, 32]
    assert config.prompt_encoder_config.image_size == config.image_size == 512
    assert len(convert(tensors, config, "small.pt")) > 400
    with pytest.raises(ConfigError, match="--image-size: must be a multiple of 32"):
        video_config("small", 500, tensors)


def test_a_folder_that_holds_something_is_left_alone(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine", encoding="utf-8")
    surgbench("convert", "sam2", checkpoint, "--config", "tiny", "--out", tmp_path / "out", expect=2)
    assert "holds something else ('mine.txt'); --out needs a new or empty folder" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]
