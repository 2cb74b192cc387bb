"""How long Python takes to start with surgbench, as multiples of what it takes to do nothing.

    python benchmarks/startup.py [ROUNDS]

Prints Markdown: the least time of each command over the rounds, which take turns, and its ratio to ``python -c pass``.
"""

from __future__ import annotations

import subprocess
import sys
import time

ROUNDS = 15
COMMAND = "import sys; from surgbench.cli import main; sys.argv = ['surgbench', {}]; main()"
PROGRAMS = {
    "pass": "pass",
    "import surgbench": "import surgbench",
    "surgbench --help": COMMAND.format("'--help'"),
    "surgbench run --help": COMMAND.format("'run', '--help'"),
    "surgbench.Camera": "import surgbench; surgbench.Camera",
    "surgbench.InstrumentTracker": "import surgbench; surgbench.InstrumentTracker",
    "surgbench.leaderboard": "import surgbench; surgbench.leaderboard",
    "import pandas": "import pandas",
}


def seconds(program: str) -> float:
    """Wall time of a Python of its own."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - begin


def main() -> None:
    """Measure and print."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else ROUNDS
    least = dict.fromkeys(PROGRAMS, float("inf"))
    for _ in range(rounds):
        for name, program in PROGRAMS.items():
            least[name] = min(least[name], seconds(program))
    print("| | ms | × `pass` |\n|---|---:|---:|")
    for name, found in least.items():
        print(f"| `{name}` | {1000 * found:.0f} | {found / least['pass']:.1f} |")


if __name__ == "__main__":
    main()
