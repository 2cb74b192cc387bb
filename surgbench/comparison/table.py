"""A comparison as a terminal table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surgbench.comparison.peers import PEERS
from surgbench.comparison.silhouettes import OURS, Comparison, Measured
from surgbench.comparison.workload import CANDIDATES

if TYPE_CHECKING:
    from rich.console import Console


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print microseconds a candidate, the ratio to the engine with fewest threads, and the largest disagreement.

    Args:
        comparison: What was measured.
        console: Where to.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    entries = comparison.entries()
    first, camera = comparison.ours[0], comparison.workload.camera
    title = f"{len(comparison.workload.states)} candidates, {camera.width} x {camera.height}, "
    sheet = Table(
        title=Text(f"{title}{comparison.triangles} triangles; {entries[0]['cpu']}"),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
    )
    for heading in ("renderer", "threads", "µs a\ncandidate", "ratio", "differs\npx", "version", "remark"):
        is_text = heading in ("renderer", "version", "remark")
        sheet.add_column(Text(heading), justify="left" if is_text else "right", no_wrap=heading != "remark")
    for one in (*comparison.ours, *sorted(comparison.peers, key=lambda peer: peer.us)):
        is_ours = one.name == OURS
        cells = [
            one.name,
            str(one.threads),
            f"{one.us:.1f}" if one.us < 100 else f"{one.us:.0f}",
            f"{one.us / first.us:.2f}" if is_ours else f"{one.us / first.us:.0f}",
            "" if is_ours else str(first.disagreement_px(one)),
            one.version,
            _remark(one, comparison),
        ]
        sheet.add_row(*(Text(cell, style="bold" if is_ours else "") for cell in cells))
    console.print(sheet)
    if len(comparison.workload.states) < CANDIDATES:
        console.print(Text("few candidates and rounds: not to be quoted"), soft_wrap=True)
    else:
        for entry in entries:
            for line in _summary(entry):
                console.print(Text(line), soft_wrap=True)
    for name, reason in comparison.skipped.items():
        console.print(Text(f"skipped {name}: {reason}", style="yellow"), soft_wrap=True)


def _remark(one: Measured, comparison: Comparison) -> str:
    parts = []
    if one.name == OURS:
        parts.append(f"{one.mask_us:.0f} µs more a mask")
    elif not PEERS[one.name].exact:
        parts.append("not exact")
    if one.remark:
        parts.append(one.remark)
    if one.candidates < len(comparison.workload.states):
        parts.append(f"timed on {one.candidates} candidates")
    return "; ".join(parts)


def _summary(entry: dict[str, object]) -> list[str]:
    if entry["fastest_peer"] is None:
        return []
    threads = f"{entry['threads']} thread{'s' if entry['threads'] != 1 else ''}"
    return [f"{threads}: {entry['speedup_over_fastest_peer']:.0f} x the fastest exact library, {entry['fastest_peer']}"]
