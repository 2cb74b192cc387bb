"""The process that checks run in, so that a tracker that crashes or hangs fails one check and no more."""

from __future__ import annotations

import contextlib
import pickle
import traceback
from multiprocessing.connection import Connection

from surgbench.conformance.checks import run_check
from surgbench.conformance.session import Session
from surgbench.suite.process import serve_parent


def serve(connection: Connection) -> None:
    """Answer the parent's messages until it hangs up.

    They are ``("check", name, Subject)``, and ``("resume", Subject, pickled tracker, (scene, last state,
    observations))``. Signs of life come when it is ready and before the answer.
    """

    def alive() -> None:
        connection.send(("alive",))

    alive()  # everything is imported
    while True:
        try:
            kind, *content = connection.recv()
        except EOFError:
            return
        try:
            if kind == "check":
                name, subject = content
                connection.send(("outcome", run_check(name, subject, alive)))
                continue
            subject, parcel, (scene, last, observations) = content
            subject.make()  # so that the class of a file is there to be unpickled
            session = Session(pickle.loads(parcel), scene, last, alive)
            connection.send(("steps", session.follow(observations)))
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            with contextlib.suppress(OSError):
                connection.send(("problem", "failed", text, traceback.format_exc()))
            return


if __name__ == "__main__":
    serve_parent(serve)
