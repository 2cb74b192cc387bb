"""How alike the simulated hand and AutoCam's users are, and a picture of where it leads the ring.

    surgbench generate wire-chaser --out data/wire-chaser
    python benchmarks/wire_chaser.py data/wire-chaser --picture docs/images/wire-chaser.png

Prints Markdown, a row for each figure, with AutoCam's beside it (docs/viewpoint-data.md). The picture, of the first
two trials, needs Matplotlib.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from surgbench.dataset.open import open_as
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.draw import draw_trial
from surgbench.viewpoint.motion import describe_motion
from surgbench.viewpoint.registration import register, residual_m
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial

ROWS = (
    ("duration_s", "duration [s]", "74.3 ± 17.4"),
    ("mean_speed_mm_s", "mean speed [mm/s]", "4 to 7"),
    ("speed_mm_s_percentiles", "speed of moving samples [mm/s], 10/50/90/99 %, mean", "4 / 9 / 31 / 120, 15.6"),
    ("turn_deg_s_percentiles", "turning of the normal, the same samples [°/s]", "0.8 / 11.5 / 63 / 242"),
    ("moving_percent", "moving [%]", "30 in tests, unknown in trials"),
    ("extent_long_mm", "way along its longest principal axis [mm]", "60 to 93"),
    ("extent_middle_mm", "along its middle one [mm]", "33 to 37"),
    ("extent_short_mm", "along its shortest one [mm]", "36 to 38"),
    ("contacts", "contacts", "24.5 ± 6.4"),
    ("contact_s", "in contact [s]", "34.9 ± 14.8"),
    ("constrained_percent", "constrained samples [%]", "39.6"),
)


def registrations(trials: list[Trial]) -> dict[str, tuple[float, float]]:
    residuals = {
        method: [1e3 * residual_m(register(one.T_world_base, one.touches, method), one.touches) for one in trials]
        for method in ("translation", "rigid")
    }
    return {name: (min(values), max(values)) for name, values in residuals.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--picture", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    dataset = open_as(ViewpointDataset, arguments.dataset)
    trials = [dataset.trial(trial.id) for trial in dataset.trials]
    figures = describe_motion(trials)
    print(f"| | {dataset.name} | AutoCam |\n|---|---|---|")
    for name, label, published in ROWS:
        values = figures[name]
        own = f"{values[0]:.1f} ± {values[1]:.1f}"
        if len(values) > 2:
            own = f"{' / '.join(f'{value:.1f}' for value in values[:-1])}, {values[-1]:.1f}"
        print(f"| {label} | {own} | {published} |")
    for (method, (low, high)), published in zip(
        registrations(trials).items(), ("3.3 to 7.6", "1.6 to 3.6"), strict=True
    ):
        print(f"| residual of a {method} registration [mm] | {low:.1f} to {high:.1f} | {published} |")
    if arguments.picture:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(11.0, 4.6))
        FigureCanvasAgg(figure)
        for number, trial in enumerate(trials[:2]):
            constrained = np.asarray(naive_violations(trial, make_scene(trial)).any)
            axes = draw_trial(figure, trial, constrained, (1, min(len(trials), 2), number + 1))
            if number == 0:
                figure.legend(*axes.get_legend_handles_labels(), loc="lower center", ncols=4, frameon=False)
        figure.subplots_adjust(left=0.0, right=0.96, bottom=0.06, top=0.93, wspace=0.05)
        figure.savefig(arguments.picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
