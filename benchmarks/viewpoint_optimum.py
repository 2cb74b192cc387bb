"""How near to the best the course of `foresight` is, and by how much controllers miss it.

    surgbench generate wire-chaser --out data/chaser
    python benchmarks/viewpoint_optimum.py data/chaser --every 32

Prints Markdown, a row a trial. `bound` is the mean over every so many samples of the least `view_cost` that any joints
within their limits and the rules have at that sample, as if the arm could be anywhere at once: no course can have
less. It is found by SLSQP from several starts (the course's own joints, the naive pose's, the last sample's solution,
and some at random), so that it is a bound as far as those find the best.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.console import Console
from rich.progress import track
from scipy.optimize import minimize

from surgbench.dataset.open import open_dataset
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.trackers.foreseeing.course import Problem
from surgbench.trackers.foreseeing.model import RULES, TERMS, clearances, judge
from surgbench.trackers.foresight import Foresight, ForesightConfig
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Simulation, make_scene
from surgbench.viewpoint.trial import Trial

RANDOM_STARTS = 6
# Joints are scaled so that SLSQP's steps are alike in all of them; metres of the insertion as tenths of radians.
SCALE = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 1.0])


def best_at(problem: Problem, step: int, starts: list[FloatArray]) -> tuple[float, FloatArray]:
    """The least cost at a step, and its joints ``(6,)``; infinite where no start leads within the rules."""
    wanted, feature = problem.wanted[step : step + 1], problem.feature[step : step + 1]
    lower, upper = problem.limits[:2] / SCALE
    r, J = np.empty((1, TERMS)), np.empty((1, TERMS, 6))
    clear, C = np.empty((1, RULES)), np.empty((1, RULES, 6))

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        at = (x * SCALE)[None]
        judge(problem.arm, problem.reach_m, at, wanted, problem.distance_m, problem.weights, problem.up, r, J)
        return float(r[0] @ r[0]), 2 * (J[0].T @ r[0]) * SCALE

    def room(x: FloatArray) -> FloatArray:
        at = (x * SCALE)[None]
        clearances(problem.arm, problem.reach_m, at, feature, problem.rules, problem.faces, clear, C)
        return np.asarray(1e2 * clear[0])

    def room_slope(x: FloatArray) -> FloatArray:
        room(x)
        return np.asarray(1e2 * C[0] * SCALE)

    best, joints = np.inf, starts[0]
    for start in starts:
        found: Any = minimize(  # type: ignore[call-overload]
            cost, start / SCALE, jac=True, method="SLSQP", bounds=list(zip(lower, upper, strict=True)),
            constraints=[{"type": "ineq", "fun": room, "jac": room_slope}], options={"maxiter": 80, "ftol": 1e-7},
        )  # fmt: skip
        if found.fun < best and (room(found.x) > -1e-2).all():
            best, joints = float(found.fun), np.asarray(found.x * SCALE)
    return best, joints


def bound(trial: Trial, scene: ViewpointScene, problem: Problem, course: FloatArray, steps: range) -> float:
    """Mean least cost over some steps of a trial whose course had ``(T, 6)`` joints."""
    rng = np.random.default_rng(0)
    arm, T_base_world = scene.arm, inverse_transform(scene.T_world_base)
    naive = T_base_world @ naive_pose(np.nan_to_num(trial.T_world_feature), scene.distance_m)
    least, last = [], course[0]
    for step in track(steps, description=f"trial {trial.id}", console=Console(stderr=True), transient=True):
        near = arm.clip(arm.inverse(naive[step], course[step]))
        spread = [rng.uniform(arm.lower, arm.upper) for _ in range(RANDOM_STARTS)]
        value, last = best_at(problem, step, [course[step], near, last, *spread])
        least.append(value)
    return float(np.mean(least))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--every", type=int, default=32, help="samples from one that is bounded to the next")
    parser.add_argument("--trial", nargs="*", help="only these")
    parser.add_argument("--controller", nargs="*", default=["gaze", "autocam"], help="held against it")
    options = parser.parse_args()
    dataset = cast(ViewpointDataset, open_dataset(options.dataset))
    print("| trial | bound | `foresight`, same samples | all samples | " + " | ".join(options.controller) + " |")
    print("|---|---:|---:|---:|" + "---:|" * len(options.controller))
    for name in options.trial or [unit.sequence for unit in dataset.units()]:
        trial = dataset.trial(name)
        scene = make_scene(trial)
        foresight = Foresight(ForesightConfig())
        costs = []
        for controller in (foresight, *(create(find("tracker", one), {}) for one in options.controller)):
            course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
            costs.append(course_errors(course, trial, scene)["view_cost"])
            if controller is foresight:
                joints = course.joints[1:]
        steps = range(0, len(joints), options.every)
        least = bound(trial, scene, foresight.problem, joints, steps)
        own = float(np.mean(costs[0][steps]))
        means = " | ".join(f"{np.nanmean(cost):.3f}" for cost in costs)
        print(f"| {name} | {least:.3f} | {own:.3f} | {means} |", flush=True)


if __name__ == "__main__":
    main()
