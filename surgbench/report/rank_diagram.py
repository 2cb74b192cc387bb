"""Mean ranks on a line, with bars that join rows that are not told apart. Needs Matplotlib.

As in Demšar, JMLR 7 (2006), Fig. 1: whose mean ranks are less than the critical difference apart are joined.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surgbench.errors import ConfigError, SurgbenchError
from surgbench.files import write_atomic
from surgbench.report.comparison_tables import heading, p_text
from surgbench.report.figures import check_matplotlib
from surgbench.report.paired_tests import Comparison, Ranks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENDINGS = (".png", ".svg")
DPI = 150
# Inches.
WIDTH, ROW_HEIGHT, HEAD_HEIGHT = 7.2, 0.24, 1.2


def draw_ranks(comparisons: Sequence[Comparison], path: Path) -> None:
    """Draw every comparison that has ranks, one below the other.

    Args:
        comparisons: From :func:`surgbench.report.comparison.compare_records`.
        path: Where to, ``.png`` or ``.svg``.

    Raises:
        ConfigError: Another ending.
        SurgbenchError: Nothing has ranks, Matplotlib is missing, or the file cannot be written.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ConfigError(f"{path}: a diagram is a file that ends in {' or '.join(ENDINGS)}")
    drawn = [(one, one.ranks) for one in comparisons if one.ranks is not None]
    if not drawn:
        raise SurgbenchError("no diagram of ranks: it takes three rows, and two sequences that all of them have")
    check_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    heights = [HEAD_HEIGHT + ROW_HEIGHT * (_half(ranks) + len(cliques(ranks))) for _, ranks in drawn]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    panels = figure.subplots(len(drawn), squeeze=False, height_ratios=heights)[:, 0]
    for axes, (one, ranks) in zip(panels, drawn, strict=True):
        _draw(axes, heading(one), ranks)
    content = io.BytesIO()
    # Text stays text in SVG, and the same comparison gives the same file.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "surgbench"}):
        metadata = {"Date": None} if path.suffix.lower() == ".svg" else {}
        figure.savefig(content, format=path.suffix[1:].lower(), dpi=DPI, metadata=metadata)
    try:
        write_atomic(path, content.getvalue())
    except OSError as error:
        raise SurgbenchError(f"{path}: cannot be written ({error.strerror})") from None


def cliques(ranks: Ranks) -> list[tuple[float, float]]:
    """First and last mean rank of each largest set of rows that are less than the critical difference apart.

    Example:
        >>> from surgbench.report.paired_tests import Ranks
        >>> from surgbench.report.rank_diagram import cliques
        >>> cliques(Ranks(10, {"a": 1.2, "b": 1.8, "c": 3.0}, 0.001, 1.3))
        [(1.2, 1.8), (1.8, 3.0)]
    """
    means = sorted(ranks.mean.values())
    ends = [max(other for other in means if other - mean < ranks.critical_difference) for mean in means]
    found = dict.fromkeys(zip(means, ends, strict=True))
    return [
        (first, last)
        for first, last in found
        if last > first and not any(a <= first and last <= b and (a, b) != (first, last) for a, b in found)
    ]


def _half(ranks: Ranks) -> int:
    return (len(ranks.mean) + 1) // 2


def _draw(axes: Axes, title: str, ranks: Ranks) -> None:
    """Ranks along the top, names down both sides, the better half on the left."""
    count = len(ranks.mean)
    names = sorted(ranks.mean, key=lambda name: (ranks.mean[name], name))
    joined = cliques(ranks)
    first_name = len(joined) + 1.0
    margin = 0.9 * (count - 1)
    axes.set_xlim(1 - margin, count + margin)
    axes.set_ylim(first_name + _half(ranks), -2.6)
    axes.axis("off")
    axes.plot([1, count], [0, 0], color="black", linewidth=1)
    for place in range(1, count + 1):
        axes.plot([place, place], [0, -0.3], color="black", linewidth=1)
        axes.text(place, -0.45, str(place), ha="center", va="bottom", fontsize=8)
    reach = min(ranks.critical_difference, count + margin - 1)
    axes.plot([1, 1 + reach], [-1.6, -1.6], color="black", linewidth=1.5, marker="|", clip_on=False)
    axes.text(1 + reach, -1.6, f"  critical difference {ranks.critical_difference:.2f}", va="center", fontsize=8)
    for level, (low, high) in enumerate(joined, start=1):
        # Hardly beyond the first and the last, or a bar would touch a row that it does not join.
        ends = [low - 0.004 * count, high + 0.004 * count]
        axes.plot(ends, [level - 0.35] * 2, color="#0072B2", linewidth=3.5, solid_capstyle="butt")
    for place, name in enumerate(names):
        left = place < _half(ranks)
        height = first_name + (place if left else count - 1 - place)
        end = 1 - 0.08 * count if left else count + 0.08 * count
        axes.plot([ranks.mean[name], ranks.mean[name], end], [0, height, height], color="black", linewidth=0.8)
        text = f"{name}  {ranks.mean[name]:.2f} " if left else f" {ranks.mean[name]:.2f}  {name}"
        axes.text(end, height, text, ha="right" if left else "left", va="center", fontsize=8, parse_math=False)
    told = f"mean ranks over {ranks.sequences} sequences, Friedman p {p_text(ranks.p)}"
    axes.set_title(f"{title}\n{told}", fontsize=9, parse_math=False)
