"""Pictures of the viewpoint task in three dimensions. Needs Matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's, apart for colour-blind eyes too.
WIRE_COLOUR, FREE_COLOUR, CONSTRAINED_COLOUR, ZONE_COLOUR = "#999999", "#0072B2", "#D55E00", "#009E73"
NORMAL_M = 0.02
NORMALS = 40
# Corners of a zone, as NoGoZone.corners has them, that edges join.
EDGES = (
    [(k, (k + 1) % 4) for k in range(4)] + [(4 + k, 4 + (k + 1) % 4) for k in range(4)] + [(k, 4 + k) for k in range(4)]
)


def draw_trial(
    figure: Figure,
    trial: Trial,
    constrained: NDArray[np.bool_] | None = None,
    place: tuple[int, int, int] = (1, 1, 1),
) -> Any:
    """The way of a feature, its normals, and the no-go zone.

    Args:
        figure: To draw in.
        trial: The feature's true way where it is known, else the measured one; and the wire, where there is one.
        constrained: ``(T,)`` bool: where rules speak against the geometrically best pose, drawn in another colour.
        place: Where in the figure, as for ``Figure.add_subplot``.

    Returns:
        The axes, in millimetres from the middle of the zone's base.
    """
    axes = figure.add_subplot(*place, projection="3d")
    zone = NoGoZone(trial.zone_m)
    origin = zone.points[:4].mean(axis=0)

    def mm(points: FloatArray) -> FloatArray:
        return np.asarray(1e3 * (points - origin).T)

    corners = mm(zone.corners)
    for number, edge in enumerate(EDGES):
        axes.plot(*corners[:, edge], color=ZONE_COLOUR, lw=1.0, label=None if number else "no-go zone")
    poses = trial.T_world_feature if trial.truth is None else trial.truth.T_world_feature
    if trial.truth is not None and trial.truth.wire is not None:
        axes.plot(*mm(trial.truth.wire.points_m), color=WIRE_COLOUR, lw=4.0, alpha=0.6, label="wire")
    bad = np.zeros(len(poses), dtype=bool) if constrained is None else np.asarray(constrained, dtype=bool)
    for chosen, colour, label in (
        (~bad, FREE_COLOUR, "ring" if constrained is None else "ring, camera unconstrained"),
        (bad, CONSTRAINED_COLOUR, "ring, camera constrained"),
    ):
        if not chosen.any():
            continue
        way = np.where(chosen[:, None], poses[:, :3, 3], np.nan)
        axes.plot(*mm(way), color=colour, lw=0.8, label=label)
        some = np.flatnonzero(chosen & np.isfinite(poses[:, 0, 0]))
        some = some[:: max(1, len(poses) // NORMALS)]
        ends = poses[some, :3, 3] + NORMAL_M * poses[some, :3, 1]
        for start, end in zip(mm(poses[some, :3, 3]).T, mm(ends).T, strict=True):
            axes.plot(*np.stack([start, end], axis=1), color=colour, lw=0.6, alpha=0.7)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title=f"trial {trial.id}")
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)
    axes.view_init(elev=25, azim=-60)
    return axes
