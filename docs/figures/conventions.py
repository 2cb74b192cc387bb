"""Draws docs/images/conventions-camera.png and conventions-state.png: python docs/figures/conventions.py."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import NDArray

from surgbench.geometry import look_at_rotation
from surgbench.instrument import Instrument, load_instrument

IMAGES = Path(__file__).parents[1] / "images"
X, Y, Z = "#c62828", "#2e7d32", "#1565c0"
INK, GREY, FAINT, MARK = "#263238", "#78909c", "#cfd8dc", "#e65100"
# An oblique look at the camera's frame: z to the right and up, x down to the right, y down.
LOOK = np.array([[0.48, 0.0, 0.86], [-0.28, -1.0, 0.16]])

Points = NDArray[np.float64]


def flat(points: object) -> Points:
    """``(..., 3)`` points of the camera's frame on the paper."""
    return np.asarray(np.asarray(points, dtype=float) @ LOOK.T)


def arrow(axes: Axes, start: object, end: object, colour: str, width: float = 1.8) -> None:
    """From one point of the paper to another."""
    style = {"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 13}
    axes.annotate("", xy=tuple(np.asarray(end)), xytext=tuple(np.asarray(start)), arrowprops=style)


def label(axes: Axes, at: object, text: str, colour: str = INK, **more: object) -> None:
    """Text around a point of the paper."""
    x, y = np.asarray(at, dtype=float)
    axes.text(x, y, text, color=colour, **{"ha": "center", "va": "center", "fontsize": 10, **more})


def frame(axes: Axes, origin: Points, rotation: Points, length: float, names: str = "xyz") -> None:
    """Three arrows and their names."""
    for column, (name, colour) in enumerate(zip(names, (X, Y, Z), strict=True)):
        tip = origin + length * rotation[:, column]
        arrow(axes, flat(origin), flat(tip), colour)
        label(axes, flat(origin + 1.16 * length * rotation[:, column]), name, colour, fontweight="bold")


def turn(axes: Axes, centre: object, radius: float, start: float, end: float, colour: str) -> None:
    """An arc on the paper with an arrow at its end; degrees against the clock."""
    angles = np.radians(np.linspace(start, end, 40))
    points = np.asarray(centre) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes.plot(*points[:-2].T, color=colour, lw=1.6, solid_capstyle="butt")
    arrow(axes, points[-4], points[-1], colour, 1.6)


def draw_camera() -> None:
    """The frame and the projection; the pixels at the top left."""
    figure, (space, pixels) = plt.subplots(1, 2, figsize=(9.6, 4.3), width_ratios=[1.45, 1])
    depth, half = 2.0, np.array([0.8, 0.62])
    corners = np.array([[sx * half[0], sy * half[1], depth] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for corner in corners:
        space.plot(*flat([np.zeros(3), corner]).T, color=FAINT, lw=1, zorder=0)
    space.add_patch(Polygon(flat(corners), facecolor="#eceff1", edgecolor=GREY, lw=1.2, zorder=1))
    frame(space, np.zeros(3), np.eye(3), 0.72)
    label(space, flat([0, 0, 0]) + np.array([-0.12, 0.12]), "camera", ha="right")
    space.plot(*flat([[0, 0, 0.95], [0, 0, depth]]).T, color=Z, lw=1, ls=(0, (4, 3)), zorder=2)
    space.plot(*flat([0, 0, depth]), "o", color=Z, ms=4, zorder=3)
    label(space, flat([0, 0, depth]) + np.array([0.0, -0.13]), "(cx, cy)", Z, fontsize=9)
    seen = np.array([0.34, -0.42, depth])
    point = seen * 1.6
    space.plot(*flat([np.zeros(3), seen]).T, color=MARK, lw=1, zorder=2)
    space.plot(*flat([seen, point]).T, color=MARK, lw=1, zorder=2)
    space.plot(*flat(seen), "o", color=MARK, ms=4, zorder=3)
    space.plot(*flat(point), "o", color=MARK, ms=6, zorder=3)
    label(space, flat(point) + np.array([0, 0.13]), "(x, y, z)", MARK)
    label(space, flat(seen) + np.array([-0.12, 0.13]), "(u, v)", MARK, fontsize=9)
    top = corners[0]
    arrow(space, flat(top), flat(top + np.array([0.5, 0, 0])), INK, 1.2)
    arrow(space, flat(top), flat(top + np.array([0, 0.4, 0])), INK, 1.2)
    label(space, flat(top + np.array([0.3, 0, 0])) + np.array([0.05, 0.1]), "u", fontweight="bold")
    label(space, flat(top + np.array([0, 0.3, 0])) + np.array([-0.09, 0]), "v", fontweight="bold")
    label(space, [1.5, -1.3], "u = fx x/z + cx      v = fy y/z + cy", fontsize=11)
    space.set_xlim(-0.65, 3.5)
    space.set_ylim(-1.45, 1.55)
    space.set_title("OpenCV's frame", fontsize=11)

    for v in range(3):
        for u in range(4):
            first = u == v == 0
            pixels.add_patch(
                Rectangle((u - 0.5, v - 0.5), 1, 1, facecolor="#ffe0b2" if first else "white", edgecolor=GREY)
            )
            pixels.plot(u, v, "o", color=MARK if first else GREY, ms=5 if first else 3)
            label(pixels, [u, v + 0.27], f"({u}, {v})", MARK if first else GREY, fontsize=8.5)
    pixels.plot(-0.5, -0.5, "s", color=INK, ms=4)
    label(pixels, [-0.5, -0.72], "(−0.5, −0.5)", fontsize=8.5)
    arrow(pixels, [0.7, -0.72], [2.2, -0.72], INK, 1.3)
    label(pixels, [2.4, -0.72], "u", fontweight="bold")
    arrow(pixels, [-0.8, 0.3], [-0.8, 1.6], INK, 1.3)
    label(pixels, [-0.8, 1.8], "v", fontweight="bold")
    pixels.set_xlim(-1.15, 3.7)
    pixels.set_ylim(2.75, -1.0)
    pixels.set_title("Pixel centres are whole numbers", fontsize=11)
    save(figure, "conventions-camera.png")


def side(driver: Instrument, joints: tuple[float, float, float], axes: tuple[int, int]) -> dict[str, Points]:
    """Points of an instrument at (0, 0, 0) along z, seen along one of its axes; millimetres, z to the right."""
    state = np.array([0, 0, 0, 0, 0, 0, *joints], dtype=float)
    links = driver.link_transforms(state)
    yaw = links[driver.link_index["yaw"], :3, 3]
    tips = driver.tips_cam(state)
    pick = list(axes)
    return {"yaw": 1000 * yaw[pick], "tips": 1000 * tips[:, pick]}


def bars(axes: Axes, found: dict[str, Points], colour: str, alpha: float) -> None:
    """Shaft, wrist and both jaws as thick lines."""
    wide = {"color": colour, "alpha": alpha, "solid_capstyle": "round"}
    axes.plot([-16, 0], [0, 0], lw=17, **wide)
    axes.plot(*np.stack([np.zeros(2), found["yaw"]]).T, lw=11, **wide)
    for tip in found["tips"]:
        axes.plot(*np.stack([found["yaw"], tip]).T, lw=5, **wide)


def direction(vector: Points) -> float:
    """Degrees of a direction on paper whose second axis goes down."""
    return float(np.degrees(np.arctan2(vector[1], vector[0])))


def draw_state() -> None:
    """Where the wrist is and how the shaft is turned; then each joint."""
    driver = load_instrument("large_needle_driver")
    figure = plt.figure(figsize=(9.6, 6.6))
    grid = figure.add_gridspec(2, 3, height_ratios=[1.25, 1])
    pose = figure.add_subplot(grid[0, :])
    draw_pose(pose)
    pitch, yaw, jaw = (figure.add_subplot(grid[1, column]) for column in range(3))
    # In the shaft's frame the wrist pitch turns about y; the wrist yaw and the jaws, at a pitch of 0, about x.
    shown = (
        (pitch, (2, 0), (0.7, 0.0, 0.1), "q1", "wrist pitch", "x"),
        (yaw, (2, 1), (0.0, 0.7, 0.25), "q2", "wrist yaw", "y"),
        (jaw, (2, 1), (0.0, 0.0, 0.6), "q3", "each jaw from the midline", "y"),
    )
    for axes, plane, joints, name, what, across in shown:
        draw_joint(axes, driver, plane, joints, name, what, across)
    save(figure, "conventions-state.png")


def draw_pose(axes: Axes) -> None:
    """The camera's frame, the wrist's position and the three turns."""
    wrist, rotation = np.array([0.1, 0.5, 2.3]), look_at_rotation(np.array([-0.25, 0.5, 1.15]))
    frame(axes, np.zeros(3), np.eye(3), 0.62)
    label(axes, flat([0, 0, 0]) + np.array([-0.1, 0.1]), "camera", ha="right")
    axes.plot(*flat([np.zeros(3), wrist]).T, color=MARK, lw=1.3, ls=(0, (5, 3)))
    label(axes, flat(wrist * 0.55) + np.array([0.0, -0.15]), "t = (x, y, z)", MARK)
    shaft = np.stack([wrist - 1.3 * rotation[:, 2], wrist])
    axes.plot(*flat(shaft).T, color=FAINT, lw=16, solid_capstyle="round", zorder=0)
    frame(axes, wrist, rotation, 0.62)
    axes.plot(*flat(wrist), "o", color=MARK, ms=6, zorder=5)
    label(axes, flat(shaft.mean(axis=0)) + np.array([0.15, 0.2]), "shaft", GREY)
    text = (
        "R = Ry(γ) Rx(α) Rz(β)\n"
        "γ  turns it about the camera's y: to the side,\n"
        "α  about the x that comes of it: up and down,\n"
        "β  about the shaft itself: its roll.\n\n"
        "The wrist-pitch frame has its origin on the\nwrist-pitch axis, and z along the shaft\ntowards the jaws."
    )
    axes.text(3.4, -0.1, text, fontsize=10, color=INK, va="center", linespacing=1.6)
    axes.set_xlim(-0.6, 5.9)
    axes.set_ylim(-1.05, 0.75)
    axes.set_title("α, β, γ and x, y, z: the wrist-pitch frame in the camera's", fontsize=11)


def draw_joint(
    axes: Axes,
    driver: Instrument,
    plane: tuple[int, int],
    joints: tuple[float, float, float],
    name: str,
    what: str,
    across: str,
) -> None:
    """One joint: straight in a light tone, and turned."""
    straight = side(driver, (0.0, 0.0, 0.0), plane)
    moved = side(driver, joints, plane)
    bars(axes, straight, FAINT, 0.55)
    bars(axes, moved, "#90a4ae", 1.0)
    centre = np.zeros(2) if name == "q1" else moved["yaw"]
    axes.plot(*centre, "o", color=MARK, ms=5, zorder=5)
    axes.plot([centre[0], 23], [0, 0], color=GREY, lw=0.8, ls=(0, (4, 3)))
    aims = moved["tips"] - moved["yaw"]
    if name == "q1":
        turn_between(axes, centre, 6.5, moved["yaw"], name)
    elif name == "q2":
        turn_between(axes, centre, 11.5, aims.mean(axis=0), name)
    else:
        for aim in aims:
            turn_between(axes, centre, 11.0, aim, name)
    down = across == "y"
    arrow(axes, [-15, 12], [-9, 12], Z, 1.5)
    label(axes, [-7.8, 12], "z", Z, fontweight="bold")
    arrow(axes, [-15, 12], [-15, 18], Y if down else X, 1.5)
    label(axes, [-15, 19.6], across, Y if down else X, fontweight="bold")
    axes.set_xlim(-18, 25)
    axes.set_ylim(21, -11)
    axes.set_title(f"{name}: {what}", fontsize=11)


def turn_between(axes: Axes, centre: Points, radius: float, aim: Points, name: str) -> None:
    """An arc from straight on to a direction, and its name beyond its middle."""
    end = direction(aim)
    turn(axes, centre, radius, 0, end, MARK)
    middle = np.radians(end / 2)
    label(axes, centre + (radius + 2.6) * np.array([np.cos(middle), np.sin(middle)]), name, MARK, fontweight="bold")


def save(figure: plt.Figure, name: str) -> None:
    """Without axes, as a PNG on white."""
    for axes in figure.axes:
        axes.set_aspect("equal")
        axes.axis("off")
    figure.tight_layout()
    figure.savefig(
        IMAGES / name, dpi=110, facecolor="white", bbox_inches="tight", pad_inches=0.1, metadata={"Software": None}
    )
    plt.close(figure)


if __name__ == "__main__":
    draw_camera()
    draw_state()
