"""How well painted markers are found: ``python benchmarks/marker_detections.py DATASET [--every 5] [--png PNG]``.

Of each arm in turn the particle filter on images tracks a sequence from its true first state, with the noisy readings
of the dataset. What it finds is held against what shows: pieces of paint that lie within 0.3 mm of the nearest
surface at their pixel, of both arms, rendered from the true states. A marker shows where that is at least a quarter
of it as it is seen from straight above, and 12 pixels; its place is the middle of that part. Found markers farther
off than 8 px, or of markers that do not show at all, are false. Occluders are not known here.

The picture: found markers (rings in their colours), where markers truly show (white dots), the shaft's edges as
expected (grey) and as found (green), of the frame with the most markers and of that with the worst estimate.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench import open_dataset
from surgbench.camera import NEAR_M, Camera
from surgbench.generators.render import MaskRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.state import POSITION
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.units import UnitData
from surgbench.trackers.observations.lines import ShaftLines
from surgbench.trackers.observations.paint import encoded, hue_and_saturation, turned
from surgbench.trackers.observations.patches import LEAST_PX, Patches
from surgbench.trackers.particle_filter_markers import MarkerFilterTracker

# Of a marker as seen from straight above, what must show of it.
LEAST_SHOWN = 0.25
DEPTH_M, FALSE_PX = 3e-4, 8.0
LARGER = 2


class Seen:
    """Where markers truly show.

    Args:
        instrument: Of all arms.
        camera: Pinhole of square pixels.
    """

    def __init__(self, instrument: Instrument, camera: Camera) -> None:
        self._instrument, self._camera = instrument, camera
        self._renderer, self._patches = MaskRenderer([instrument], camera), Patches(instrument)
        across, down = np.meshgrid(np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy)
        self._cosines = 1.0 / np.sqrt(1.0 + (across**2 + down**2) / camera.fx**2)

    def of(self, state: FloatArray, arms: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """``(P, 2)`` middles of what shows of an arm's markers, and whether anything shows.

        Args:
            state: ``(9,)`` of the arm.
            arms: ``(n, 9)`` of all that may be in front.
        """
        along = [self._renderer.distance(one).astype(np.float64) for one in arms]
        depths = [np.where(one > 0, one * self._cosines + NEAR_M, np.inf) for one in along]
        nearest = np.min(depths, axis=0) + DEPTH_M
        shown = self._patches.shown(self._instrument.link_transforms(state), self._camera, nearest)
        enough = (shown.areas_px >= LEAST_PX) & (shown.shares >= LEAST_SHOWN)
        return np.where(enough[:, None], shown.places_px, np.nan), shown.areas_px > 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--every", type=int, default=5, help="frames in which truth is rendered")
    parser.add_argument("--frames", type=int, default=10**9, help="of each sequence, at most")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--png", type=Path)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset)
    assert isinstance(dataset, InstrumentDataset)
    tally = Tally()
    hues: defaultdict[str, list[float]] = defaultdict(list)
    tiles: dict[str, tuple[float, NDArray[np.uint8]]] = {}
    for unit in dataset.units("single"):
        data = UnitData(dataset, unit, "noisy")
        instrument, truth = data.instruments[0], data.truth
        per_arm = [data.sequence.states(arm) for arm in data.sequence.entry.arms]
        assert truth is not None
        seen = Seen(instrument, data.camera)
        tracker = MarkerFilterTracker(MarkerFilterTracker.Config(particles=arguments.particles))
        tracker.reset(data.scene(), truth[0, 0], np.random.default_rng(0))
        for frame in range(min(data.frames, arguments.frames)):
            observation = data.observation(frame)
            estimate = tracker.step(observation)
            if frame % arguments.every:
                continue
            arms = np.array([states[frame] for states in per_arm if states is not None])
            true_px, any_shows = seen.of(truth[frame, 0], arms)
            features = tracker.features[0]
            tally.add(instrument, true_px, any_shows, features.found[0])
            paint = features.finders[0].paint
            for number in np.flatnonzero(paint.seen):
                hues[instrument.spec.markers[number].name].append(float(paint.hues[number]))
            image = observation.views[0].image()
            if arguments.png is not None and image is not None:
                lines = None if features.lines is None else features.lines[0]
                off_m = float(np.linalg.norm(estimate.state[POSITION] - truth[frame, 0, POSITION]))
                for name, worth in (("best", float(np.isfinite(features.found[0][:, 0]).sum())), ("worst", off_m)):
                    if name not in tiles or worth > tiles[name][0]:
                        tiles[name] = worth, drawn(image, instrument, true_px, features.found[0], lines)
    tally.tell()
    tell_hues(instrument, hues)
    if arguments.png is not None:
        cv2.imwrite(str(arguments.png), np.hstack([tile for _, tile in tiles.values()])[..., ::-1])


class Tally:
    """Counts what is found, and measures how far off."""

    def __init__(self) -> None:
        self._counts: defaultdict[str, NDArray[np.int64]] = defaultdict(lambda: np.zeros(3, dtype=np.int64))
        self._off: list[float] = []

    def add(self, instrument: Instrument, true_px: FloatArray, any_shows: NDArray[np.bool_], found: FloatArray) -> None:
        """Of one arm in one frame: ``(P, 2)`` true places and found ones."""
        for marker, true, shows, place in zip(instrument.spec.markers, true_px, any_shows, found, strict=True):
            off = float(np.linalg.norm(true - place))
            right = off <= FALSE_PX
            # What shows little of may be found or not.
            little = bool(shows and np.isnan(true).any())
            self._counts[marker.name] += [
                np.isfinite(true).all(),
                right,
                np.isfinite(place).all() and not (right or little),
            ]
            self._off += [off] if right else []

    def tell(self) -> None:
        """Print all counts."""
        print(f"{'marker':12}{'shown':>7}{'found':>7}{'false':>7}{'recall':>8}")
        for name, (shown, right, false) in self._counts.items():
            print(f"{name:12}{shown:7}{right:7}{false:7}{right / max(shown, 1):8.3f}")
        shown, right, false = np.sum(list(self._counts.values()), axis=0)
        print(f"recall {right / shown:.3f}, precision {right / max(right + false, 1):.3f} of {shown} that show")
        print(f"error: median {np.median(self._off):.2f} px, 95 of 100 below {np.percentile(self._off, 95):.2f} px")


def tell_hues(instrument: Instrument, hues: dict[str, list[float]]) -> None:
    """Print how far hues were from those of the paint, and how near to the next."""
    painted, _ = hue_and_saturation(encoded(np.array([marker.colour for marker in instrument.spec.markers])))
    gaps = np.abs(turned(painted[:, None], painted)) + 360.0 * np.eye(len(painted))
    print(f"{'hue':12}{'paint':>7}{'least':>7}{'most':>7}{'next':>7}   degrees")
    for marker, own, gap in zip(instrument.spec.markers, painted, gaps.min(axis=1), strict=True):
        off = turned(np.array(hues.get(marker.name, [np.nan])), own)
        print(f"{marker.name:12}{own:7.0f}{off.min():+7.0f}{off.max():+7.0f}{gap:7.0f}")


def drawn(
    image: NDArray[np.uint8], instrument: Instrument, true_px: FloatArray, found: FloatArray, lines: ShaftLines | None
) -> NDArray[np.uint8]:
    """A frame with what was found in it, larger."""
    canvas = cv2.resize(image, None, fx=LARGER, fy=LARGER, interpolation=cv2.INTER_LINEAR)
    for edges, colour in () if lines is None else ((lines.expected, (190, 190, 190)), (lines.found, (60, 230, 60))):
        for normal_u, normal_v, rho in edges:
            along = np.array([-normal_v, normal_u]) * 2000
            ends = [np.array([normal_u, normal_v]) * rho + side * along for side in (-1, 1)]
            if np.isfinite(ends).all():
                cv2.line(canvas, _at(ends[0]), _at(ends[1]), colour, 1, cv2.LINE_AA)
    for marker, true, place in zip(instrument.spec.markers, true_px, found, strict=True):
        if np.isfinite(place).all():
            levels = (255 * encoded(np.array(marker.colour) / max(marker.colour))).tolist()
            cv2.circle(canvas, _at(place), 13 * LARGER // 2, levels, 2, cv2.LINE_AA)
        if np.isfinite(true).all():
            cv2.circle(canvas, _at(true), 2, (255, 255, 255), cv2.FILLED, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


def _at(place: FloatArray) -> tuple[int, int]:
    return round(float(LARGER * place[0])), round(float(LARGER * place[1]))


if __name__ == "__main__":
    main()
