"""The course of a training as a picture; needs the extra ``plots``."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path

from surgbench.files import write_atomic
from surgbench.report.frame import read_csv
from surgbench.trackers.keypoints.heatmaps.training import FIELDS


def draw_curve(log: Path, out: Path) -> bool:
    """Draw the losses, and what is found on the validation masks, over the epochs.

    Args:
        log: ``log.csv`` of a training.
        out: The PNG file.

    Returns:
        Whether it was drawn: without Matplotlib it is not.
    """
    if find_spec("matplotlib") is None:
        return False
    from matplotlib.figure import Figure

    table = read_csv(log.read_text(encoding="utf-8"), FIELDS)
    epochs = (table["epoch"] + 1).tolist()

    def column(key: str) -> list[float]:
        return [float(value) for value in table[key]]

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    losses, shares, errors = figure.subplots(1, 3)
    for key in ("training_loss", "validation_loss"):
        losses.plot(epochs, column(key), marker=".", label=key.replace("_", " "))
    for key in ("detected_percent", "false_pair_percent"):
        shares.plot(epochs, column(key), marker=".", label=key.replace("_percent", " %").replace("_", " "))
    for key in ("median_error_px", "p95_error_px"):
        errors.plot(
            epochs, column(key), marker=".", label=key.replace("_error_px", " error, px").replace("p95", "95 %")
        )
    losses.set_yscale("log")
    for axes, title in ((losses, "loss"), (shares, "validation masks"), (errors, "validation masks")):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("epoch")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomic(out, picture.getvalue())
    return True
