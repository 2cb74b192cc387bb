"""How many times real time the Gymnasium environment runs, summed over its worlds, on one core.

    python benchmarks/viewpoint_environment.py

Prints Markdown: seconds of trials per second of one core, for one arm and for vectors of several sizes, with actions
that are drawn beforehand; and of the worlds below them, without observations and rewards. To be compared within the
table.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from viewpoint_controllers import DT_S, swinging

from surgbench.viewpoint.environment import ViewpointEnv, ViewpointVectorEnv
from surgbench.viewpoint.worlds import Worlds

SIZES = (1, 16, 64, 256)


def faster_than_life(steps: int, worlds: int, begin_s: float) -> float:
    return steps * worlds * DT_S / (time.process_time() - begin_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=3000, help="of each")
    options = parser.parse_args()
    trials, rng = [swinging(30.0), swinging(20.0)], np.random.default_rng(0)
    print("| | worlds | × real time |")
    print("|---|---:|---:|")

    actions = rng.uniform(-1, 1, (options.steps, max(SIZES), 6)).astype(np.float32)
    env = ViewpointEnv(trials=trials)
    for timed in (False, True):  # first it is compiled
        env.reset(seed=0)
        begin_s = time.process_time()
        for action in actions[: options.steps if timed else 10, 0]:
            if env.step(action)[3]:
                env.reset()
    print(f"| `ViewpointEnv` | 1 | {faster_than_life(options.steps, 1, begin_s):,.0f} |", flush=True)

    for size in SIZES:
        vector = ViewpointVectorEnv(size, trials=trials)
        vector.reset(seed=0)
        begin_s = time.process_time()
        for chosen in actions[:, :size]:
            vector.step(chosen)
        print(f"| `ViewpointVectorEnv` | {size} | {faster_than_life(options.steps, size, begin_s):,.0f} |", flush=True)

    worlds = Worlds(trials, 64)
    every = np.ones(64, dtype=bool)
    worlds.begin(every, np.arange(64) % 2)
    wanted = actions[:, :64].astype(np.float64)
    begin_s = time.process_time()
    for chosen in wanted:
        worlds.step(chosen)
    print(f"| `Worlds` | 64 | {faster_than_life(options.steps, 64, begin_s):,.0f} |", flush=True)


if __name__ == "__main__":
    main()
