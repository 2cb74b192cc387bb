"""How often the initialisers find the instrument in a first frame, and how long they take.

    for seed in 1 2 3 4 5 6; do surgbench generate mini --sequences 2 --frames 2 --seed $seed --out first/$seed; done
    python benchmarks/initialisers.py first/* --initialiser random --initialiser turbo

Prints Markdown, a row for each initialiser and each kind of hint: found are those first frames whose state has its tips
within 5 mm and its rotation within 0.2 rad of the truth, the better twin counting. CPU seconds, so that what else
the machine does hardly counts.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from surgbench.contract import Observation
from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.metrics import pose_errors
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.units import UnitData

TIP_M = 5e-3
ROTATION_RAD = 0.2


def without_keypoints(observation: Observation) -> Observation:
    return replace(observation, views=(replace(observation.views[0], keypoints=(None,)),))


HINTS: dict[str, tuple[Any, Callable[[Observation], Observation]]] = {
    "tips": ("none", lambda observation: observation),
    "none": ("none", without_keypoints),
    "tips and readings": ("noisy", lambda observation: observation),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="+", type=Path)
    parser.add_argument("--initialiser", action="append", metavar="NAME", help="default: random")
    parser.add_argument("--hints", action="append", choices=HINTS, help="default: all")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE", help="of the initialisers")
    parser.add_argument("--verbose", action="store_true", help="a line for each first frame")
    options = parser.parse_args()
    settings = {key: yaml.safe_load(value) for key, value in (text.split("=", 1) for text in options.set)}
    print("| initialiser | hints | found | median tip [mm] | median rotation [rad] | CPU seconds, median | most |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for name in options.initialiser or ["random"]:
        for hint in options.hints or HINTS:
            readings, hide = HINTS[hint]
            results = []
            for path in options.dataset:
                dataset = open_as(InstrumentDataset, path)
                for unit in dataset.units("single"):
                    data = UnitData(dataset, unit, readings)
                    frame = hide(data.observation(0))
                    rng = generator(benchmark="initialisers", dataset=dataset.hash, unit=unit.id)
                    begin = time.process_time()
                    search = create(find("initialiser", name), settings)
                    state = search.initialise(data.scene(), frame, rng, None, lambda _: None)
                    spent_s = time.process_time() - begin
                    assert data.truth is not None
                    errors = pose_errors(data.instruments[0], data.camera, state[None], data.truth[0])
                    tip_m, rotation_rad = errors["tip_error_m"][0], errors["rotation_error_rad"][0]
                    results.append((tip_m, rotation_rad, spent_s))
                    if options.verbose:
                        print(f"{path.name} {unit.id}: {1e3 * tip_m:.2f} mm, {rotation_rad:.3f} rad, {spent_s:.1f} s")
            tips, rotations, seconds = np.array(results).T
            found = (tips < TIP_M) & (rotations < ROTATION_RAD)
            print(
                f"| `{name}` | {hint} | {found.sum()} of {len(found)} | {1e3 * np.median(tips):.2f} "
                f"| {np.median(rotations):.3f} | {np.median(seconds):.1f} | {seconds.max():.1f} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
