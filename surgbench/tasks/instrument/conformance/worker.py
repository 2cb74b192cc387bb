"""The other process that a tracker goes on in."""

from __future__ import annotations

import pickle
from typing import Any

from surgbench.conformance.subject import Subject
from surgbench.processes.service import Tell, serve_parent
from surgbench.tasks.instrument.conformance.session import Session


def resume(tell: Tell, subject: Subject, parcel: bytes, rest: tuple[Any, ...]) -> tuple[Any, ...]:
    """Go on with a pickled tracker.

    Args:
        tell: Is told ``("alive",)`` in between.
        subject: Which tracker it is.
        parcel: The tracker.
        rest: Scene, last state, observations to come.

    Returns:
        ``("steps", its answers)``.
    """
    subject.make()  # so that the class of a file is there to be unpickled
    scene, last, observations = rest
    session = Session(pickle.loads(parcel), scene, last, lambda: tell("alive"))
    return ("steps", session.follow(observations))


if __name__ == "__main__":
    serve_parent(resume)
