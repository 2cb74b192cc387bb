"""The line to a Dask cluster: its scheduler found, its workers counted, and seen to have the same code."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from surgbench.cluster.same_code import own_code
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.extras import missing

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT_S = 10.0
# Workers of a batch system come when there is room for them.
WORKERS_TIMEOUT_S = 60.0
# The scheduler gives a piece of work up that so many workers did not survive.
DEATHS = 3
GONE = "the cluster's scheduler is gone; run the same command again, it goes on from here"


@contextmanager
def connect(address: str, say: Callable[[str], None] = lambda line: None) -> Iterator[Client]:
    """The cluster whose scheduler is at an address, for the time of the block.

    Args:
        address: As ``dask scheduler`` tells it, for example ``tcp://10.0.0.1:8786``.
        say: Takes a line on what is waited for.

    Raises:
        ConfigError: Dask is not installed, or there is no scheduler at this address.
        SurgbenchError: It has no workers, or one of them has other code of this package.
    """
    lacking = missing(["distributed"])
    if lacking is not None:
        raise ConfigError(f"--scheduler: {lacking}")
    import dask
    from distributed import Client
    from distributed.comm import resolve_address

    # What it would say of workers that come and go is no business of who reads this command's output.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_TIMEOUT_S}s"}):
        try:
            resolve_address(address)  # a client of what is no address cannot even be ended
            client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            raise ConfigError(f"--scheduler {address}: no Dask scheduler answers there ({_line(error)})") from None
        try:
            if not threads(client):
                say(f"waiting for workers of {address}")
                _wait_for_workers(client, address)
            _check_workers(client)
            yield client
        finally:
            client.close(timeout=CONNECT_TIMEOUT_S)


def threads(client: Client) -> int:
    """How much the cluster does at a time, as of now.

    Raises:
        SurgbenchError: The cluster is gone.
    """
    try:
        return sum(client.nthreads().values())
    except (OSError, RuntimeError):
        raise SurgbenchError(GONE) from None


def on_all_workers(client: Client, function: Callable[..., None], *arguments: object) -> None:
    """Have something done by all workers that are there, if any are, and the cluster is."""
    if client.status == "running":
        with contextlib.suppress(OSError, RuntimeError):
            client.run(function, *arguments, on_error="ignore")


def _wait_for_workers(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
    except TimeoutError:
        raise SurgbenchError(
            f"--scheduler {address}: has no workers; start some, one for each core: dask worker {address} --nthreads 1"
        ) from None


def _check_workers(client: Client) -> None:
    expected = own_code()
    try:
        answers = client.run(own_code)
    except Exception as error:  # whatever a stranger's machine lacks
        raise SurgbenchError(f"a worker cannot run surgbench ({_line(error)}); install the same there") from None
    for worker, found in answers.items():
        if found != expected:
            raise SurgbenchError(
                f"{worker} has surgbench {found}, this command {expected}; install the same, and start the worker anew"
            )


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
