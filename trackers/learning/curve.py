"""The course of a training as a picture; needs the extra ``plots``."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path

from surgbench.files import write_atomic
from surgbench.report.frame import read_csv
from surgbench.trackers.learning.course import log_fields


def draw_curve(log: Path, out: Path, measures: Iterable[str], what: str, *panels: Mapping[str, str]) -> bool:
    """Draw the losses, and what is found on the validation examples, over the epochs.

    Args:
        log: ``log.csv`` of a training.
        out: The PNG file.
        measures: All that is in it, in its order.
        what: The validation examples, in words.
        panels: Measures that are drawn into one panel, and what they are called there.

    Returns:
        Whether it was drawn: without Matplotlib it is not.
    """
    if find_spec("matplotlib") is None:
        return False
    from matplotlib.figure import Figure

    table = read_csv(log.read_text(encoding="utf-8"), log_fields(*measures))
    epochs = (table["epoch"] + 1).tolist()
    losses = {key: key.replace("_", " ") for key in ("training_loss", "validation_loss")}
    figure = Figure(figsize=(3 * (1 + len(panels)), 3.2), layout="constrained")
    columns = figure.subplots(1, 1 + len(panels), squeeze=False)[0]
    for axes, panel in zip(columns, (losses, *panels), strict=True):
        for key, label in panel.items():
            axes.plot(epochs, [float(value) for value in table[key]], marker=".", label=label)
        axes.set_title("loss" if panel is losses else what, fontsize=10)
        axes.set_xlabel("epoch")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    columns[0].set_yscale("log")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomic(out, picture.getvalue())
    return True
