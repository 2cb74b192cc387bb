"""Checks of a viewpoint controller: it closes its loop with the simulator in small worlds of all kinds."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from surgbench.conformance.global_generators import global_generators
from surgbench.conformance.subject import Alive, CheckFailedError, DoubtError, Subject
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.randomness import generator
from surgbench.tasks.viewpoint.conformance.worlds import circling, random_trial
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import look_at
from surgbench.viewpoint.receiver import InvalidCommandError
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

STEPS = 240
WORLDS, WORLD_STEPS = 100, 6
CLIPPED_SHARE = 0.5


class _Watched:
    """A controller that gives signs of life, and whose input is compared before and after."""

    def __init__(self, controller: Any, alive: Alive) -> None:
        self._controller, self._alive = controller, alive
        self.touched: str | None = None

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Reset the controller."""
        given = (scene.T_world_base, scene.workspace.zone.points, joints)
        before = pickle.dumps(given)
        self._controller.reset(scene, joints, rng)
        if pickle.dumps(given) != before:
            self.touched = "reset"
        self._alive()

    def step(self, observation: ViewpointObservation) -> Any:
        """Ask the controller."""
        before = pickle.dumps(observation)
        answer = self._controller.step(observation)
        if pickle.dumps(observation) != before:
            self.touched = f"step {observation.index}"
        self._alive()
        return answer


def _run(controller: Any, trial: Trial, alive: Alive, seed: int = 0) -> Course:
    watched = _Watched(controller, alive)
    try:
        course = Simulation(watched, trial, make_scene(trial), generator(check=seed)).run()
    except InvalidCommandError as error:
        raise CheckFailedError(str(error)) from error
    if watched.touched is not None:
        raise CheckFailedError(f"{watched.touched} changes what it is given; copy it first")
    return course


def plain(subject: Subject, alive: Alive) -> str:
    """A ring that circles with nothing in the way: every answer is a command, and no input is changed."""
    trial = circling(STEPS)
    errors = course_errors(_run(subject.make(), trial, alive), trial, make_scene(trial))
    return f"looks {errors['vva_deg'].mean():.2f} degrees and {errors['fd_mm'].mean():.1f} mm off"


def limits(subject: Subject, alive: Alive) -> str:
    """Commands lie within the joints' limits, where the feature is within reach."""
    clipped = _run(subject.make(), circling(STEPS), alive).clipped.mean()
    if clipped > CLIPPED_SHARE:
        raise DoubtError(f"{100 * clipped:.0f} % of its commands are outside the joint limits and were clipped")
    return ""


def same_seed(subject: Subject, alive: Alive) -> str:
    """The same seed gives the same course."""
    one, again = (_run(subject.make(), circling(STEPS), alive).setpoints for _ in range(2))
    _same(one, again, "two runs with the same seed differ from step {} on: draw from reset's rng only")
    return ""


def resets(subject: Subject, alive: Alive) -> str:
    """A trial comes out the same after another one as on a new instance."""
    used = subject.make()
    _run(used, circling(40, radius_m=0.01, period_s=5.0), alive, seed=5)
    after, fresh = (_run(one, circling(STEPS), alive).setpoints for one in (used, subject.make()))
    _same(after, fresh, "after another trial step {} comes out differently: reset has to start anew")
    return ""


def budget(subject: Subject, alive: Alive) -> str:
    """No step takes longer than the budget, once everything is warm."""
    _run(subject.make(), circling(STEPS), alive)
    times_ms = _run(subject.make(), circling(STEPS), alive).latency_ms
    if times_ms.max() > 1e3 * subject.budget_s:
        raise CheckFailedError(f"a step took {times_ms.max() / 1e3:.2f} s; {subject.budget_s:g} s are allowed")
    return f"{np.median(times_ms):.3f} ms a step (median), {times_ms.max():.3f} ms at most"


def no_global_randomness(subject: Subject, alive: Alive) -> str:
    """Neither reset nor step reads or seeds a generator that is everybody's."""
    _run(subject.make(), circling(20), alive)  # imports what it needs
    generators = global_generators()
    before = {name: pickle.dumps(get()) for name, (get, _, _) in generators.items()}
    _run(subject.make(), circling(20), alive)
    changed = [name for name, (get, _, _) in generators.items() if pickle.dumps(get()) != before[name]]
    if changed:
        raise CheckFailedError(f"uses or seeds the global generator of {' and '.join(changed)}: draw from reset's rng")
    return f"looked at {', '.join(generators)}"


def gaps(subject: Subject, alive: Alive) -> str:
    """The feature is not measured for a while, and then is elsewhere."""
    trial = circling(STEPS)
    trial.T_world_feature[60:120] = np.nan
    trial.T_world_feature[120:, :3, 3] += [0.03, 0.0, 0.0]
    _run(subject.make(), trial, alive)
    return ""


def inside_the_zone(subject: Subject, alive: Alive) -> str:
    """The camera starts inside the no-go zone."""
    trial = circling(60)
    zone = make_scene(trial).workspace.zone.corners.mean(axis=0)
    pose = look_at(zone, trial.T_world_feature[0, :3, 3])
    arm = make_scene(trial).arm
    start = arm.clip(arm.inverse(inverse_transform(trial.T_world_base) @ pose, np.array([0, 0, 0, -2.8, 0, 0])))
    _run(subject.make(), replace(trial, start=start), alive)
    return ""


def strange_worlds(subject: Subject, alive: Alive) -> str:
    """Features that jump, are out of reach, or in the camera; bases and starts of all kinds: still commands."""
    rng = generator(check="strange worlds")
    for world in range(WORLDS):
        try:
            _run(subject.make(), random_trial(rng, WORLD_STEPS), alive)
        except CheckFailedError as error:
            raise CheckFailedError(f"in world {world}: {error}") from error
    return f"{WORLDS} worlds"


def _same(one: FloatArray, other: FloatArray, message: str) -> None:
    different = np.flatnonzero((one != other).any(axis=1))
    if different.size:
        raise CheckFailedError(message.format(int(different[0])))


# In this order; each says in its docstring what it is about.
VIEWPOINT_CHECKS: dict[str, Callable[[Subject, Alive], str]] = {
    "plain trial": plain,
    "joint limits": limits,
    "same seed": same_seed,
    "time": budget,
    "no global randomness": no_global_randomness,
    "reset starts anew": resets,
    "gaps": gaps,
    "starts in the zone": inside_the_zone,
    "strange worlds": strange_worlds,
}
