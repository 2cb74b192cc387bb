"""What a second core brings: the same work with one process and with several, in turns.

    python benchmarks/throughput.py --rounds 3

Times whole commands as they are typed, their start-up, planning and last writing included: `surgbench generate` of a
preset, and `surgbench run` of a tracker on what came of it. Every round does both numbers of jobs, in new folders;
the order changes from round to round. Numba's cache is warmed by a run of a few frames first. The ratio of a round is
time with one job over time with several; the figure is the median over rounds.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def seconds(*arguments: str) -> float:
    """Wall time of one command."""
    start = time.monotonic()
    subprocess.run([sys.executable, "-m", "surgbench", *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--pairs", type=int, default=4, help="pairs of the preset: sequences of the dataset")
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--tracker", default="cmaes")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only-generate", action="store_true", help="do not run a tracker on what is made")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="where the folders go; a temporary one")
    asked = parser.parse_args()
    where = Path(tempfile.mkdtemp(dir=asked.out, prefix="throughput-"))
    size = ("--sequences", str(asked.pairs), "--frames", str(asked.frames))
    try:
        seconds("generate", asked.preset, "--sequences", "1", "--frames", "20", "--out", str(where / "warm"))
        seconds("run", "--dataset", str(where / "warm"), "--tracker", asked.tracker, "--out", str(where / "warm-runs"))
        times: dict[str, dict[int, list[float]]] = {}
        for number in range(asked.rounds):
            for jobs in (1, asked.jobs) if number % 2 == 0 else (asked.jobs, 1):
                data, runs = where / f"data-{number}-{jobs}", where / f"runs-{number}-{jobs}"
                with_jobs = ("--jobs", str(jobs))
                made = seconds("generate", asked.preset, *size, "--out", str(data), *with_jobs)
                times.setdefault("generate", {}).setdefault(jobs, []).append(made)
                if not asked.only_generate:
                    run = ("run", "--dataset", str(data), "--tracker", asked.tracker, "--out", str(runs))
                    times.setdefault("run", {}).setdefault(jobs, []).append(seconds(*run, *with_jobs))
                    shutil.rmtree(runs)
                shutil.rmtree(data)
    finally:
        shutil.rmtree(where)
    print(f"{asked.preset}, {asked.pairs} pairs of {asked.frames} frames, {asked.tracker}; {asked.rounds} rounds")
    print("| command | one job [s] | " + f"{asked.jobs} jobs [s] | ratio, median | least | largest |")
    print("|---|---:|---:|---:|---:|---:|")
    for command, of in times.items():
        ratios = [one / several for one, several in zip(of[1], of[asked.jobs], strict=True)]
        cells = [statistics.median(of[1]), statistics.median(of[asked.jobs])]
        print(
            f"| `{command}` | {cells[0]:.1f} | {cells[1]:.1f} | {statistics.median(ratios):.2f} "
            f"| {min(ratios):.2f} | {max(ratios):.2f} |"
        )


if __name__ == "__main__":
    main()
