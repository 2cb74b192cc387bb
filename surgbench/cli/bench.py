"""``surgbench bench``."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from surgbench.cli.progress import progress

bench_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@bench_app.callback()
def _bench() -> None:
    """Measure parts of the engine beside what one would use instead.

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

    from surgbench.comparison.peers import PEERS
    from surgbench.comparison.silhouettes import QUICK, Effort, compare
    from surgbench.comparison.table import print_comparison

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


@bench_app.command("keypoints")
def keypoints(
    source: Annotated[
        list[str] | None,
        typer.Option("--keypoints", metavar="NAME|FILE.py:Class", help="A source; may be repeated."),
    ] = None,
    masks: Annotated[int, typer.Option(min=1, help="How many.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, help="Of the masks.")] = 0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME.option=value", help="An option; may be repeated.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write metrics, table and pictures of the worst there.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON on standard output: a list of the table's rows.")
    ] = False,
) -> None:
    """Measure keypoint sources on held-out synthetic masks: what they find, how exactly, how fast, where they fail.

    Example: surgbench bench keypoints --keypoints resnet18 --keypoints corners --out keypoints

    Half of the masks are corrupted as datasets are (`published`), the others less, more, or rounded like a segmentation
    network's. Nothing is trained on these masks, nor on these instruments. Pixels are those of a 700 x 493 image.
    """
    from rich.console import Console

    from surgbench.comparison.keypoints import groups, measure
    from surgbench.comparison.keypoints_report import print_groups, write_report
    from surgbench.errors import ConfigError
    from surgbench.generators.tip_masks import HELD_OUT, TipMasks
    from surgbench.instrument import load_instrument
    from surgbench.locks import sole_writer
    from surgbench.registry import create, find
    from surgbench.suite.suites import parse_sets

    options = parse_sets(set_ or [])
    found = [find("keypoints", name) for name in dict.fromkeys(source or ["resnet18", "corners"])]
    names = [one.name for one in found]
    for one in found:
        if one.unavailable is not None:
            raise ConfigError(f"keypoints '{one.name}' cannot run here: {one.unavailable}")
    for name in options:
        if name not in names:
            raise ConfigError(f"--set {name}.…: '{name}' takes no part (taking part: {', '.join(names)})")
    with nullcontext() if out is None else sole_writer(out, "bench"):
        test = TipMasks(HELD_OUT, masks, seed, "test")
        instrument = load_instrument(HELD_OUT.instrument)
        with progress("masks", masks * len(found)) as bar:
            seen = {one.name: measure(create(one, options.get(one.name, {})), test, instrument, bar) for one in found}
        rows = [group for name, answers in seen.items() for group in groups(name, answers)]
        if as_json:
            print(json.dumps([group.row() for group in rows], indent=2, allow_nan=False))
        else:
            print_groups(rows, Console())
        if out is not None:
            words = ["surgbench bench keypoints", *(f"--keypoints {one.name}" for one in found)]
            words += [*(f"--set {text}" for text in set_ or []), f"--masks {masks} --seed {seed}"]
            write_report(out, rows, seen, test, " ".join(words))
            print(out, file=sys.stderr if as_json else sys.stdout)


def _numbers(text: str) -> list[int]:
    from surgbench.errors import ConfigError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--threads {text}: give whole numbers separated by commas, for example 1,2") from None
