"""Memory of a worker that makes images: ``python benchmarks/image_memory.py [--preset endoscope] [--frames 400]``.

One worker's frames, masks and images, one after the other in this process, of a small camera, since what would pile up
does so for each frame and not for each pixel. Prints the resident set every so many frames, and its slope over the last
three quarters in MB for 1000 frames, by least squares. The files go to a folder that is removed. Linux alone.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from surgbench.generators.frames import Chunk, FrameWriter
from surgbench.generators.generate import plan_dataset
from surgbench.generators.looks.variants import pick
from surgbench.generators.presets import load_preset
from surgbench.generators.sequence import make_tables


def resident_mb() -> float:
    """Resident set of this process, MB of 10^6 bytes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="endoscope")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--width", type=int, default=160, help="of the images, pixels; the height is three quarters")
    parser.add_argument("--samples", type=int, default=1, help="rays a pixel")
    parser.add_argument("--variant", default="auto")
    parser.add_argument("--every", type=int, default=50, help="frames between two lines")
    args = parser.parse_args()
    width, height = args.width, args.width * 3 // 4
    camera = {"width": width, "height": height, "fx": 1.3 * width, "fy": 1.3 * width}
    camera |= {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
    variant = pick(args.variant)
    settings = {"images.samples": args.samples, "images.variant": variant, "camera": camera}
    preset = load_preset(args.preset, pairs=1, frames=args.frames, settings=settings)
    plan = plan_dataset(preset)
    entry = plan.sequences[0]
    made = make_tables(preset, entry, plan.real_instrument, plan.real_camera)
    sizes: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        writer = FrameWriter(preset, plan.real_instrument, plan.real_camera, Path(folder), 1, None, variant)
        for frame in range(entry.frames):
            writer.render(Chunk(entry, frame, made.states[frame : frame + 1], {}, made.apart, made.look))
            sizes.append(resident_mb())
            if frame % args.every == 0 or frame == entry.frames - 1:
                print(f"frame {frame:5d}: {sizes[-1]:8.1f} MB, {time.process_time():7.1f} s", flush=True)
    settled = np.arange(len(sizes) // 4, len(sizes))
    slope = np.polyfit(settled, np.array(sizes)[settled], 1)[0] * 1000
    print(f"{variant}, {width}x{height}: {slope:+.1f} MB for 1000 frames")


if __name__ == "__main__":
    main()
