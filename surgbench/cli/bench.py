"""``surgbench bench``."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer

from surgbench.cli.progress import progress

bench_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@bench_app.callback()
def _bench() -> None:
    """Measure the engine beside what one would use instead.

    Example: surgbench bench silhouettes
    """


@bench_app.command("silhouettes")
def silhouettes(
    threads: Annotated[
        str, typer.Option(metavar="N,...", help="Threads of the engine, one measurement each; peers have one.")
    ] = "1,2",
    peers: Annotated[str | None, typer.Option(metavar="NAME,...", help="Only these peers; default: all.")] = None,
    rounds: Annotated[
        int | None, typer.Option(min=1, help="Turns of each renderer, of which the median counts; default: 15.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few candidates and rounds, not to be quoted.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON on standard output: a list with an entry for each number of threads.")
    ] = False,
) -> None:
    """Time the silhouette engine and other renderers on the same candidates and mask.

    Example: surgbench bench silhouettes --json > silhouettes.json

    Each computes the area of a candidate's silhouette and its overlap with the mask, in microseconds a candidate.
    They take turns in one run, each in a process of its own on one core. Their masks are compared pixel by pixel.
    Peers that aren't there are skipped with the reason; most come with pip install 'surgbench[bench]'.
    """
    from dataclasses import replace

    from surgbench.bench.peers import PEERS
    from surgbench.bench.silhouettes import QUICK, Effort, compare
    from surgbench.bench.table import print_comparison

    effort = QUICK if quick else Effort()
    if rounds is not None:
        effort = replace(effort, rounds=rounds)
    names = list(PEERS) if peers is None else [name.strip() for name in peers.split(",") if name.strip()]
    with progress("rounds", effort.rounds) as bar:
        comparison = compare(_numbers(threads), names, effort, bar, bar.stage)
    if as_json:
        print(json.dumps(comparison.entries(), indent=2, ensure_ascii=False, allow_nan=False))
        for name, reason in comparison.skipped.items():
            print(f"skipped {name}: {reason}", file=sys.stderr)
        return
    from rich.console import Console

    print_comparison(comparison, Console())


def _numbers(text: str) -> list[int]:
    from surgbench.errors import ConfigError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--threads {text}: give whole numbers separated by commas, for example 1,2") from None
