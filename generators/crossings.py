"""Poses of two arms that cross in the picture, one before the other and clear of it, and poses in which they do not.

Both are searched for in the arms' own coordinates by a cross-entropy method (Rubinstein 1999): the best of a population
are perturbed, less and less. What it minimises is how far centre lines are from where they should be in the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from surgbench.dataset.masks import Mask
from surgbench.generators.coordinates import Coordinates
from surgbench.generators.place import BoolArray, clearance_m
from surgbench.generators.sections import Crossing
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import ANGLES, POSITION

POPULATION = 192
ELITE = 24
GENERATIONS = 14
# From which share of a range perturbations begin, and by how much they lessen each time.
SPREAD = 0.35
SHRINK = 0.75
# Draws looked at for a first population.
DRAWS = 768
# What is looked at of an arm, and half as thick as that is seen.
SHAFT_M = np.linspace(0.0, 0.09, 19)
SHAFT_RADIUS_M = 0.0041
JAW_SHARES = np.linspace(0.2, 1.0, 5)
JAW_RADII_M = np.linspace(0.0032, 0.0012, 5)
# Of the arm behind, how far up the shaft something is to be hidden where wrist and jaws need not be.
PARTLY_M = 0.02
# How far from each other arms are in the picture that do not cross.
APART_M = 0.004
# What a way from one waypoint to the next costs beside a wrong pose, in metres for each longest step.
WAY_M = 2e-4
# Of poses outside the workspace.
OUTSIDE_M = 0.05
# Of wrist and jaws that are to be hidden, what may be seen after all.
SHOWN = 0.03
# Where ways are looked at; the fewest frames that one takes.
WAY_SHARES = np.linspace(0.0, 1.0, 9)
FEWEST_FRAMES = 8
# Places looked at for a small move, and after how many frames arms that stay crossed move on.
NEAR = 96
STAY_MOVES_FRAMES = 20
# How often another arm is behind than the last time, and dead ends after which another start is tried.
SWITCH = 0.25
FAILURES = 30


@dataclass(frozen=True)
class Lines:
    """Centre lines of arms ``(n,)`` in the picture.

    Attributes:
        pixels: ``(n, p, 2)``: shaft first, from the wrist backwards, then the jaws.
        depth_m: ``(n, p)``.
        radius_px: ``(n, p)`` half as thick as the arm is seen there.
        scale: ``(n, p)`` pixels for each metre there.
    """

    pixels: FloatArray
    depth_m: FloatArray
    radius_px: FloatArray
    scale: FloatArray


class Pair:
    """Two arms whose poses are searched together.

    Args:
        arms: Left before right.
        gap_m: Between their centre lines.
    """

    def __init__(self, arms: Sequence[Coordinates], gap_m: float) -> None:
        self.arms = tuple(arms)
        self.gap_m = gap_m
        self._instrument = arms[0].place.instrument
        self._camera = arms[0].place.camera.pinhole
        self._tool = SilhouetteEvaluator([self._instrument.without_shaft], self._camera)
        self._visibility = VisibilityEvaluator([self._instrument] * 2, self._camera)

    def states(self, values: FloatArray) -> FloatArray:
        """``(n, 2, 9)`` of coordinates ``(n, 2, k)``."""
        return np.stack([arm.states(values[:, index]) for index, arm in enumerate(self.arms)], axis=1)

    def allowed(self, ways: FloatArray) -> BoolArray:
        """Which of the ways ``(samples, n, 2, k)`` both arms can go, clear of each other, ``(n,)``."""
        good: BoolArray = np.logical_and(*[arm.leads(ways[:, :, index]) for index, arm in enumerate(self.arms)])
        if good.any():
            left, right = (arm.states(ways[:, good, index]) for index, arm in enumerate(self.arms))
            good[good] = (clearance_m(self._instrument, left, right) >= self.gap_m).all(axis=0)
        return good

    def hidden_m(self, values: FloatArray, behind: int, full: bool) -> FloatArray:
        """How far the arm behind is from being hidden by the other, ``(n,)`` metres at its depth; 0 where it is.

        Args:
            values: ``(n, 2, k)``.
            behind: 0 or 1.
            full: Whether all of wrist and jaws are to be hidden, or something of them or of the shaft's end.
        """
        states = self.states(values)
        back, front = self._lines(states[:, behind]), self._lines(states[:, 1 - behind])
        tool = slice(len(SHAFT_M), None) if full else slice(int(np.searchsorted(-SHAFT_M, -PARTLY_M)), None)
        way = np.linalg.norm(back.pixels[:, tool, None] - front.pixels[:, None], axis=-1)
        covering = way - front.radius_px[:, None]
        # What covers a point must be nearer to the camera than it is.
        covering = np.where(front.depth_m[:, None] < back.depth_m[:, tool, None], covering, np.inf)
        short = (covering.min(axis=2) + back.radius_px[:, tool]) / back.scale[:, tool]
        short = np.minimum(short, OUTSIDE_M).clip(min=0.0)
        needed: FloatArray = short.mean(axis=1) if full else short.min(axis=1)
        return needed

    def shown(self, values: FloatArray, behind: int) -> float:
        """Share of the pixels of an arm's wrist and jaws, at ``(2, k)``, that the other does not hide."""
        states = self.states(values[None])[0]
        tool: Mask = self._tool.mask(states[behind])
        seen = tool & self._visibility.visible_masks(states.ravel())[behind]
        return float(np.count_nonzero(seen) / max(int(np.count_nonzero(tool)), 1))

    def overlap_m(self, values: FloatArray) -> FloatArray:
        """How much farther from each other the arms must be not to cross, ``(n,)`` metres; 0 where they do not."""
        states = self.states(values)
        left, right = self._lines(states[:, 0]), self._lines(states[:, 1])
        way = np.linalg.norm(left.pixels[:, :, None] - right.pixels[:, None], axis=-1)
        free = (way - left.radius_px[:, :, None] - right.radius_px[:, None]) / left.scale[:, :, None]
        overlap: FloatArray = (APART_M - free.min(axis=(1, 2))).clip(min=0.0)
        return overlap

    def steps(self, start: FloatArray, values: FloatArray) -> FloatArray:
        """How many of the longest steps the ways from ``(2, k)`` to ``(n, 2, k)`` are, ``(n,)``."""
        one, other = (arm.steps(start[index], values[:, index]) for index, arm in enumerate(self.arms))
        longer: FloatArray = np.maximum(one, other)
        return longer

    def search(
        self, wrong_m: Callable[[FloatArray], FloatArray], start: FloatArray | None, rng: np.random.Generator
    ) -> FloatArray | None:
        """Coordinates ``(2, k)`` with nothing wrong, near to where the arms are; ``None`` if none were found.

        Args:
            wrong_m: Of ``(n, 2, k)``, what is wrong with them, ``(n,)``; 0 is right.
            start: ``(2, k)`` where they are.
            rng: The only source of randomness.
        """
        drawn = [arm.draw(DRAWS, rng) for arm in self.arms]
        drawn = [one[arm.leads(one[None])][:POPULATION] for arm, one in zip(self.arms, drawn, strict=True)]
        count = min(len(one) for one in drawn)
        if count < ELITE:
            return None
        values = np.stack([one[:count] for one in drawn], axis=1)
        spread = SPREAD * values.std(axis=0)
        if start is not None:
            near = start + spread * rng.standard_normal((count, *start.shape))
            values = np.concatenate([values, near])
        for _ in range(GENERATIONS):
            cost = self._cost(values, wrong_m, start)
            best = np.argsort(cost, kind="stable")[:ELITE]
            values, cost = values[best], cost[best]
            children = values[rng.integers(ELITE, size=POPULATION)]
            values = np.concatenate([values, children + spread * rng.standard_normal(children.shape)])
            spread = spread * SHRINK
        cost = wrong_m(values)
        good = (cost == 0.0) & self.allowed(values[None])
        if not good.any():
            return None
        right = values[good]
        nearest: FloatArray = right[0 if start is None else int(np.argmin(self.steps(start, right)))]
        return nearest

    def _cost(
        self, values: FloatArray, wrong_m: Callable[[FloatArray], FloatArray], start: FloatArray | None
    ) -> FloatArray:
        inside = np.logical_and(*[arm.leads(values[None, :, index]) for index, arm in enumerate(self.arms)])
        states = self.states(values)
        near = (self.gap_m - clearance_m(self._instrument, states[:, 0], states[:, 1])).clip(min=0.0)
        cost: FloatArray = wrong_m(values) + near + np.where(inside, 0.0, OUTSIDE_M)
        return cost if start is None else cost + WAY_M * self.steps(start, values)

    def _lines(self, states: FloatArray) -> Lines:
        wrist = states[:, None, POSITION]
        shaft = wrist - SHAFT_M[:, None] * look_at_rotation(states[:, ANGLES])[:, None, :, 2]
        tips = self._instrument.tips_cam(states)
        jaws = wrist[:, None] + JAW_SHARES[:, None] * (tips - wrist)[:, :, None]
        points = np.concatenate([shaft, jaws.reshape(len(states), -1, 3)], axis=1)
        depth = points[..., 2].clip(min=1e-3)
        scale = self._camera.fx / depth
        radii = np.concatenate([np.full(len(SHAFT_M), SHAFT_RADIUS_M), np.tile(JAW_RADII_M, 2)])
        return Lines(self._camera.project(points), depth, radii * scale, scale)


class Course:
    """Waypoints of both arms as they are found, and how many frames lie between them."""

    def __init__(self, pair: Pair, interval: int, start: FloatArray) -> None:
        self._pair, self._interval = pair, interval
        self.waypoints, self.times = [start], [0]
        self.overlapping = 0

    @property
    def here(self) -> FloatArray:
        """``(2, k)`` the last waypoint."""
        return self.waypoints[-1]

    @property
    def frames(self) -> int:
        """So many are there."""
        return self.times[-1]

    def go(self, end: FloatArray, fewest: int = FEWEST_FRAMES) -> None:
        """Go on to ``(2, k)``, no faster than steps allow."""
        frames = max(fewest, int(np.ceil(self._interval * self._pair.steps(self.here, end[None])[0])))
        way = _way(self.here, end[None], np.arange(1, frames + 1) / frames)[:, 0]
        self.overlapping += int((self._pair.overlap_m(way) > APART_M).sum())
        self.waypoints.append(end)
        self.times.append(self.frames + frames)

    def reaches(self, ends: FloatArray, wrong_m: Callable[[FloatArray], FloatArray] | None = None) -> BoolArray:
        """Which of ``(n, 2, k)`` the arms can go to, with nothing wrong on the way."""
        ways = _way(self.here, ends, WAY_SHARES)
        good = self._pair.allowed(ways)
        if wrong_m is not None and good.any():
            good[good] = (np.stack([wrong_m(one) for one in ways[:, good]]) == 0.0).all(axis=0)
        return good


def crossing_path(
    pair: Pair, settings: Crossing, interval: int, frames: int, rng: np.random.Generator
) -> FloatArray | None:
    """``(frames, 2, k)`` coordinates of arms that cross again and again; ``None`` if no way was found.

    Between crossings they stay apart for so long that ``settings.share`` of the frames so far show an overlap; where
    the ways from one crossing to the next take longer than that, for no longer than these.
    """
    start = pair.search(pair.overlap_m, None, rng)
    if start is None:
        return None
    course, behind, failures = Course(pair, interval, start), int(rng.integers(2)), 0
    while course.frames < frames:
        if failures > FAILURES:
            return None
        if course.overlapping > settings.share * (course.frames + interval // 2):
            if not _wander(pair, course, rng):
                failures += 1
            continue
        if rng.random() < SWITCH:
            behind = 1 - behind
        full = bool(rng.random() < settings.full)
        crossed = pair.search(partial(pair.hidden_m, behind=behind, full=full), course.here, rng)
        if crossed is None or not course.reaches(crossed[None])[0] or (full and pair.shown(crossed, behind) > SHOWN):
            failures += 1
            continue
        course.go(crossed)
        fewest, most = settings.stay_frames
        stay = int(rng.integers(fewest, most, endpoint=True))
        _stay(pair, course, stay, partial(pair.hidden_m, behind=behind, full=full), rng)
        apart = pair.search(pair.overlap_m, course.here, rng)
        if apart is None or not course.reaches(apart[None])[0]:
            # They part later, from another place.
            failures += 1
            continue
        course.go(apart)
    times, waypoints = np.array(course.times, dtype=np.float64), np.array(course.waypoints)
    path: FloatArray = CubicHermiteSpline(times, waypoints, np.zeros_like(waypoints))(
        np.arange(frames, dtype=np.float64)
    )
    return path


def _wander(pair: Pair, course: Course, rng: np.random.Generator) -> bool:
    """Go on without crossing; whether there was a way."""
    ends = _near(pair, course.here, (0.2, 1.0), rng)
    good = course.reaches(ends, pair.overlap_m)
    if good.any():
        course.go(ends[int(np.argmax(good))])
    return bool(good.any())


def _stay(
    pair: Pair, course: Course, frames: int, wrong_m: Callable[[FloatArray], FloatArray], rng: np.random.Generator
) -> None:
    """Stay crossed, moving a little."""
    end = course.frames + frames
    while course.frames < end:
        left = end - course.frames
        ends = _near(pair, course.here, (0.05, 0.3), rng)
        good = course.reaches(ends, wrong_m)
        course.go(ends[int(np.argmax(good))] if good.any() else course.here, min(left, STAY_MOVES_FRAMES))


def _near(pair: Pair, here: FloatArray, scales: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """``(NEAR, 2, k)`` parts of a longest step away, in any direction."""
    ends = []
    for index, arm in enumerate(pair.arms):
        moves = arm.step(here[index], arm.draw(NEAR, rng))
        ends.append(here[index] + rng.uniform(*scales, NEAR)[:, None] * moves)
    return np.stack(ends, axis=1)


def _way(start: FloatArray, ends: FloatArray, shares: FloatArray) -> FloatArray:
    """``(samples, n, 2, k)`` on the ways from ``(2, k)`` to ``(n, 2, k)``."""
    blend = shares * shares * (3.0 - 2.0 * shares)
    way: FloatArray = start + blend[:, None, None, None] * (ends - start)
    return way
