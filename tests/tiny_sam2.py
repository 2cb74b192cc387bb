"""Tiny networks of SAM 2's kind with random weights, as folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

SIDE_PX = 128
_CHANNELS = 128  # of all that follows the image encoder; twice what the library fixes a mask's memory at


def tiny_config(kind: str) -> Any:
    """The configuration of a network of 0.9 million weights: three frames of masks and four of pointers remembered."""
    import transformers

    features = [[SIDE_PX // stride] * 2 for stride in (4, 8, 16)]
    vision = {
        "model_type": "sam2_vision_model",
        "backbone_config": {
            "model_type": "sam2_hiera_det_model",
            "hidden_size": 8,
            "image_size": [SIDE_PX, SIDE_PX],
            "blocks_per_stage": [1, 1, 2, 1],
            "embed_dim_per_stage": [8, 16, 32, 64],
            "num_attention_heads_per_stage": [1, 1, 2, 2],
            "window_size_per_stage": [4, 4, 4, 4],
            "global_attention_blocks": [3],
            "window_positional_embedding_background_size": [4, 4],
        },
        "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": features,
        "fpn_hidden_size": _CHANNELS,
    }
    decoder = {"hidden_size": _CHANNELS, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    settings: dict[str, Any] = {
        "vision_config": vision,
        "prompt_encoder_config": {"hidden_size": _CHANNELS, "image_size": SIDE_PX},
        "mask_decoder_config": decoder,
        "image_size": SIDE_PX,
        "num_maskmem": 3,
        "max_object_pointers_in_encoder": 4,
        "memory_attention_hidden_size": _CHANNELS,
        "memory_attention_num_layers": 1,
        "memory_attention_rope_feat_sizes": features[-1],
        "memory_encoder_hidden_size": _CHANNELS,
        "memory_encoder_output_channels": 64,
        "mask_downsampler_embed_dim": _CHANNELS,
        "memory_fuser_embed_dim": _CHANNELS,
        "memory_fuser_intermediate_dim": 32,
    }
    if kind == "sam2_video":
        return transformers.Sam2VideoConfig(memory_attention_feed_forward_hidden_size=32, **settings)
    return transformers.EdgeTamVideoConfig(
        memory_attention_mlp_hidden_size=32,
        memory_attention_rope_k_sizes=[4, 4],
        perceiver_resampler_num_latents=16,
        perceiver_resampler_num_latents_2d=16,
        perceiver_resampler_mlp_intermediate_size=16,
        **settings,
    )


def tiny_network(kind: str, seed: int = 0, presence: float = 4.0) -> Any:
    """A network whose weights are large enough for pictures, prompts and memories to matter.

    Args:
        kind: ``sam2_video`` or ``edgetam_video``.
        seed: Of the weights.
        presence: Mean logit of an object's being there.
    """
    import torch
    import transformers

    name = {"sam2_video": "Sam2VideoModel", "edgetam_video": "EdgeTamVideoModel"}[kind]
    network = getattr(transformers, name)(tiny_config(kind)).eval()
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for key, value in network.state_dict().items():
            inputs = value[0].numel() if value.dim() > 1 and key.endswith(".weight") else 1
            if "norm" not in key:
                value.copy_(torch.randn(value.shape, generator=draw) * (2.0 / inputs) ** 0.5)
        network.prompt_encoder.shared_embedding.positional_embedding.copy_(
            network.shared_image_embedding.positional_embedding
        )
        score = network.mask_decoder.pred_obj_score_head.proj_out
        score.weight.mul_(0.1)
        score.bias.fill_(presence)
    return network


def write_tiny(folder: Path, kind: str, seed: int = 0, presence: float = 4.0) -> None:
    """A checkpoint of :func:`tiny_network`."""
    tiny_network(kind, seed, presence).save_pretrained(folder)
