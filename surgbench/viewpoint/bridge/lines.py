"""One end of the bridge: messages over a connected socket, bounded in time and in memory."""

from __future__ import annotations

import contextlib
import socket
import time

from surgbench.viewpoint.bridge.messages import Message, MessageError, decode

# A scene, the longest message there is, takes two thousand.
LONGEST_BYTES = 1 << 16
CHUNK_BYTES = 1 << 14


class BridgeError(Exception):
    """The other end does not do its part; one line.

    Attributes:
        status: As of a record: ``timeout``, ``exited`` (it hung up), ``invalid`` or ``failed``.
        over: Whether nothing more can be said over this connection.
    """

    def __init__(self, status: str, message: str, over: bool = False) -> None:
        super().__init__(message)
        self.status, self.over = status, over


class Lines:
    """Messages to and from the other end.

    Args:
        connection: To it; is closed with this.
        patience_s: How long it may take to answer, or to make room for what it is told; ``None`` for ever.
    """

    def __init__(self, connection: socket.socket, patience_s: float | None) -> None:
        self.socket, self._patience_s, self._held = connection, patience_s, bytearray()
        with contextlib.suppress(OSError):  # a Unix socket holds nothing back anyway
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: Message) -> None:
        """Say something.

        Raises:
            BridgeError: The other end does not make room for it, or has hung up; that is the end.
        """
        try:
            self.socket.settimeout(self._patience_s)
            self.socket.sendall(message.encode())
        except TimeoutError:
            self.close()
            raise BridgeError("timeout", f"the client reads nothing for {self._patience_s:g} s", over=True) from None
        except OSError:
            raise self._gone() from None

    def deadline(self) -> float | None:
        """When the patience that begins now ends, on the monotonic clock."""
        return None if self._patience_s is None else time.monotonic() + self._patience_s

    def receive(self, deadline: float | None) -> Message:
        """What the other end says next.

        Args:
            deadline: From :meth:`deadline`.

        Raises:
            BridgeError: It says nothing in time, has hung up, or says something that is no message. After a line that
                is too long that is the end.
        """
        while (end := self._held.find(b"\n")) < 0 and len(self._held) <= LONGEST_BYTES:
            self._held += self._more(deadline)
        if end < 0 or end > LONGEST_BYTES:
            self.close()
            raise BridgeError("invalid", f"the client sent a line of more than {LONGEST_BYTES} bytes", over=True)
        line = bytes(self._held[:end])
        del self._held[: end + 1]
        try:
            return decode(line)
        except MessageError as error:
            raise BridgeError("invalid", f"the client sent {error}") from None

    @property
    def is_open(self) -> bool:
        """Whether the other end is there, as far as can be seen without waiting."""
        try:
            self.socket.settimeout(0.0)
            return self.socket.recv(1, socket.MSG_PEEK) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def close(self) -> None:
        """Hang up, in every process that shares the connection."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()

    def _more(self, deadline: float | None) -> bytes:
        left = None if deadline is None else deadline - time.monotonic()
        try:
            if left is not None and left <= 0:
                raise TimeoutError
            self.socket.settimeout(left)
            more = self.socket.recv(CHUNK_BYTES)
        except TimeoutError:
            raise BridgeError("timeout", f"no answer from the client within {self._patience_s:g} s") from None
        except OSError:
            raise self._gone() from None
        if not more:
            raise self._gone()
        return more

    def _gone(self) -> BridgeError:
        self.close()
        return BridgeError("exited", "the client closed the connection", over=True)
