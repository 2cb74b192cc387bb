"""How fast and how alike the engines of the tip detector are, on one thread and the same masks.

    taskset -c 0 python benchmarks/keypoint_engines.py [--masks N] [--seed N]

Prints Markdown: for every engine that is installed the median time of one look of the network, as a multiple of
PyTorch's in the same run, how far its tips are from PyTorch's, and how right they are; what else a mask takes, as
shares of PyTorch's network; and how often a peak that stands out alone is a tip, by what it has to exceed.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch

from surgbench.generators.tip_masks import HELD_OUT, TipMasks
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import REFERENCE_WIDTH, Outcome, accuracy, is_asked, pair_errors
from surgbench.keypoints.labelled import LabelledMask
from surgbench.trackers.keypoints.heatmaps.detector import Look, TipDetector
from surgbench.trackers.keypoints.heatmaps.engines import Engine, make_engine
from surgbench.trackers.keypoints.heatmaps.model import load_network
from surgbench.trackers.keypoints.heatmaps.peaks import find_peaks
from surgbench.trackers.keypoints.heatmaps.square import find_square
from surgbench.trackers.keypoints.resnet18 import ONNX_PACKAGES, ResNet18Keypoints, find_spec

NEAR_PX = 5.0
TURNS = 3
SINGLE_HEATS = (0.36, 0.5, 0.6, 0.7)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    config = ResNet18Keypoints.Config()
    network, settings = load_network(config.path)
    names = ["torch"] + ["onnxruntime"] * all(find_spec(name) is not None for name in ONNX_PACKAGES)
    engines: dict[str, Engine] = {name: make_engine(name, network, settings) for name in names}  # type: ignore[arg-type]
    detectors = {
        name: TipDetector(
            network,
            settings,
            config.least_heat,
            config.apart_px,
            engine=name,  # type: ignore[arg-type]
            peaks=config.peaks,
        )
        for name in names
    }
    masks = list(TipMasks(HELD_OUT, asked.masks, asked.seed, "test"))
    times: dict[str, list[float]] = defaultdict(list)

    def timed(name: str, work: Callable[[], object]) -> object:
        begin = time.perf_counter()
        result = work()
        times[name].append(time.perf_counter() - begin)
        return result

    for one in masks:
        square = find_square(one.mask)
        if square is None:
            continue
        timed("square", lambda mask=one.mask: find_square(mask))  # type: ignore[misc]
        cut = timed("cut", lambda square=square, mask=one.mask: square.cut(mask, settings.input_px))  # type: ignore[misc]
        picture = np.asarray(cut, dtype=np.float32) / np.float32(255.0)
        for _ in range(TURNS):
            for name, engine in engines.items():
                logits = timed(name, lambda engine=engine, picture=picture: engine(picture))  # type: ignore[misc]
        timed("peaks", lambda logits=logits: find_peaks(logits, config.least_heat, config.apart_px))  # type: ignore[misc]
    answers = {name: [detector.detect(one.mask) for one in masks] for name, detector in detectors.items()}
    medians = {name: float(np.median(values)) for name, values in times.items()}
    print("| engine | × torch | ms here | farthest from torch [px] | other answers | detected % | false pairs % |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in names:
        print(_engine_row(name, medians, answers, masks))
    parts = ", ".join(f"{name} {medians[name] / medians['torch']:.3f}" for name in ("square", "cut", "peaks"))
    print(f"\nBeside the network, as shares of torch's time: {parts}\n")
    looks = [detectors[names[-1]].look(one.mask) for one in masks]
    for heat in SINGLE_HEATS:
        print(_singles(heat, looks, masks, config.least_heat))


def _engine_row(
    name: str, medians: dict[str, float], answers: dict[str, list[FloatArray | None]], masks: Sequence[LabelledMask]
) -> str:
    far, others = 0.0, 0
    for mine, torchs in zip(answers[name], answers["torch"], strict=True):
        others += (mine is None) != (torchs is None)
        if mine is not None and torchs is not None:
            far = max(far, float(np.abs(mine - torchs).max()))
    found = accuracy([_outcome(one, answer) for one, answer in zip(masks, answers[name], strict=True)])
    return (
        f"| {name} | {medians[name] / medians['torch']:.2f} | {1e3 * medians[name]:.1f} | {far:.1e} | {others} | "
        f"{found.detected_percent:.1f} | {found.all_false_pair_percent:.1f} |"
    )


def _outcome(example: LabelledMask, answer: FloatArray | None) -> Outcome:
    if answer is None:
        return Outcome(is_asked(example), None)
    scale = REFERENCE_WIDTH / example.mask.shape[1]
    return Outcome(is_asked(example), scale * pair_errors(answer, example.tips_px))


def _singles(heat: float, looks: Sequence[Look | None], masks: Sequence[LabelledMask], least_heat: float) -> str:
    """How often one peak stands out alone and exceeds ``heat``, and how often it is one of the tips."""
    errors = []
    for one, look in zip(masks, looks, strict=True):
        if look is not None and (look.heat >= least_heat).sum() == 1 and look.heat[0] > heat:
            place = look.square.to_image(look.peaks[0], len(look.picture))
            distances = np.linalg.norm(place - one.tips_px, axis=1)
            errors.append(REFERENCE_WIDTH / one.mask.shape[1] * float(np.nanmin([*distances, np.inf])))
    near = 100.0 * float(np.mean(np.array(errors) <= NEAR_PX)) if errors else float("nan")
    share = 100.0 * len(errors) / len(masks)
    return f"One peak alone above {heat:g}: {share:.1f} % of masks; within {NEAR_PX:g} px of a tip: {near:.1f} %"


if __name__ == "__main__":
    main()
