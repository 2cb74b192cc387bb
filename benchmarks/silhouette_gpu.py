"""How many candidate states a second the PyTorch silhouette scores, beside the compiled CPU engine.

    python benchmarks/silhouette_gpu.py --device cuda
    python benchmarks/silhouette_gpu.py --device cpu --candidates 70 210 1000

Prints Markdown: card, driver and versions, then a row per number of candidates. "on the device" times states and counts
that stay there, as an optimiser in PyTorch would use it; "from arrays" times the call that trackers make, copies
included. Medians; the first call of each size, which loads kernels and grows the memory pool, is not timed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from surgbench.camera import Camera
from surgbench.errors import SurgbenchError
from surgbench.instrument import load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import STATE_SCALE
from surgbench.suite.environment import environment

CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
INSTRUMENT = "large_needle_driver"
# Shaft from the left, wrist and half open jaws near the middle of the image.
STATE = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])
SPREAD = 2.0  # natural steps of the state: a first generation of a tracker
CANDIDATES = (70, 210, 1000, 10000, 100000)
GENERATIONS = 3


def median_s(call: Callable[[], object], finish: Callable[[], None], budget_s: float) -> float:
    """Median seconds of a call, one untimed call first; at least 3 and until the budget is spent, at most 200."""
    call()
    finish()
    spent: list[float] = []
    while len(spent) < 3 or (sum(spent) < budget_s and len(spent) < 200):
        begin = time.perf_counter()
        call()
        finish()
        spent.append(time.perf_counter() - begin)
    return float(np.median(spent))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 or cpu (default: %(default)s)")
    parser.add_argument("--candidates", type=int, nargs="+", default=CANDIDATES, metavar="N")
    parser.add_argument("--memory", type=int, default=1024, metavar="MIB", help="to work in at a time (%(default)s)")
    parser.add_argument("--budget", type=float, default=3.0, metavar="S", help="for each timing (%(default)s)")
    options = parser.parse_args()
    instrument = load_instrument(INSTRUMENT)
    try:
        from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

        scorer = TorchSilhouetteEvaluator(
            [instrument], CAMERA, device=options.device, memory_bytes=options.memory << 20
        )
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        return 2
    import torch

    def finish() -> None:
        if scorer.device.type == "cuda":
            torch.cuda.synchronize(scorer.device)

    engine = SilhouetteEvaluator([instrument], CAMERA)
    reference = Reference(engine.mask(STATE))
    prefix = scorer.upload(reference)
    rng = generator(benchmark="silhouette-gpu")
    where = environment(scorer.device.type)
    machine = where["machine"]
    if scorer.device.type == "cuda":
        card = torch.cuda.get_device_name(scorer.device)
        driver = (machine["gpu"] or {}).get("driver", "unknown")
        print(f"Device: {card}, driver {driver}, CUDA {torch.version.cuda}", end="; ")
    else:
        print(f"Device: {machine['processor']}, {torch.get_num_threads()} threads", end="; ")
    print(f"PyTorch {torch.__version__}, {scorer.triangles} triangles, {CAMERA.width} x {CAMERA.height}, float64, ")
    print(f"chunks of {options.memory} MiB; CPU engine on {machine['processor']}, one thread.\n")
    print("| candidates | µs each, on the device | candidates/s | ms a call, from arrays | µs each, CPU engine | "
          "largest difference, px | states that differ |")  # fmt: skip
    print("|---:|---:|---:|---:|---:|---:|---:|")
    for count in options.candidates:
        states = STATE + SPREAD * STATE_SCALE * rng.standard_normal((count, len(STATE)))
        tensor = torch.tensor(states, device=scorer.device)
        device_s = median_s(partial(scorer.counts, tensor, prefix), finish, options.budget)
        arrays_s = median_s(partial(scorer.score, states, reference), finish, options.budget)
        engine_s = median_s(partial(engine.score, states, reference), finish, options.budget)
        found, expected = scorer.score(states, reference), engine.score(states, reference)
        apart = np.maximum(np.abs(found.area - expected.area), np.abs(found.overlap - expected.overlap))
        print(
            f"| {count} | {1e6 * device_s / count:.2f} | {count / device_s:,.0f} | {1e3 * arrays_s:.2f} | "
            f"{1e6 * engine_s / count:.2f} | {apart.max()} | {np.count_nonzero(apart)} |",
            flush=True,
        )
    generations = torch.tensor(
        STATE + SPREAD * STATE_SCALE * rng.standard_normal((70, len(STATE))), device=scorer.device
    )

    def frame() -> None:
        for _ in range(GENERATIONS):
            scorer.counts(generations, prefix)[0].cpu()

    print(
        f"\n{GENERATIONS} generations of 70, each waited for: {1e3 * median_s(frame, finish, options.budget):.2f} ms."
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
