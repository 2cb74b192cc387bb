"""COCO of videos: objects that are followed from image to image, and the layout of YouTube-VIS."""

from __future__ import annotations

from typing import Any

# What others call the number of an object that stays the same from image to image.
TRACK_KEYS = ("track_id", "instance_id", "object_id")
_VIDEO, _OF_FRAMES, _NAMES = "video_id", "segmentations", "file_names"


def by_images(content: Any) -> Any:
    """A dataset of YouTube-VIS as one of COCO, in which each object is there once per image; others as they are.

    There an object is one annotation with ``segmentations`` of all frames of its video, and a video names its frames.
    What follows it from image to image is its ``id``, which becomes the ``track_id``.

    Raises:
        ValueError: An object is of another number of frames than its video, or of none; one line.
        KeyError: Something is missing.

    Example:
        >>> from surgbench.recordings.coco_video import by_images
        >>> rle = {"size": [1, 2], "counts": [1, 1]}
        >>> videos = [{"id": 3, "file_names": ["a/0.png", "a/5.png"], "width": 2, "height": 1}]
        >>> objects = [{"id": 7, "video_id": 3, "category_id": 1, "segmentations": [None, rle]}]
        >>> made = by_images({"videos": videos, "annotations": objects})
        >>> [one["file_name"] for one in made["images"]], [one["track_id"] for one in made["annotations"]]
        (['a/0.png', 'a/5.png'], [7])
    """
    if not isinstance(content, dict) or "images" in content or not isinstance(content.get("videos"), list):
        return content
    images: list[dict[str, Any]] = []
    of_video: dict[Any, list[dict[str, Any]]] = {}
    for video in content["videos"]:
        size = {key: video[key] for key in ("width", "height") if key in video}
        of_video[video["id"]] = [
            {"id": len(images) + place, "file_name": name, _VIDEO: video["id"], **size}
            for place, name in enumerate(video[_NAMES])
        ]
        images += of_video[video["id"]]
    annotations: list[dict[str, Any]] = []
    for one in content["annotations"]:
        frames = of_video.get(one[_VIDEO])
        if frames is None or len(one[_OF_FRAMES]) != len(frames):
            there = "is not there" if frames is None else f"has {len(frames)} frames"
            raise ValueError(
                f"annotation {one.get('id')}: {len(one[_OF_FRAMES])} segmentations, and its video {one[_VIDEO]} {there}"
            )
        annotations += [
            {
                "id": len(annotations) + place,
                "image_id": frame["id"],
                "category_id": one["category_id"],
                "track_id": one["id"],
                "segmentation": segmentation,
            }
            for place, (frame, segmentation) in enumerate(zip(frames, one[_OF_FRAMES], strict=True))
            if segmentation
        ]
    return {**content, "images": images, "annotations": annotations}
