"""Checkpoints of SAM 2's own repository, and of Surgical SAM 2, in the layout of the transformers library.

Both hold the same tensors under other names: https://github.com/facebookresearch/sam2 against transformers' class
``Sam2VideoModel``. SAM 2.1 has two more than SAM 2, which say what its configuration is.
"""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
import transformers
from safetensors.torch import save

from surgbench.errors import ConfigError
from surgbench.files import write_atomic
from surgbench.trackers.masks.sam2_video.checkpoint import CONFIG, WEIGHTS

Size = Literal["tiny", "small", "base-plus", "large"]
Tensors = dict[str, torch.Tensor]

# Of the image encoder (Hiera), as the repository's sam2_hiera_{t,s,b+,l}.yaml have it: channels of the first of four
# stages, which each stage doubles; blocks of each stage; blocks that see the whole picture; background of the windows'
# position; heads of the first stage, doubled likewise; windows of each stage.
_ENCODERS: dict[str, tuple[int, list[int], list[int], int, int, list[int]]] = {
    "tiny": (96, [1, 2, 7, 2], [5, 7, 9], 7, 1, [8, 4, 14, 7]),
    "small": (96, [1, 2, 11, 2], [7, 10, 13], 7, 1, [8, 4, 14, 7]),
    "base-plus": (112, [2, 3, 16, 3], [12, 16, 20], 14, 2, [8, 4, 14, 7]),
    "large": (144, [2, 6, 36, 4], [23, 33, 43], 7, 2, [8, 4, 16, 8]),
}
# The picture's side over that of the features that masks are remembered at.
_STRIDE = 16
# In SAM 2.1 alone: where frames are in time is known of object pointers, and of objects that they are hidden.
_POINTERS_IN_TIME, _HIDDEN = "obj_ptr_tpos_proj.weight", "no_obj_embed_spatial"
_POINTS = 4
_POINT = "sam_prompt_encoder.point_embeddings.{}.weight"
_ALL_POINTS = "prompt_encoder.point_embed.weight"
_GRID = "prompt_encoder.shared_embedding.positional_embedding"
_GRID_AGAIN = "shared_image_embedding.positional_embedding"

# Layers of a perceptron.
_MLP_OF_THREE = {"0": "proj_in", "1": "layers.0", "2": "proj_out"}
_MLP_OF_TWO = {"0": "proj_in", "1": "proj_out"}
# Whole names.
_SAME = {
    "maskmem_tpos_enc": "memory_temporal_positional_encoding",
    "no_mem_embed": "no_memory_embedding",
    "no_mem_pos_enc": "no_memory_positional_encoding",
    "no_obj_ptr": "no_object_pointer",
    _HIDDEN: "occlusion_spatial_embedding_parameter",
    "sam_prompt_encoder.pe_layer.positional_encoding_gaussian_matrix": _GRID,
}
# Beginnings of names; the first that fits counts.
_MODULES = (
    ("image_encoder.trunk.patch_embed.proj.", "vision_encoder.backbone.patch_embed.projection."),
    ("image_encoder.trunk.", "vision_encoder.backbone."),
    ("image_encoder.neck.", "vision_encoder.neck."),
    ("sam_prompt_encoder.mask_downscaling.0.", "prompt_encoder.mask_embed.conv1."),
    ("sam_prompt_encoder.mask_downscaling.1.", "prompt_encoder.mask_embed.layer_norm1."),
    ("sam_prompt_encoder.mask_downscaling.3.", "prompt_encoder.mask_embed.conv2."),
    ("sam_prompt_encoder.mask_downscaling.4.", "prompt_encoder.mask_embed.layer_norm2."),
    ("sam_prompt_encoder.mask_downscaling.6.", "prompt_encoder.mask_embed.conv3."),
    ("sam_prompt_encoder.", "prompt_encoder."),
    ("sam_mask_decoder.output_upscaling.0.", "mask_decoder.upscale_conv1."),
    ("sam_mask_decoder.output_upscaling.1.", "mask_decoder.upscale_layer_norm."),
    ("sam_mask_decoder.output_upscaling.3.", "mask_decoder.upscale_conv2."),
    ("sam_mask_decoder.transformer.norm_final_attn.", "mask_decoder.transformer.layer_norm_final_attn."),
    ("sam_mask_decoder.", "mask_decoder."),
    ("memory_attention.norm.", "memory_attention.layer_norm."),
    ("memory_encoder.pix_feat_proj.", "memory_encoder.feature_projection."),
    ("memory_encoder.out_proj.", "memory_encoder.projection."),
    ("memory_encoder.fuser.", "memory_encoder.memory_fuser."),
    ("obj_ptr_proj.", "object_pointer_proj."),
    ("obj_ptr_tpos_proj.", "temporal_positional_encoding_projection_layer."),
)


def converted_name(name: str) -> str:
    """What a tensor of the original layout is called in transformers' one; what is unknown keeps its name."""
    if name in _SAME:
        return _SAME[name]
    for old, new in _MODULES:
        if name.startswith(old):
            name = new + name.removeprefix(old)
            break
    module = name.partition(".")[0]
    if module == "vision_encoder":
        name = re.sub(r"(neck\.convs\.\d+)\.conv\.", r"\1.", name)
    elif module == "memory_encoder":
        name = re.sub(r"mask_downsampler\.encoder\.(\d+)\.", _downsampler, name)
        name = re.sub(r"(memory_fuser\.layers\.\d+)\.gamma$", r"\1.scale", name)
        name = name.replace(".dwconv.", ".depthwise_conv.").replace(".pwconv", ".pointwise_conv")
    name = re.sub(r"\.mlp\.layers\.([01])\.", lambda found: f".mlp.{_MLP_OF_TWO[found[1]]}.", name)
    name = re.sub(
        r"((?:head|output_hypernetworks_mlps\.\d+|object_pointer_proj)\.)layers\.([012])\.",
        lambda found: f"{found[1]}{_MLP_OF_THREE[found[2]]}.",
        name,
    )
    name = re.sub(r"(layers|blocks)\.(\d+)\.norm(\d?)\.", r"\1.\2.layer_norm\3.", name)
    return name.replace(".out_proj.", ".o_proj.")


def _downsampler(found: re.Match[str]) -> str:
    """Four times convolution, normalisation and activation, and a last convolution."""
    layer, kind = divmod(int(found[1]), 3)
    if layer == 4 and kind == 0:
        return "mask_downsampler.final_conv."
    return f"mask_downsampler.layers.{layer}.{('conv', 'layer_norm', 'activation')[kind]}."


def video_config(size: Size, image_px: int, tensors: Mapping[str, torch.Tensor]) -> Any:
    """The ``Sam2VideoConfig`` of a checkpoint.

    Args:
        size: Of its image encoder.
        image_px: Side of the square that pictures are resized to: 1024 in SAM 2, 512 in Surgical SAM 2.
        tensors: Of the checkpoint: whether it is of SAM 2 or of SAM 2.1.

    Raises:
        ConfigError: Such a square cannot be divided as the network does.
    """
    if image_px < 64 or image_px % 32:
        raise ConfigError(f"--image-size: must be a multiple of 32, 64 at least, not {image_px}")
    channels, blocks, whole, background, heads, windows = _ENCODERS[size]
    stages = [channels * 2**stage for stage in range(4)]
    features = [image_px // 4, image_px // 8, image_px // _STRIDE]
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=channels,
        image_size=[image_px, image_px],
        num_attention_heads=heads,
        blocks_per_stage=blocks,
        embed_dim_per_stage=stages,
        num_attention_heads_per_stage=[heads * 2**stage for stage in range(4)],
        window_size_per_stage=windows,
        global_attention_blocks=whole,
        window_positional_embedding_background_size=[background, background],
    )
    return transformers.Sam2VideoConfig(
        vision_config=transformers.Sam2VisionConfig(
            backbone_config=backbone,
            backbone_channel_list=stages[::-1],
            backbone_feature_sizes=[[side, side] for side in features],
        ),
        prompt_encoder_config=transformers.Sam2VideoPromptEncoderConfig(image_size=image_px),
        mask_decoder_config=transformers.Sam2VideoMaskDecoderConfig(),
        image_size=image_px,
        memory_attention_rope_feat_sizes=[features[-1], features[-1]],
        enable_temporal_pos_encoding_for_object_pointers=_POINTERS_IN_TIME in tensors,
        enable_occlusion_spatial_embedding=_HIDDEN in tensors,
        architectures=["Sam2VideoModel"],
    )


def read_original(path: Path) -> Tensors:
    """The tensors of a checkpoint, pickled as the repository does; nothing of it is run.

    Raises:
        ConfigError: It cannot be read, or holds something else; one line.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; expected a checkpoint of SAM 2") from None
    except pickle.UnpicklingError:
        raise ConfigError(f"{path}: damaged, or it holds more than tensors, which might run anything") from None
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise ConfigError(f"{path}: damaged, or no checkpoint ({first})") from None
    tensors = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(tensors, dict) or not tensors or not all(map(torch.is_tensor, tensors.values())):
        raise ConfigError(f"{path}: holds no tensors by name, nor such under 'model'")
    return dict(tensors)


def convert(tensors: Mapping[str, torch.Tensor], config: Any, source: str) -> Tensors:
    """Rename a checkpoint's tensors.

    Args:
        tensors: By their original names.
        config: What they are the weights of.
        source: Where they are from, for messages.

    Returns:
        All that a ``Sam2VideoModel`` of the configuration has, in single precision, each with memory of its own.

    Raises:
        ConfigError: One is missing, unknown or of another shape; one line with its original name.
    """
    with torch.device("meta"):
        needed = {name: tuple(value.shape) for name, value in transformers.Sam2VideoModel(config).state_dict().items()}
    points = [_POINT.format(point) for point in range(_POINTS)]
    named = {converted_name(name): (name, value) for name, value in tensors.items() if name not in points}
    one_point = 1, needed[_ALL_POINTS][1]
    for name in points:
        if name not in tensors:
            raise ConfigError(f"{source}: '{name}' is missing")
        if tuple(tensors[name].shape) != one_point:
            raise _misshapen(source, name, tensors[name], one_point)
    named[_ALL_POINTS] = points[0], torch.cat([tensors[name] for name in points])
    if _GRID in named:
        named[_GRID_AGAIN] = named[_GRID]
    unknown = next((original for name, (original, _) in named.items() if name not in needed), None)
    if unknown is not None:
        raise ConfigError(f"{source}: '{unknown}' is no tensor of this architecture and size")
    for name, shape in needed.items():
        if name not in named:
            raise ConfigError(f"{source}: the tensor that becomes '{name}' is missing")
        if tuple(named[name][1].shape) != shape:
            raise _misshapen(source, *named[name], shape)
    return {name: named[name][1].to(torch.float32, copy=True).contiguous() for name in needed}


def _misshapen(source: str, name: str, value: torch.Tensor, shape: tuple[int, ...]) -> ConfigError:
    return ConfigError(f"{source}: '{name}' is of shape {tuple(value.shape)}, not {shape} as in this size")


def write_checkpoint(out: Path, tensors: Tensors, config: Any) -> None:
    """Write a checkpoint that transformers reads; its configuration, without which it is none, comes last."""
    write_atomic(out / WEIGHTS, save(tensors, {"format": "pt"}))
    text = json.dumps(config.to_dict() | {"dtype": "float32"}, indent=2, sort_keys=True)
    write_atomic(out / CONFIG, (text + "\n").encode())
