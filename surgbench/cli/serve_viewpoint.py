"""``surgbench serve-viewpoint``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surgbench.cli.carry_out import carry_out

if TYPE_CHECKING:
    import socket

# The tracker whose commands come over the bridge.
REMOTE = "remote"


def serve_viewpoint(
    asked: dict[str, Any],
    dataset: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Score the client: run it on this dataset's trials.")
    ] = None,
    tracker: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE.py:Class", help="Command the client's arm: this controller answers it."),
    ] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Of TCP; 0 for any that is free.")] = None,
    socket_: Annotated[Path | None, typer.Option("--socket", metavar="PATH", help="A Unix socket instead.")] = None,
    host: Annotated[str, typer.Option(help="Who may connect: nobody but this machine, unless told.")] = "127.0.0.1",
    wait: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="With --dataset: how long a client is waited for.")
    ] = 60.0,
    timeout: Annotated[
        float, typer.Option(min=0.01, metavar="S", help="With --dataset: longest wait for an answer.")
    ] = 5.0,
    name: Annotated[
        str | None, typer.Option(help="With --dataset: the row's, instead of the client's name for itself.")
    ] = None,
    sequences: Annotated[int | None, typer.Option(min=1, metavar="N", help="Only N trials, spread.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, metavar="N", help="Only the first N steps of each.")] = None,
    repeats: Annotated[int | None, typer.Option(min=1, help="Runs per trial, each with its own seed.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Default: 0.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME.option=value", help="With --tracker: an option; may be repeated."),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Run everything again; records are replaced.")] = False,
    clients: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="With --tracker: end after N clients.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="With --dataset: folder of records.")] = Path("runs"),
) -> None:
    """Score a camera controller of another process or language; or have ours command another's arm.

    Example: surgbench serve-viewpoint --dataset data/chaser --port 5555

    Example: surgbench serve-viewpoint --tracker gaze --port 5555

    JSON lines over a local socket, docs/viewpoint-bridge.md; a client is examples/viewpoint_client.py. With
    --dataset the client answers every step of every trial, and records are those of surgbench run. Time stands still
    while it thinks. Where it hangs up, says nothing in time or no command, the simulated arm comes to rest and stays,
    and the row says so.
    """
    from surgbench.errors import ConfigError
    from surgbench.viewpoint.bridge.hub import listen

    if (dataset is None) == (tracker is None):
        raise ConfigError("say either --dataset DIR (the client controls) or --tracker NAME (we control), not both")
    if (port is None) == (socket_ is None):
        raise ConfigError("say either --port PORT or --socket PATH, not both")
    with listen(host, port or 0, socket_) as listener:
        try:
            if tracker is not None:
                _command(listener, tracker, set_ or [], asked, clients)
                return
            assert dataset is not None
            row = {**asked, "sequences": sequences, "frames": frames}
            conditions = {"seed": seed, "repeats": repeats}
            _score(listener, dataset, row, conditions, name, (wait, timeout), set_ or [], again, out)
        finally:
            if socket_ is not None:
                socket_.unlink(missing_ok=True)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _command(
    listener: socket.socket, tracker: str, sets: list[str], asked: dict[str, Any], clients: int | None
) -> None:
    """Answer clients with a controller's commands."""
    from surgbench.errors import ConfigError
    from surgbench.registry import configure, create, find
    from surgbench.suite.suites import parse_sets
    from surgbench.viewpoint.bridge.hub import place_of
    from surgbench.viewpoint.bridge.service import serve

    found, options = find("tracker", tracker), parse_sets(sets)
    if found.task != find("tracker", REMOTE).task or getattr(found.cls, "elsewhere", False):
        raise ConfigError(f"tracker '{found.name}' commands no camera")
    if getattr(found.cls, "foresees", False):
        raise ConfigError(f"tracker '{found.name}' must be told the future, which no client knows")
    if found.unavailable is not None:
        raise ConfigError(f"tracker '{found.name}' cannot run here: {found.unavailable}")
    for name in (*options, *asked):
        if name != found.name:
            raise ConfigError(f"'{name}' takes no part where '{found.name}' commands")
    chosen = options.get(found.name, {})
    configure(found, chosen)
    _say(f"'{found.name}' answers at {place_of(listener)}")
    serve(listener, lambda: create(found, chosen), _say, clients)


def _score(
    listener: socket.socket,
    folder: Path,
    row: dict[str, Any],
    conditions: dict[str, Any],
    name: str | None,
    patience_s: tuple[float, float],
    sets: list[str],
    again: bool,
    out: Path,
) -> None:
    """Run a dataset's trials with a client as controller."""
    from surgbench.dataset.open import open_dataset
    from surgbench.errors import ConfigError
    from surgbench.registry import find
    from surgbench.suite.plan import complete_all
    from surgbench.suite.plan import jobs as plan_jobs
    from surgbench.suite.run import check_output
    from surgbench.suite.running import Run
    from surgbench.suite.suites import from_command_line
    from surgbench.viewpoint.bridge.hub import Hub
    from surgbench.viewpoint.simulator import REPORT_EVERY

    if sets:
        raise ConfigError("--set is for --tracker; a client has its options from elsewhere")
    data = open_dataset(folder)
    if data.task != find("tracker", REMOTE).task:
        raise ConfigError(f"'{data.name}' is of the {data.task} task, in which no camera is commanded")
    check_output(out)
    wait_s, answer_s = patience_s
    under_way: list[Run] = []

    def stop() -> None:
        for one in under_way:
            one.stop()

    hub = Hub(listener, wait_s, _say, stop)
    client = hub.client()
    # The process of a trial tells of itself every so many steps.
    silence_s = wait_s + (REPORT_EVERY + 2) * answer_s + 60.0
    options = {REMOTE: {"client": client.name, "version": client.version, "patience_s": answer_s}}
    row = {**row, "row_id": name or client.name, "options": options}
    suite = from_command_line(None, [REMOTE], row, {**conditions, "timeout_s": silence_s})
    with hub.handing_out():
        planned = [job for one in complete_all(suite.rows, suite, data, {}) for job in plan_jobs(one, data)]
        try:
            if not carry_out(planned, data, out, again=again, begins=under_way.append):
                raise typer.Exit(1)
        finally:
            hub.bye()
    if hub.missing is not None:
        _say(f"{hub.missing}; the same command again goes on from here")
        raise typer.Exit(1)
