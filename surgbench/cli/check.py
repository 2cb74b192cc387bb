"""``surgbench check``: whether a tracker keeps the rules that the suite relies on."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from surgbench.cli.completion import plugins

if TYPE_CHECKING:
    from surgbench.conformance.checks import Outcome


def tracker(
    reference: Annotated[
        str, typer.Argument(metavar="NAME|FILE.py:Class", help="A tracker.", autocompletion=plugins("tracker"))
    ],
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME.option=value", help="An option; may be repeated.")
    ] = None,
    budget: Annotated[float, typer.Option(min=0, metavar="S", help="Longest step after warm-up.")] = 10.0,
    timeout: Annotated[float, typer.Option(min=5, metavar="S", help="Longest wait for a reset or a step.")] = 120.0,
    as_json: Annotated[bool, typer.Option("--json", help="A list of outcomes instead of lines.")] = False,
) -> None:
    """Run a tracker on small scenes of all kinds, and say which rules it keeps.

    Example: surgbench check tracker path/mine.py:MineTracker --set mine.samples=20

    Same seed same result, shapes, limits, time, no global randomness, odd masks, missing input, one arm and two, going
    on in another process (docs/trackers.md). No dataset is needed. The exit code is 1 if a check failed.
    FILE.py:Class runs that file with your rights.
    """
    from surgbench.conformance.checks import checks_of
    from surgbench.conformance.conduct import conduct
    from surgbench.conformance.subject import Subject
    from surgbench.errors import ConfigError
    from surgbench.registry import configure, find
    from surgbench.suite.suites import parse_sets

    found = find("tracker", reference)
    options = parse_sets(set_ or [])
    for name in options:
        if name != found.name:
            raise ConfigError(f"--set {name}.…: '{name}' takes no part in this check (taking part: {found.name})")
    chosen = options.get(found.name, {})
    configure(found, chosen)
    reason = found.unavailable
    if reason is not None:
        print("[]" if as_json else f"{found.name} cannot run here: {reason}")
        return
    if not checks_of(Subject(reference)):
        raise ConfigError(f"the {found.task} task has no checks")
    outcomes = conduct(
        Subject(reference, chosen, budget), timeout, report=(lambda _: None) if as_json else _print_outcome
    )
    if as_json:
        print(json.dumps([{"check": o.check, "status": o.status, "message": o.message} for o in outcomes], indent=2))
    failed = sum(outcome.status == "FAILED" for outcome in outcomes)
    if not as_json:
        print(f"{found.name}: " + (f"{failed} check{'s' * (failed > 1)} failed" if failed else "keeps the rules"))
    if failed:
        raise typer.Exit(1)


def _print_outcome(outcome: Outcome) -> None:
    print(f"{outcome.status:8} {outcome.check:22} {outcome.message}".rstrip(), flush=True)
