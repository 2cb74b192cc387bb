"""Checks that a tracker's result hangs on nothing but what it is given."""

from __future__ import annotations

import pickle
from typing import Any

from surgbench.conformance.global_generators import global_generators
from surgbench.conformance.subject import Alive, CheckFailedError, Subject
from surgbench.processes.child import START_TIMEOUT_S, Child, ChildProblemError
from surgbench.tasks.instrument.conformance.scenes import play_of
from surgbench.tasks.instrument.conformance.session import Step, first_difference, run_through, start

WORKER = "surgbench.tasks.instrument.conformance.worker"


def no_global_randomness(subject: Subject, alive: Alive) -> str:
    """Neither reset nor step reads or seeds a generator that is everybody's."""
    play = play_of(subject)
    generators = global_generators()
    kept = {name: get() for name, (get, _, _) in generators.items()}
    try:
        run_through(subject.make(), play, alive)  # imports what it needs, PyTorch perhaps
        generators = global_generators()
        kept = {name: get() for name, (get, _, _) in generators.items()} | kept
        for _, draw, _ in generators.values():
            draw()  # away from where a seed that is set in every reset would put it back
        before = {name: pickle.dumps(get()) for name, (get, _, _) in generators.items()}
        run_through(subject.make(), play, alive)
        changed = [name for name, (get, _, _) in generators.items() if pickle.dumps(get()) != before[name]]
    finally:
        for name, (_, _, put) in generators.items():
            put(kept[name])
    if changed:
        raise CheckFailedError(f"uses or seeds the global generator of {' and '.join(changed)}: draw from reset's rng")
    return f"looked at {', '.join(generators)}"


def resets(subject: Subject, alive: Alive) -> str:
    """A sequence comes out the same after another one as on a new instance."""
    play, before = play_of(subject), play_of(subject, elsewhere=True, frames=8)
    used = subject.make()
    run_through(used, before, alive, seed=5)
    frame = first_difference(run_through(used, play, alive), run_through(subject.make(), play, alive))
    if frame is not None:
        raise CheckFailedError(f"after another sequence frame {frame} comes out differently: reset has to start anew")
    return ""


def moves_to_another_process(subject: Subject, alive: Alive) -> str:
    """Pickled in the middle of a sequence, it goes on elsewhere as it does here."""
    play = play_of(subject, frames=8)
    session = start(subject.make(), play, alive)
    session.follow(play.observations[:4])
    try:
        parcel = pickle.dumps(session.tracker)
    except Exception as error:
        raise CheckFailedError(f"cannot be pickled ({type(error).__name__}: {error})") from error
    there = resume_elsewhere(subject, parcel, (play.scene, session.last.copy(), play.observations[4:]), alive)
    frame = first_difference(session.follow(play.observations[4:]), there)
    if frame is not None:
        raise CheckFailedError(f"in another process frame {4 + frame} comes out differently")
    return f"{len(parcel) / 1e6:.1f} MB"


def resume_elsewhere(subject: Subject, parcel: bytes, rest: tuple[Any, ...], alive: Alive) -> list[Step]:
    """What a pickled tracker makes of the rest of a sequence in a process of its own."""
    with Child(START_TIMEOUT_S, WORKER) as child:
        child.send(subject, parcel, rest)
        try:
            while (message := child.receive())[0] == "alive":
                alive()
        except ChildProblemError as problem:
            raise CheckFailedError(f"does not go on in another process: {problem}") from problem
    steps: list[Step] = message[1]
    return steps
