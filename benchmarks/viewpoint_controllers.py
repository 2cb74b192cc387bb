"""How long the viewpoint controllers take for a step, and how many times real time a trial is simulated.

    python benchmarks/viewpoint_controllers.py

Prints Markdown: microseconds, with and without the optimiser, and seconds of a trial per second of one core,
controller, simulator and all; to be compared within the table. A minute of a ring that goes round above the no-go zone
while its normal swings beyond the preferred side and the arm's reach.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from surgbench.geometry import inverse_transform, rigid_transform
from surgbench.registry import create, find
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.simulator import Simulation, make_scene
from surgbench.viewpoint.trial import Trial

DT_S = 1 / 79.2
BASE_M = np.array([0.165, -0.118, 0.22])
ZONE_M = 1e-3 * np.array([[-41, -38, 0], [41, -38, 0], [41, 38, 0], [-41, 38, 0], [0, 0, 49.4]])
NAMES = ("static", "midpoint", "naive", "autocam", "autocam-published", "hierarchy", "horizon", "gaze")


def swinging(seconds: float) -> Trial:
    at_s = np.arange(0, seconds, DT_S)
    azimuth = np.radians(-30 + 70 * np.sin(0.5 * at_s) + 20 * np.sin(1.3 * at_s))
    elevation = np.radians(25 + 25 * np.sin(0.8 * at_s + 1))
    normal = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    position = 1e-3 * np.stack(
        [35 * np.sin(0.4 * at_s), 17 * np.sin(0.9 * at_s), 40 + 15 * np.sin(0.7 * at_s)], axis=-1
    )
    poses = rigid_transform(np.stack([across, normal, np.cross(across, normal)], axis=-1), position)
    base = rigid_transform(np.eye(3), BASE_M)
    arm = CameraArm()
    middle = np.array([0.0, 0.0, 0.0, -2.8, 0.0, 0.0])
    start = arm.clip(arm.inverse(inverse_transform(base) @ naive_pose(poses[0]), middle))
    return Trial("swinging", DT_S, at_s, poses, base, Touches(ZONE_M, ZONE_M - BASE_M), ZONE_M, start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="*", default=NAMES)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the trial")
    options = parser.parse_args()
    trial = swinging(options.seconds)
    scene = make_scene(trial)
    print("| controller | without optimiser: median | 95 % | with: median | 95 % | share | × real time |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in options.name:
        controller = create(find("tracker", name), {})
        Simulation(controller, trial, scene, np.random.default_rng(0), 50).run()  # compiled
        begin_s = time.process_time()
        course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
        faster = trial.timestamps_s[-1] / (time.process_time() - begin_s)
        columns = []
        for chosen in (~course.solver, course.solver):
            times_us = 1e3 * course.latency_ms[chosen]
            columns += [f"{x:.1f}" for x in np.percentile(times_us, [50, 95])] if len(times_us) else ["–", "–"]
        print(f"| `{name}` | {' | '.join(columns)} | {100 * course.solver.mean():.0f} % | {faster:.0f} |", flush=True)


if __name__ == "__main__":
    main()
