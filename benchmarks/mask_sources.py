"""Sources of masks against what truly shows: ``python benchmarks/mask_sources.py DATASET... --masks NAME...``.

Of each source and dataset the intersection over union with the visible truth, mean, worst and by sequence, and
milliseconds of process time a frame; ``reset`` and the reading of images are not counted. ``--arms dual`` shows scenes
the pair, ``single`` each arm of it alone. ``--points`` gives prompts drawn from the truth of the first frame.
``--prior PX`` begins each frame's search at the true state moved by so many pixels to the right; without it there is no
estimate. ``--real DIR`` takes a folder of single frames, each a sequence of its own: ``camera.json``, ``images/*.png``
and ``masks/*.png`` of the same names, white being the one instrument. The picture has a row for each source: its worst
frames, no two of a sequence, the truth's outline green and the source's red.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera.files import read_camera
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.dataset.masks import read_image, read_mask
from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.mask_sources import FoundMasks, MaskSource, Prompts
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.state import STATE_SIZE, split_arms
from surgbench.suite.suites import parse_sets
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.made_masks import with_images_read
from surgbench.tasks.instrument.units import UnitData

GREEN, RED = (0, 255, 0), (255, 0, 0)
INSTRUMENT = "large_needle_driver"
POINTS = 3  # of each kind, where prompts are drawn
SHOWN_PX = 420


@dataclass(frozen=True)
class Clip:
    """Consecutive frames with their truth.

    Attributes:
        id: Of the sequence.
        scene: Its constants.
        frames: Each one's observation, and what truly shows of each of the scene's arms.
    """

    id: str
    scene: Scene
    frames: Iterator[tuple[Observation, tuple[Mask, ...]]]


@dataclass(frozen=True)
class Result:
    """What a source made of a frame."""

    data: str
    clip: str
    frame: int
    iou: float
    spent_ms: float
    picture: NDArray[np.uint8]


def main() -> int:
    """Print the table of each source, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="*", type=Path)
    parser.add_argument("--real", type=Path, action="append", default=[], help="a folder of single frames")
    parser.add_argument("--masks", action="append", required=True, help="a source's name; may be repeated")
    parser.add_argument("--set", action="append", default=[], help="NAME.option=value; may be repeated")
    parser.add_argument("--arms", choices=("dual", "single"), default="dual")
    parser.add_argument("--frames", type=int, help="no more of each sequence")
    parser.add_argument("--points", action="store_true", help="prompts from the first frame's truth")
    parser.add_argument("--prior", type=float, help="the state is known, but for so many pixels")
    parser.add_argument("--out", type=Path, help="a picture of the worst frames")
    parser.add_argument("--worst", type=int, default=3, help="how many")
    options = parser.parse_args()
    settings = parse_sets(options.set)
    rows = []
    print("| source | data | mean | worst | ms | by sequence |\n|---|---|---|---|---|---|")
    for name in options.masks:
        every: list[Result] = []
        for path in [*options.dataset, *options.real]:
            clips = real_clips(path) if path in options.real else dataset_clips(path, options.arms, options.prior)
            source = create(find("mask_source", name), settings.get(name, {}))
            found = [one for clip in clips for one in run(source, path.name, clip, options.frames, options.points)]
            print(f"| `{name}` | {path.name} | {summary(found)} |", flush=True)
            every += found
        rows.append(worst_of(every, options.worst))
    if options.out is not None:
        draw(rows, options.out)
    return 0


def dataset_clips(path: Path, arms: Literal["dual", "single"], prior_px: float | None) -> Iterator[Clip]:
    """The sequences of a dataset, or those of each arm."""
    dataset = open_as(InstrumentDataset, path)
    for unit in dataset.units(arms):
        data = UnitData(dataset, unit, "none")
        yield Clip(unit.id, data.scene(), _frames(data, unit, prior_px))


def _frames(
    data: UnitData, unit: InstrumentUnit, prior_px: float | None
) -> Iterator[tuple[Observation, tuple[Mask, ...]]]:
    for frame in range(data.frames):
        shown = tuple(data.sequence.clean_mask(f"visible_{arm}", frame) for arm in unit.arms)
        start = np.zeros(STATE_SIZE * len(unit.arms))
        if prior_px is not None:
            assert data.truth is not None
            start = data.truth[frame].ravel().copy()
            split_arms(start)[:, 3] += prior_px / data.camera.fx * split_arms(start)[:, 5]
        yield with_images_read(replace(data.observation(frame), start=start)), shown


def real_clips(folder: Path) -> Iterator[Clip]:
    """Single frames, each a sequence of its own."""
    camera, instrument = read_camera(folder / "camera.json"), load_instrument(INSTRUMENT)
    paths = sorted((folder / "images").glob("*.png"))
    if not paths:
        raise DatasetError(f"{folder / 'images'}: holds no PNG files")
    for path in paths:
        image = read_image(path, camera.width, camera.height)
        mask = read_mask(folder / "masks" / path.name, camera.width, camera.height)
        view = View(camera, np.eye(4), np.zeros_like(mask), image=partial(np.asarray, image))
        scene = Scene((instrument,), (view,), (instrument.search_limits,), 1 / 30, 1)
        yield Clip(path.stem, scene, iter([(Observation(0, 0.0, (view,), np.zeros(STATE_SIZE)), (mask,))]))


def run(source: MaskSource, data: str, clip: Clip, most: int | None, points: bool) -> Iterator[Result]:
    """What a source makes of a clip."""
    for number, (observation, shown) in enumerate(clip.frames):
        if number == most:
            break
        view = observation.views[0]
        image = view.image()
        if image is None:
            raise DatasetError(f"sequence '{clip.id}' has no images")
        if number == 0:
            source.reset(clip.scene, view, prompts_of(shown, clip.id) if points else None)
        begin = time.process_time()
        found = source.segment(observation, view)
        spent_ms = 1e3 * (time.process_time() - begin)
        mask, truth = found.mask if isinstance(found, FoundMasks) else found, np.any(shown, axis=0)
        union = np.count_nonzero(mask | truth)
        share = np.count_nonzero(mask & truth) / union if union else 1.0
        picture = outlined(image, truth, mask, f"{data} {clip.id}, frame {number}: {share:.3f}")
        yield Result(data, clip.id, number, share, spent_ms, picture)


def prompts_of(shown: tuple[Mask, ...], clip: str) -> Prompts:
    """Points well inside each arm, and as many well outside all of them."""
    rng = generator(benchmark="mask_sources", clip=clip)
    beside = ~np.any(shown, axis=0)
    points: list[FloatArray] = []
    for own in shown:
        both = []
        for mask in (own, beside):
            depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
            v, u = np.nonzero(depth >= 0.5 * depth.max()) if mask.any() else (np.zeros(0), np.zeros(0))
            taken = rng.permutation(len(v))[:POINTS]
            both.append(np.stack([u[taken], v[taken]], axis=1).astype(np.float64))
        points.append(np.concatenate(both))
    inside = [np.array([bool(own[int(v), int(u)]) for u, v in some]) for own, some in zip(shown, points, strict=True)]
    return Prompts(points, inside)


def worst_of(found: list[Result], count: int) -> list[Result]:
    """The worst frames, no two of one sequence."""
    of_each: dict[tuple[str, str], Result] = {}
    for one in sorted(found, key=lambda one: one.iou):
        of_each.setdefault((one.data, one.clip), one)
    return list(of_each.values())[:count]


def summary(found: list[Result]) -> str:
    """A row's numbers."""
    shares = np.array([one.iou for one in found])
    clips = list(dict.fromkeys(one.clip for one in found))
    each = ", ".join(f"{clip} {np.mean([one.iou for one in found if one.clip == clip]):.3f}" for clip in clips)
    spent = np.mean([one.spent_ms for one in found])
    return f"{shares.mean():.3f} | {shares.min():.3f} | {spent:.1f} | {each}"


def outlined(image: NDArray[np.uint8], truth: Mask, mask: Mask, text: str) -> NDArray[np.uint8]:
    """A small picture of a frame with both outlines."""
    scale = SHOWN_PX / image.shape[1]
    size = SHOWN_PX, round(image.shape[0] * scale)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    for one, colour in ((truth, GREEN), (mask, RED)):
        shown = cv2.resize(one.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
        lines, _ = cv2.findContours(shown, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(small, lines, -1, colour, 1)
    cv2.putText(small, text, (6, size[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(small, np.uint8)


def draw(rows: list[list[Result]], out: Path) -> None:
    """A row of pictures for each source."""
    pictures = [one.picture for row in rows for one in row]
    height, columns = max(one.shape[0] for one in pictures), max(len(row) for row in rows)
    sheet = np.zeros((height * len(rows), SHOWN_PX * columns, 3), np.uint8)
    for r, row in enumerate(rows):
        for c, one in enumerate(row):
            high, wide = one.picture.shape[:2]
            sheet[r * height : r * height + high, c * SHOWN_PX : c * SHOWN_PX + wide] = one.picture
    if not cv2.imwrite(str(out), sheet[..., ::-1]):
        raise DatasetError(f"{out}: cannot be written")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
