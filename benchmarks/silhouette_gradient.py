"""How well the gradient of the silhouette's areas agrees with central differences of a finely supersampled area.

    python benchmarks/silhouette_gradient.py
    python benchmarks/silhouette_gradient.py --states 50 --groups cma-es horizontal --list

Prints Markdown: a row for each group of states and each of two quantities, eq. (6) |S| - 2 |S and M| and the area |S|
alone; below it the time of the gradient beside that of the score. Derivatives are per natural step of the state
(0.01 rad alpha and gamma, 0.1 rad beta, 1 mm, 0.1 rad joints). The truth counts the pixels of a grid ``--factor`` times
finer, mask included, ``--step`` natural steps to either side. A larger step runs over kinks, a smaller one needs a
finer grid.

Groups: masks of states as the generator draws them and candidates around each as a tracker's first generation draws
them (cma-es), or three times as far off (random); the same with the shaft's image along rows or columns (horizontal,
vertical); and pairs of arms (two arms).

A state outside the bound (cosine 0.999, length 1 %) is put down to the first of these that holds:

- sampling: the same gradient computed on a grid 8 times finer is within the bound. Ours samples the contour once a
  pixel line, so that it is up to half a line off wherever the contour of one part disappears behind another.
- kink: the derivatives to the left and to the right differ by more than the bound, and that on the finer grid, averaged
  over the step, is within it. A facet turns edge-on between, and the contour jumps to other edges.
- truth: the differences over the whole and over half the step are not within the bound of each other.
- unexplained: none of them.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.comparison.workload import silhouette_workload
from surgbench.contract import Mask
from surgbench.generators.place import Place, clearance_m
from surgbench.generators.presets import load_preset
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import Reference, RowSums, SilhouetteEvaluator
from surgbench.state import ALPHA, ANGLES, GAMMA, POSITION, StateSpace
from surgbench.suite.environment import environment
from surgbench.tasks.instrument.format import Arm

PRESET = load_preset("paper-wide")
CAMERA = PRESET.camera
INSTRUMENT = load_instrument(PRESET.instrument)
COSINE, LENGTH = 0.999, 0.01
FINER = 8
STATES_PER_MASK = 5
STRIP_BYTES = 256 << 20
QUANTITIES = {"eq. (6)": -2.0, "area": 0.0}  # weight of the overlap beside that of the area, 1
REASONS = ("sampling", "kink", "truth", "unexplained")
# Natural steps between a mask's state and the states held against it: a tracker's first generation, or farther off.
GROUPS = {"cma-es": 1.0, "random": 3.0, "horizontal": 1.0, "vertical": 1.0, "two arms": 1.0}
ROUNDS = 60
# A row's sum of the finer mask fits 16 bits.
MOST_FACTOR = np.iinfo(np.uint16).max // CAMERA.width


def supersampled(camera: Camera, factor: int, first: int = 0, rows: int | None = None) -> Camera:
    """The camera with each pixel cut into ``factor`` squared, or ``rows`` of its rows from ``first`` on."""
    return Camera.model_construct(  # past the limit of an image's size
        width=camera.width * factor,
        height=(camera.height if rows is None else rows) * factor,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=(camera.cx + 0.5) * factor - 0.5,
        cy=(camera.cy - first + 0.5) * factor - 0.5,
    )


class RepeatedRows(RowSums):
    """A mask whose pixels are repeated ``factor`` times in both directions, in memory that is used again."""

    def __init__(self, mask: Mask, factor: int, memory: NDArray[np.uint16]) -> None:
        height, width = mask.shape
        sums = np.zeros((height, width * factor + 1), np.uint16)
        np.cumsum(np.repeat(mask, factor, axis=1), axis=1, out=sums[:, 1:])
        rows = memory[: height * factor]
        rows.reshape(height, factor, -1)[:] = sums[:, None]
        self.prefix = rows


class SupersampledArea:
    """Area and overlap in pixels, to a fraction of a pixel, counted on a finer grid strip by strip.

    Args:
        instruments: One per arm.
        camera: The view.
        factor: How many times finer, up to ``MOST_FACTOR``.
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, factor: int) -> None:
        columns = camera.width * factor + 1
        height = max(1, STRIP_BYTES // (2 * columns * factor))
        self._factor = factor
        self._memory = np.empty((height * factor, columns), np.uint16)
        self._coarse = SilhouetteEvaluator(instruments, camera)
        self._strips = []
        for first in range(0, camera.height, height):
            rows = min(height, camera.height - first)
            strip = SilhouetteEvaluator(instruments, supersampled(camera, factor, first, rows))
            self._strips.append((first, first + rows, strip))

    def __call__(self, states: FloatArray, mask: Mask) -> FloatArray:
        """``(2, N)`` area and overlap of ``(N, 9 * arms)`` states."""
        box = self._coarse.score(states, Reference(mask)).box
        # What the coarse grid has not seen is within a pixel of what it has.
        top, bottom = box[:, 1].min() - 2, box[:, 3].max() + 2
        total = np.zeros((2, len(states)))
        for first, end, strip in self._strips:
            if first < bottom and end > top:
                total += np.array(strip.sum_over(states, RepeatedRows(mask[first:end], self._factor, self._memory)))
        return total / self._factor**2


def compare(truth: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine between ``(..., D)`` gradients, and the second's length relative to the first's, less 1."""
    lengths = np.linalg.norm(truth, axis=-1), np.linalg.norm(gradient, axis=-1)
    return np.sum(truth * gradient, axis=-1) / (lengths[0] * lengths[1]), lengths[1] / lengths[0] - 1.0


def within(truth: FloatArray, gradient: FloatArray) -> NDArray[np.bool_]:
    cosine, length = compare(truth, gradient)
    result: NDArray[np.bool_] = (cosine >= COSINE) & (np.abs(length) <= LENGTH)
    return result


def seen(place: Place, states: FloatArray) -> NDArray[np.bool_]:
    """Which states show the wrist and both tips."""
    tips, wrist = CAMERA.project(place.instrument.tips_cam(states)), CAMERA.project(states[:, POSITION])
    margin_px = PRESET.workspace.tip_margin * CAMERA.height
    shown: NDArray[np.bool_] = CAMERA.contains(tips, margin_px).all(axis=-1) & CAMERA.contains(wrist)
    return shown


def in_workspace(place: Place, rng: np.random.Generator) -> FloatArray:
    """States as the generator draws them."""
    states = place.draw(64, rng)
    drawn: FloatArray = states[place.in_workspace(states) & place.allows(states, PRESET.workspace.tip_margin)]
    return drawn


def along_axis(place: Place, vertical: bool, rng: np.random.Generator) -> FloatArray:
    """The same turned about the viewing direction so that the shaft's image is parallel to rows or columns."""
    states = place.draw(64, rng)
    axis = look_at_rotation(states[:, ANGLES])[..., 2]
    # The image of a direction a at p is horizontal where a_y p_z = a_z p_y, vertical where a_x p_z = a_z p_x.
    across = axis[:, 2] * states[:, 3 if vertical else 4] / states[:, 5]
    rest = 1.0 - axis[:, 2] ** 2 - across**2
    keep = rest > 0
    states, axis, across = states[keep], axis[keep], across[keep]
    along = np.sqrt(rest[keep])
    if vertical:
        x, y = across, along * rng.choice([-1.0, 1.0], len(along))
    else:
        x, y = along, across
    states[:, ALPHA] = -np.arcsin(y)
    states[:, GAMMA] = np.arctan2(x, axis[:, 2])
    turned: FloatArray = states[seen(place, states)]
    return turned


def pairs(left: Place, right: Place, rng: np.random.Generator) -> FloatArray:
    """Two arms that keep their distance."""
    first, second = in_workspace(left, rng), in_workspace(right, rng)
    count = min(len(first), len(second))
    first, second = first[:count], second[:count]
    apart = clearance_m(INSTRUMENT, first, second) >= PRESET.workspace.clearance_m
    both: FloatArray = np.concatenate([first, second], axis=1)[apart]
    return both


def draw_centres(group: str, count: int, rng: np.random.Generator) -> FloatArray:
    """``(count, 9 * arms)`` states whose silhouettes are the masks."""

    def place(arm: Arm) -> Place:
        return Place(arm, PRESET.workspace, CAMERA, INSTRUMENT)

    if group == "two arms":
        draw = partial(pairs, place("left"), place("right"))
    elif group in ("horizontal", "vertical"):
        draw = partial(along_axis, place("left"), group == "vertical")
    else:
        draw = partial(in_workspace, place("left"))
    found = draw(rng)
    while len(found) < count:
        found = np.concatenate([found, draw(rng)])
    return found[:count]


class Check:
    """Gradients of one group of states and their truths.

    Args:
        arms: 1 or 2.
        factor: How many times finer the truth's grid is.
        step: Of the differences, in natural steps.
    """

    def __init__(self, arms: int, factor: int, step: float) -> None:
        instruments = [INSTRUMENT] * arms
        self.space = StateSpace(INSTRUMENT.search_limits, arms=arms)
        self.step = step
        self.evaluator = SilhouetteEvaluator(instruments, CAMERA)
        self._finer = SilhouetteEvaluator(instruments, supersampled(CAMERA, FINER))
        self._areas = SupersampledArea(instruments, CAMERA, factor)

    def gradient(self, states: FloatArray, mask: Mask) -> FloatArray:
        """``(2, N, D)`` of area and overlap."""
        return np.array(self.evaluator.gradient(states, Reference(mask))) * self.space.scale

    def finer_gradient(self, states: FloatArray, reference: Reference) -> FloatArray:
        """The same on the finer grid; ``reference`` is the mask there."""
        return np.array(self._finer.gradient(states, reference)) * self.space.scale / FINER**2

    def differences(self, states: FloatArray, mask: Mask) -> dict[str, FloatArray]:
        """``(2, N, D)`` each: over the step and over half of it, and to the left and to the right only."""
        size = states.shape[1]
        moves = np.concatenate(
            [share * np.diag(self.space.scale) for share in self.step * np.array([1, -1, 0.5, -0.5])]
        )
        moved = states[:, None] + np.concatenate([np.zeros((1, size)), moves])
        values = self._areas(moved.reshape(-1, size), mask).reshape(2, len(states), -1)
        here = values[..., :1]
        ahead, behind, half_ahead, half_behind = np.moveaxis(values[..., 1:].reshape(2, len(states), 4, size), 2, 0)
        return {
            "whole": (ahead - behind) / (2 * self.step),
            "half": (half_ahead - half_behind) / self.step,
            "right": (ahead - here) / self.step,
            "left": (here - behind) / self.step,
        }

    def mean_over_step(self, state: FloatArray, reference: Reference) -> FloatArray:
        """``(2, D)``: each component of the finer gradient averaged over the step along its own axis."""
        shares = (np.arange(32) + 0.5) / 16 - 1.0
        size = len(state)
        moved = state + self.step * shares[:, None, None] * np.diag(self.space.scale)
        gradients = self.finer_gradient(moved.reshape(-1, size), reference).reshape(2, -1, size, size)
        mean: FloatArray = np.einsum("pmdd->pd", gradients) / len(shares)
        return mean

    def reason(self, state: FloatArray, mask: Mask, weights: FloatArray, truths: dict[str, FloatArray]) -> str:
        """Why a state's gradient is outside the bound; ``truths`` are ``(D,)``."""
        reference = Reference(np.repeat(np.repeat(mask, FINER, axis=0), FINER, axis=1))
        if within(truths["whole"], np.tensordot(weights, self.finer_gradient(state[None], reference)[:, 0], 1)):
            return "sampling"
        mean = np.tensordot(weights, self.mean_over_step(state, reference), 1)
        if within(truths["whole"], mean) and not within(truths["left"], truths["right"]):
            return "kink"
        return "truth" if not within(truths["whole"], truths["half"]) else "unexplained"


def rows_of(group: str, options: argparse.Namespace) -> Iterator[str]:
    """Markdown rows of one group, and with ``--list`` a line for each state outside the bound."""
    rng = generator(benchmark="silhouette-gradient", group=group, seed=options.seed)
    check = Check(2 if group == "two arms" else 1, options.factor, options.step)
    centres = draw_centres(group, -(-options.states // STATES_PER_MASK), rng)
    truths: dict[str, list[FloatArray]] = {name: [] for name in QUANTITIES}
    gradients: dict[str, list[FloatArray]] = {name: [] for name in QUANTITIES}
    reasons: dict[str, Counter[str]] = {name: Counter() for name in QUANTITIES}
    remarks = []
    for centre in centres:
        mask = check.evaluator.mask(centre)
        samples = GROUPS[group] * rng.standard_normal((STATES_PER_MASK, len(centre)))
        states = check.space.decode(check.space.encode(centre) + samples)
        gradient, differences = check.gradient(states, mask), check.differences(states, mask)
        for name, overlap_weight in QUANTITIES.items():
            weights = np.array([1.0, overlap_weight])
            ours = np.tensordot(weights, gradient, 1)
            these = {kind: np.tensordot(weights, value, 1) for kind, value in differences.items()}
            truths[name].append(these["whole"])
            gradients[name].append(ours)
            for k in np.flatnonzero(~within(these["whole"], ours)):
                reason = check.reason(states[k], mask, weights, {kind: value[k] for kind, value in these.items()})
                reasons[name][reason] += 1
                cosine, length = compare(these["whole"][k], ours[k])
                state = np.array2string(states[k], precision=6, max_line_width=1000, separator=", ")
                remarks.append(f"  {group}, {name}: {reason}, cosine {cosine:.5f}, length {length:+.2%}: {state}")
    for name in QUANTITIES:
        truth, ours = np.concatenate(truths[name]), np.concatenate(gradients[name])
        cosine, length = compare(truth, ours)
        low, fifth = np.quantile(cosine, [0.01, 0.05])
        median, high, highest = np.quantile(np.abs(length), [0.5, 0.95, 0.99])
        outside = ", ".join(f"{reasons[name][reason]} {reason}" for reason in REASONS if reasons[name][reason])
        yield (
            f"| {group} | {name} | {len(truth)} | {within(truth, ours).mean():.1%} | {(cosine >= COSINE).mean():.1%} | "
            f"{(np.abs(length) <= LENGTH).mean():.1%} | {low:.5f} | {fifth:.5f} | {median:.2%} | {high:.2%} | "
            f"{highest:.2%} | {np.median(np.linalg.norm(truth, axis=1)):.0f} | {outside or '-'} |"
        )
    if options.list:
        yield from remarks


def time_ratio() -> str:
    """Time of the gradient and of the score of the same states, rounds of both in turn."""
    workload = silhouette_workload()
    evaluator = SilhouetteEvaluator([workload.instrument], workload.camera)
    reference = Reference(workload.mask)
    calls: dict[str, Callable[[], object]] = {
        "gradient": partial(evaluator.gradient, workload.states, reference),
        "score": partial(evaluator.score, workload.states, reference),
    }
    best = dict.fromkeys(calls, np.inf)
    for round_ in range(ROUNDS + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            spent = time.perf_counter() - begin
            if round_ > 0:  # the first loads compiled code
                best[name] = min(best[name], spent)
    each = {name: 1e6 * spent / len(workload.states) for name, spent in best.items()}
    return (
        f"Gradient {each['gradient']:.1f} µs a state, score {each['score']:.1f} µs, ratio "
        f"{each['gradient'] / each['score']:.2f} (one thread, {len(workload.states)} states of `surgbench bench "
        f"silhouettes`, least of {ROUNDS} rounds of both in turn; {environment('cpu')['machine']['processor']})."
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=200, metavar="N", help="of each group (default: %(default)s)")
    parser.add_argument("--groups", nargs="+", choices=tuple(GROUPS), default=tuple(GROUPS))
    parser.add_argument("--factor", type=int, default=64, help="of the finer grid (default: %(default)s)")
    parser.add_argument("--step", type=float, default=0.005, help="natural steps to a side (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="list the states outside the bound")
    options = parser.parse_args()
    if not 1 <= options.factor <= MOST_FACTOR:
        parser.error(f"--factor must be from 1 to {MOST_FACTOR}, got {options.factor}")
    print(
        "| states | gradient of | number | within both | cosine ≥ 0.999 | length within 1 % | cosine, 1 % quantile | "
        "5 % | length off, median | 95 % | 99 % | median length, px | outside |"
    )
    print("|---|---|" + "---:|" * 10 + "---|")
    for group in options.groups:
        for row in rows_of(group, options):
            print(row, flush=True)
    print(f"\n{time_ratio()}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
