"""Objects of one video, prompted on its first frame and followed from one frame to the next.

The steps are those of the transformers library's ``Sam2VideoProcessor``, which itself needs torchvision: the picture is
resized to the network's square (bilinear, antialiased, rounded to 8 bits) and normalised with ImageNet's mean and
standard deviation, points are scaled like the picture, and the logits of the masks, which come at a quarter of the
square's resolution, are resized to the picture's (bilinear).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import transformers
from numpy.typing import NDArray
from torch.nn import functional

from surgbench.geometry import FloatArray
from surgbench.processes.torch_threads import one_thread

MEAN, STANDARD_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# What is kept of a frame only as long as masks of the frames near it are remembered.
_MASK_MEMORY = ("maskmem_features", "maskmem_pos_enc")
# What is of no use once the frame has been dealt with.
_SPENT = ("high_res_masks", "pred_masks")


@dataclass(frozen=True)
class FoundObjects:
    """What there is of the objects in a frame.

    Attributes:
        logits: ``(objects, height, width)`` above 0 where the object is rather than not.
        presence: ``(objects,)`` how likely it is that the object shows at all, 0 to 1.
        overlap: ``(objects,)`` which intersection over union the network expects of its mask, 0 to 1.
    """

    logits: NDArray[np.float32]
    presence: FloatArray
    overlap: FloatArray


class VideoObjects:
    """The objects of one video.

    What is remembered of frames does not grow with their number: of the prompted one all that is used, of the last
    ``num_maskmem - 1`` their masks' features, of the last ``max_object_pointers_in_encoder - 1`` a vector for each
    object.

    Args:
        network: A ``Sam2VideoModel`` or ``EdgeTamVideoModel``.
        height: Of the pictures.
        width: Likewise.
        memory_device: Where the memory is kept; with the network unless told.
    """

    def __init__(self, network: Any, height: int, width: int, memory_device: str | None = None) -> None:
        session = getattr(transformers, type(network).__name__.replace("Model", "InferenceSession"))
        self._network, self._size = network, (height, width)
        self._session: Any = session(
            video_height=height,
            video_width=width,
            inference_device=network.device,
            inference_state_device=memory_device or network.device,
            video_storage_device=network.device,
            dtype=network.dtype,
        )
        self._frame = 0

    def prompt(self, points_px: FloatArray, inside: NDArray[np.bool_]) -> None:
        """Add an object, before the first frame.

        Args:
            points_px: ``(n, 2)`` pixels (u, v) of the first frame.
            inside: ``(n,)`` whether a point is on the object.
        """
        side, (height, width) = self._network.image_size, self._size
        scaled = np.asarray(points_px, dtype=np.float32) * np.array([side / width, side / height], dtype=np.float32)
        object_id = self._session.get_obj_num()
        self._session.add_point_inputs(
            self._session.obj_id_to_idx(object_id),
            0,
            {
                "point_coords": torch.from_numpy(scaled)[None, None],
                "point_labels": torch.from_numpy(np.asarray(inside, dtype=np.int32))[None, None],
            },
        )
        self._session.obj_with_new_inputs = [*self._session.obj_with_new_inputs, object_id]

    def step(self, image: NDArray[np.uint8]) -> FoundObjects:
        """The next frame, ``(height, width, 3)`` RGB."""
        pixels = network_input(image, self._network.image_size, self._network.device)
        overlaps: list[torch.Tensor] = []
        # The network chooses among its masks by this, but does not tell.
        hook = self._network.mask_decoder.register_forward_hook(lambda *call: overlaps.append(call[2][1].max()))
        try:
            with one_thread():  # so that a run made again gives the same masks
                output = self._network(inference_session=self._session, frame_idx=self._frame, frame=pixels)
        finally:
            hook.remove()
        logits = functional.interpolate(output.pred_masks.float(), self._size, mode="bilinear", align_corners=False)
        self._forget()
        self._frame += 1
        return FoundObjects(
            logits[:, 0].cpu().numpy(),
            torch.sigmoid(output.object_score_logits.double().flatten()).cpu().numpy(),
            torch.stack(overlaps).double().clamp(0, 1).cpu().numpy(),
        )

    def _forget(self) -> None:
        """Drop what the next frame and those after it do not look at, which the library keeps for ever."""
        session, network = self._session, self._network
        session.processed_frames.clear()
        pointers = network.config.max_object_pointers_in_encoder
        for index, outputs in session.output_dict_per_obj.items():
            for of_frame in (*outputs["cond_frame_outputs"].values(), *outputs["non_cond_frame_outputs"].values()):
                for key in _SPENT:
                    of_frame.pop(key, None)
            followed = outputs["non_cond_frame_outputs"]
            for frame in list(followed):
                age = self._frame + 1 - frame
                if age >= network.num_maskmem:
                    for key in _MASK_MEMORY:
                        followed[frame].pop(key, None)
                if age >= max(pointers, network.num_maskmem):
                    del followed[frame]
                    session.frames_tracked_per_obj[index].pop(frame, None)


def network_input(image: NDArray[np.uint8], side: int, device: torch.device | str) -> torch.Tensor:
    """A picture as the network takes it, ``(1, 3, side, side)``."""
    pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float()
    pixels = functional.interpolate(pixels, (side, side), mode="bilinear", align_corners=False, antialias=True)
    pixels = pixels.round().clamp(0, 255) / 255
    mean, deviation = (torch.tensor(each, device=device)[None, :, None, None] for each in (MEAN, STANDARD_DEVIATION))
    return (pixels - mean) / deviation
