"""How the silhouette engine's time depends on triangles, image size and threads, and what its parts cost.

    python benchmarks/silhouette_speed.py

Prints Markdown. Figures are microseconds per candidate for batches of 70 around one true state, the least of many
interleaved rounds (the machine may be shared; the least is what it takes undisturbed); ratios are within one run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from surgbench.camera import Camera
from surgbench.comparison.workload import silhouette_workload
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.shapes import join_meshes, loft_mesh
from surgbench.instrument.spec import Loft
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.silhouette.contour import place_links, trace
from surgbench.silhouette.spans import cover, total

TRIANGLES = (500, 1_064, 2_000, 5_000, 10_000, 20_000, 50_000)
SIZES = ((350, 246), (700, 493), (1050, 740), (1400, 986))
WIDTHS = (175, 350, 700, 1400, 2800)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view at another resolution."""
    x, y = width / camera.width, height / camera.height
    centre = {"cx": (camera.cx + 0.5) * x - 0.5, "cy": (camera.cy + 0.5) * y - 0.5}
    return camera.model_copy(
        update={"width": width, "height": height, "fx": camera.fx * x, "fy": camera.fy * y, **centre}
    )


def refined(loft: Loft, factor: float) -> Loft:
    """A loft with ``factor`` times the triangles: more sides, and sections interpolated smoothly between its own.

    For fewer triangles it only loses sides.
    """
    along, around = (factor**0.5, factor**0.5) if factor > 1 else (1.0, factor)
    places = np.array([section.at_m for section in loft.sections])
    count = max(2, round(along * (len(places) - 1)) + 1)
    new = np.interp(np.linspace(0, len(places) - 1, count), np.arange(len(places)), places)

    def at(values: list[tuple[float, float]]) -> FloatArray:
        return np.asarray(PchipInterpolator(places, np.array(values))(new), dtype=np.float64)

    radii, centres = at([s.radii_m for s in loft.sections]), at([s.centre_m for s in loft.sections])
    exponent = np.interp(new, places, [s.exponent for s in loft.sections])
    rows = zip(new, radii, centres, exponent, strict=True)
    sections = [{"at_m": z, "radii_m": tuple(r), "centre_m": tuple(c), "exponent": n} for z, r, c, n in rows]
    sides = int(np.clip(round(around * loft.sides), 3, 256))
    return Loft.model_validate({"axis": loft.axis, "sides": sides, "sections": sections})


def refined_instrument(instrument: Instrument, triangles: int) -> Instrument:
    """The instrument with about so many triangles."""
    factor = triangles / sum(len(mesh.faces) for mesh in instrument.meshes.values())
    if factor == 1:
        return instrument
    shapes = {link.name: link.shapes for link in instrument.spec.links if link.shapes}
    return replace(
        instrument,
        meshes={
            name: join_meshes([loft_mesh(refined(loft, factor)) for loft in lofts]) for name, lofts in shapes.items()
        },
    )


def least_us(calls: dict[str, Callable[[], object]], candidates: int, rounds: int) -> dict[str, float]:
    """Least time of each call over interleaved rounds, microseconds per candidate."""
    least = dict.fromkeys(calls, np.inf)
    for call in calls.values():
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            least[name] = min(least[name], time.perf_counter() - start)
    return {name: seconds / candidates * 1e6 for name, seconds in least.items()}


def scorer(instrument: Instrument, camera: Camera, state: FloatArray, states: FloatArray) -> Callable[[], object]:
    """Scores the states against the true state's mask."""
    evaluator = SilhouetteEvaluator([instrument], camera)
    reference = Reference(evaluator.mask(state))
    return lambda: evaluator.sum_over(states, reference)


def stages(evaluator: SilhouetteEvaluator, reference: Reference, states: FloatArray) -> dict[str, Callable[[], object]]:
    """The score cut off after each of its stages."""
    fixed, prefix = evaluator._fixed, reference.prefix
    contour, rows = evaluator._contours[0], evaluator._rows[0]
    counts = np.empty(2, np.int64)

    @compiled
    def kinematics(states: Any, links: Any, contour: Any) -> Any:
        for s in range(states.shape[0]):
            place_links(states[s], links, contour.pose)

    @compiled
    def tracing(states: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any) -> Any:
        for s in range(states.shape[0]):
            trace(states[s], links, bodies, mesh, lens, contour)

    @compiled
    def covering(states: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, rows: Any) -> Any:
        for s in range(states.shape[0]):
            edges = trace(states[s], links, bodies, mesh, lens, contour)
            top, bottom = cover(edges, bodies, contour, rows, lens.width, lens.height, False, False)
            for row in range(top, bottom):
                rows.slot[row] = 2 * row

    @compiled
    def summing(
        states: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any, rows: Any, prefix: Any, counts: Any
    ) -> Any:
        for s in range(states.shape[0]):
            edges = trace(states[s], links, bodies, mesh, lens, contour)
            top, bottom = cover(edges, bodies, contour, rows, lens.width, lens.height, False, False)
            total(top, bottom, lens.width, lens.height, rows, prefix, counts)

    return {
        "forward kinematics": lambda: kinematics(states, fixed[0], contour),
        "projection, facing, contour": lambda: tracing(states, *fixed, contour),
        "spans of the bodies": lambda: covering(states, *fixed, contour, rows),
        "merging and sums": lambda: summing(states, *fixed, contour, rows, prefix, counts),
        "the call from Python": lambda: evaluator.sum_over(states, reference),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=200)
    rounds = parser.parse_args().rounds
    work = silhouette_workload()
    states, count = work.states, len(work.states)
    evaluator = SilhouetteEvaluator([work.instrument], work.camera)
    reference = Reference(work.mask)

    print("| triangles | " + " | ".join(f"{w}x{h}" for w, h in SIZES) + " |\n|---:|" + "---:|" * len(SIZES))
    for triangles in TRIANGLES:
        instrument = refined_instrument(work.instrument, triangles)
        faces = sum(len(mesh.faces) for mesh in instrument.meshes.values())
        calls = {f"{w}x{h}": scorer(instrument, scaled_camera(work.camera, w, h), states[0], states) for w, h in SIZES}
        times = least_us(calls, count, max(10, rounds // 4))
        print(f"| {faces} | " + " | ".join(f"{us:.1f}" for us in times.values()) + " |", flush=True)

    print(f"\n| width at {work.camera.height} rows | us per candidate |\n|---:|---:|")
    calls = {
        str(w): scorer(work.instrument, scaled_camera(work.camera, w, work.camera.height), states[0], states)
        for w in WIDTHS
    }
    for width, us in least_us(calls, count, rounds).items():
        print(f"| {width} | {us:.1f} |")

    print("\n| stage | us per candidate | so far |\n|---|---:|---:|")
    before = 0.0
    for name, us in least_us(stages(evaluator, reference, states), count, rounds).items():
        print(f"| {name} | {us - before:.1f} | {us:.1f} |")
        before = us

    print("\n| what | us per candidate | ratio to score |\n|---|---:|---:|")
    two = SilhouetteEvaluator([work.instrument], work.camera, threads=2)
    calls = {
        "areas and overlaps, one thread": lambda: evaluator.sum_over(states, reference),
        "areas and overlaps, two threads": lambda: two.sum_over(states, reference),
        "and bounding boxes": lambda: evaluator.score(states, reference),
        "gradient": lambda: evaluator.gradient(states, reference),
        "contour points, every 2 px": lambda: [evaluator.contour_points(state) for state in states],
        "contour points, every pixel": lambda: [evaluator.contour_points(state, 1) for state in states],
        "mask": lambda: [evaluator.mask(state) for state in states],
    }
    times = least_us(calls, count, rounds)
    for name, us in times.items():
        print(f"| {name} | {us:.1f} | {us / next(iter(times.values())):.2f} |")


if __name__ == "__main__":
    main()
