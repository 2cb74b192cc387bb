"""Checks of what a tracker answers: form, limits, time, seeds, candidates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surgbench.conformance.subject import Alive, CheckFailedError, DoubtError, Subject
from surgbench.contract import Trace, Traceable
from surgbench.state import BETA, JOINTS, POSITION, STATE_NAMES, split_arms
from surgbench.tasks.instrument.conformance.scenes import play_of
from surgbench.tasks.instrument.conformance.session import first_difference, run_through, start

LIMIT_ROUNDING_RAD = 1e-9
X, Z = 3, 5


def plain(subject: Subject, alive: Alive) -> str:
    """One arm, its mask and its tips: every answer is a finite state."""
    play = play_of(subject)
    steps = run_through(subject.make(), play, alive)
    confidence = np.array([step.confidence for step in steps])
    beyond = confidence[(confidence < 0) | (confidence > 1)]
    if beyond.size:
        raise DoubtError(f"a confidence of {beyond[0]:g} is not between 0 and 1")
    off_mm = 1e3 * float(np.linalg.norm(steps[-1].state[POSITION] - play.truth[-1, POSITION]))
    return f"{off_mm:.1f} mm off after {len(steps)} frames"


def limits(subject: Subject, alive: Alive) -> str:
    """Joints stay within the scene's limits."""
    play = play_of(subject, frames=10)
    states = np.array([step.state for step in run_through(subject.make(), play, alive)])
    joints = split_arms(states)[..., JOINTS]
    beyond = np.abs(joints - play.scene.joint_limits.clip(joints)).max(axis=(0, 1))
    worst = int(np.argmax(beyond))
    if beyond[worst] > LIMIT_ROUNDING_RAD:
        raise DoubtError(f"{STATE_NAMES[JOINTS][worst]} is up to {beyond[worst]:.3f} rad outside the joint limits")
    return ""


def budget(subject: Subject, alive: Alive) -> str:
    """No step takes longer than the budget, once everything is warm."""
    play = play_of(subject)
    run_through(subject.make(), play, alive)
    times_s = [step.latency_s for step in run_through(subject.make(), play, alive)]
    if max(times_s) > subject.budget_s:
        raise CheckFailedError(f"a step took {max(times_s):.2f} s; {subject.budget_s:g} s are allowed")
    return f"{1e3 * float(np.median(times_s)):.1f} ms a step (median), {1e3 * max(times_s):.1f} ms at most"


def same_seed(subject: Subject, alive: Alive) -> str:
    """The same seed gives the same result."""
    play = play_of(subject)
    one, again = (run_through(subject.make(), play, alive) for _ in range(2))
    frame = first_difference(one, again)
    if frame is not None:
        raise CheckFailedError(f"two runs with the same seed differ from frame {frame} on: draw from reset's rng only")
    return ""


def other_seed(subject: Subject, alive: Alive) -> str:
    """Another seed may give another result."""
    play = play_of(subject)
    one, other = (run_through(subject.make(), play, alive, seed) for seed in (0, 1))
    return "the same result: nothing random" if first_difference(one, other) is None else "another result"


def candidates(subject: Subject, alive: Alive) -> str:
    """A tracker that shows its candidates estimates the same when it does."""
    tracker = subject.make()
    if not isinstance(tracker, Traceable):
        return "shows none"
    play = play_of(subject)
    quiet = run_through(subject.make(), play, alive)
    session = start(tracker, play, alive)
    shown = []
    for observation in play.observations:
        tracker.trace = Trace()
        shown += session.follow([observation])
        _check_trace(tracker.trace, len(session.last))
    if first_difference(quiet, shown) is not None:
        raise CheckFailedError("the estimates change when 'trace' is set")
    return ""


def _check_trace(trace: Trace, size: int) -> None:
    if len(trace.states) != len(trace.losses):
        raise CheckFailedError(f"the trace has {len(trace.states)} 'states' but {len(trace.losses)} 'losses'")
    for states, losses in zip(trace.states, trace.losses, strict=True):
        if np.shape(states) != (len(losses), size):
            raise CheckFailedError(f"the trace has states of shape {np.shape(states)}, not ({len(losses)}, {size})")
        if (np.diff(losses) < 0).any():
            raise CheckFailedError("the trace's candidates are not sorted, best first")


def strange_starts(subject: Subject, alive: Alive) -> str:
    """Searches that start at joint limits, outside the picture, behind the camera, or turns away."""
    play = play_of(subject, frames=1)
    frame, truth = play.observations[0], play.truth[0]
    box = play.scene.limits[0]
    starts = {}
    for name, where, value in (
        ("at the lower joint limits", JOINTS, box.lower_rad),
        ("at the upper joint limits", JOINTS, box.upper_rad),
        ("outside the picture", X, 0.3),
        ("behind the camera", Z, -0.1),
        ("at the lens", Z, 1e-3),
        ("some turns away", BETA, 40.0),
    ):
        starts[name] = truth.copy()
        starts[name][where] = value
    session = start(subject.make(), play, alive)
    for index, (name, state) in enumerate(starts.items()):
        try:
            session.step(replace(frame, index=index, start=state.copy()))
        except Exception as error:
            raise CheckFailedError(f"a search that starts {name}: {error}") from error
    return ""
