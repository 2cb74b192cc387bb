"""Where clients of the bridge come in: it listens, and hands the client's connection to the process of each trial.

Trials run in processes of their own, one after another, and the client stays the same: so the process that listens
passes the connection itself on, over a private socket whose path the environment variable :data:`PLACE` names. A client
that has hung up may come back for the next trial.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from surgbench.errors import SurgbenchError
from surgbench.viewpoint.bridge.lines import BridgeError, Lines
from surgbench.viewpoint.bridge.messages import PROTOCOL, Bye, ErrorMessage, Hello

PLACE = "SURGBENCH_VIEWPOINT_BRIDGE"
# A client says who it is as soon as it is connected.
HELLO_S = 5.0
_LOOK_S = 0.2


def listen(host: str, port: int, path: Path | None) -> socket.socket:
    """A socket that clients can connect to.

    Args:
        host: Where, of TCP; ``127.0.0.1`` for this machine alone.
        port: 0 for any that is free.
        path: Of a Unix socket, instead.

    Raises:
        SurgbenchError: It cannot be had.
    """
    listener = socket.socket(socket.AF_INET if path is None else socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path is None:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        else:
            _clear(path)
        listener.bind((host, port) if path is None else str(path))
        listener.listen(1)
    except OSError as error:
        listener.close()
        place = f"{host}:{port}" if path is None else str(path)
        raise SurgbenchError(f"{place}: cannot be listened at ({error.strerror or error})") from None
    return listener


def _clear(path: Path) -> None:
    """Remove the socket of a process that has ended without doing so."""
    if not path.is_socket():
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        try:
            asking.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()


def place_of(listener: socket.socket) -> str:
    """Where a socket listens, as one would type it."""
    name = listener.getsockname()
    return name if isinstance(name, str) else f"{name[0]}:{name[1]}"


def greet(lines: Lines) -> Hello:
    """A new client's name, with which we greet it in turn.

    Raises:
        BridgeError: It is none, and has been told so.
    """
    try:
        hello = lines.receive(lines.deadline())
        if not isinstance(hello, Hello):
            raise BridgeError("invalid", "the client did not begin with 'hello'")
        if hello.protocol != PROTOCOL:
            raise BridgeError("invalid", f"the client speaks protocol {hello.protocol}; this is {PROTOCOL}")
        lines.send(Hello(protocol=PROTOCOL, name="surgbench"))
    except BridgeError as error:
        with contextlib.suppress(BridgeError):
            lines.send(ErrorMessage(error=str(error)))
        lines.close()
        raise
    return hello


class Hub:
    """Waits for a client, and hands its connection out.

    Args:
        listener: From :func:`listen`.
        patience_s: How long a client is waited for.
        say: Told in a line what is being waited for.
        gone: Called where a trial had no client in time.

    Attributes:
        missing: One line, where there was none.
    """

    def __init__(
        self, listener: socket.socket, patience_s: float, say: Callable[[str], None], gone: Callable[[], None]
    ) -> None:
        self._listener, self._patience_s, self._say, self._gone = listener, patience_s, say, gone
        self._client: tuple[Hello, Lines] | None = None
        self._handed, self._ended = 0, threading.Event()
        self.missing: str | None = None

    def client(self) -> Hello:
        """Who the client is; waits for one where none is there, or no more.

        Raises:
            SurgbenchError: None comes in time.
        """
        if self._client is not None and not self._client[1].is_open:
            self._client[1].close()
            self._client = None
        if self._client is None:
            self._client = self._wait()
        return self._client[0]

    def bye(self) -> None:
        """Tell the client that it is over."""
        if self._client is not None:
            with contextlib.suppress(BridgeError):
                self._client[1].send(Bye())
            self._client[1].close()
            self._client = None

    @contextmanager
    def handing_out(self) -> Iterator[None]:
        """Hand the connection to each process that asks for it, meanwhile."""
        with tempfile.TemporaryDirectory(prefix="surgbench-") as folder:
            private = listen("", 0, Path(folder) / "bridge")
            os.environ[PLACE] = place_of(private)
            thread = threading.Thread(target=self._hand_out, args=(private,), daemon=True)
            thread.start()
            try:
                yield
            finally:
                del os.environ[PLACE]
                self._ended.set()
                thread.join()
                private.close()

    def _hand_out(self, private: socket.socket) -> None:
        private.settimeout(_LOOK_S)
        while not self._ended.is_set():
            try:
                asking, _ = private.accept()
            except OSError:
                continue
            with asking, contextlib.suppress(OSError):
                try:
                    self.client()
                except SurgbenchError as error:
                    self.missing = str(error)
                    self._gone()
                    asking.sendall(self.missing.encode())
                    continue
                assert self._client is not None
                self._handed += 1
                socket.send_fds(asking, [str(self._handed).encode()], [self._client[1].socket.fileno()])

    def _wait(self) -> tuple[Hello, Lines]:
        self._say(f"waiting for a client at {place_of(self._listener)}")
        deadline = time.monotonic() + self._patience_s
        while not self._ended.is_set() and (left := deadline - time.monotonic()) > 0:
            self._listener.settimeout(min(left, _LOOK_S))
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            lines = Lines(connection, HELLO_S)
            try:
                hello = greet(lines)
            except BridgeError as error:
                self._say(f"turned away: {error}")
                continue
            self._say(f"'{hello.name}' is here")
            return hello, lines
        raise SurgbenchError(f"no client came to {place_of(self._listener)} within {self._patience_s:g} s")


def take_over(patience_s: float) -> tuple[Lines, str]:
    """In a trial's process: the client's connection, and a prefix for ids that no other trial has.

    Args:
        patience_s: How long the client may take to answer.

    Raises:
        BridgeError: There is no client.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.connect(os.environ[PLACE])
        words, handed, _, _ = socket.recv_fds(asking, 1 << 10, 1)
    if not handed:
        raise BridgeError("exited", words.decode() or "the bridge has been closed")
    return Lines(socket.socket(fileno=handed[0]), patience_s), words.decode()
