"""Whether ``kill -9`` at any moment loses, doubles or changes anything, once the same command has ended well.

    python benchmarks/kills.py                       # 50 kills each of generate, run, import and train
    python benchmarks/kills.py run --kills 5 --seed 1

Each command is first run undisturbed, twice, which must give the same. Then, in a new folder, it is killed up to
four times in a row, after a time drawn over how long it takes undisturbed: the command alone, whose workers have to
notice, or all of its group. Then the same command must end well, and the folder hold what the undisturbed one does:
the same files and no others, datasets and models to the last byte, records and logs but for their times. Records that
a killed call had written must stay as they were, and no process or file may be left anywhere. Says so trial by trial
on standard error, at the end as Markdown on standard output; the exit code is 1 where anything differed.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

SURGBENCH = [sys.executable, "-c", "from surgbench.cli import main; main()"]
# Tells the processes of a trial from all others, whatever became of their parents.
MARK = "SURGBENCH_KILLS"
MOST_IN_A_ROW = 4
# A process whose parent is gone notices within a second; on a busy machine later.
NOTICED_S = 30.0
# What an import says of a folder that is not empty.
WHOLE_ALREADY = "holds something already"
# What a record says of the time that something took, and of itself.
TIMES = ("latency", "initialise_s", "calibration_ms", "elapsed_s", "seal")
TRAINING = """
masks: {training: 32, validation: 8, test: 8}
network: {width: 4, head: 4, input_px: 32}
training: {epochs: 3, batch: 8, bfloat16: false}
"""


class Result(NamedTuple):
    """What came of a command's trials.

    Attributes:
        seconds: What it takes undisturbed.
        kills: How often it was killed, at work.
        ended: How often it had ended before, which counts for nothing.
        group: How often all of its group was killed, rather than the command alone.
        problems: One line each.
    """

    seconds: float
    kills: int
    ended: int
    group: int
    problems: list[str]


def prepared(command: str, folder: Path) -> list[str]:
    """A command's words but for ``--out``, once what it works on has been made in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    if command == "generate":
        return ["generate", "mini", "--frames", "12", "--jobs", "2"]
    if command == "run":
        made = [*SURGBENCH, "generate", "mini", "--frames", "12", "--jobs", "2", "--out", str(folder / "mini")]
        subprocess.run(made, check=True, capture_output=True)
        what = ["--dataset", str(folder / "mini"), "--tracker", "cmaes", "--keypoints", "observed"]
        return ["run", *what, "--repeats", "2", "--jobs", "2"]
    if command == "import":
        source = folder / "recording"
        (source / "masks").mkdir(parents=True)
        camera = {"width": 640, "height": 480, "fx": 800.0, "fy": 800.0, "cx": 320.0, "cy": 240.0}
        (source / "camera.json").write_text(json.dumps(camera))
        for frame in range(200):
            mask = np.zeros((480, 640), np.uint8)
            mask[80:160, : 240 + frame // 4] = 255
            (source / f"masks/{frame:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
        return ["import", "masks", str(source)]
    (folder / "training.yaml").write_text(TRAINING)
    return ["train", "keypoints", str(folder / "training.yaml"), "--jobs", "2"]


def trials(command: str, kills: int, seed: int, folder: Path) -> Result:
    """Kill a command so often, in as many folders as that takes, and see each time what comes of it.

    Args:
        command: ``generate``, ``run``, ``import`` or ``train``.
        kills: How often.
        seed: Of the moments, and of who is killed.
        folder: A new one.
    """
    rng = random.Random(f"{command} {seed}")
    words = prepared(command, folder / "sources")
    seconds, problems = 0.0, []
    for name in ("first", "whole"):  # the first one compiles and fills caches
        begin = time.monotonic()
        problems += ended_well(start(words, folder / name, folder / "tmp"))
        seconds = time.monotonic() - begin
    whole = content(folder / "whole")
    problems += differences(content(folder / "first"), whole)
    killed = ended = group = number = 0
    while killed < kills:
        number += 1
        trial = folder / f"trial-{number}"
        trial.mkdir()
        found: list[str] = []
        moments: list[str] = []
        for _ in range(min(rng.randint(1, MOST_IN_A_ROW), kills - killed)):
            moment, all_of_it = rng.uniform(0.0, seconds), rng.random() < 0.5
            before = written(trial / "out")
            process = start(words, trial / "out", trial / "tmp", heard=False)
            at_work = kill_after(moment, all_of_it, process)
            found += changed(before, trial / "out")
            moments.append(f"{moment:.2f} s {'all' if all_of_it else 'alone'}{'' if at_work else ' (ended before)'}")
            killed, ended, group = killed + at_work, ended + (not at_work), group + (at_work and all_of_it)
            if not at_work:
                break
        before = written(trial / "out")
        if at_work or process.returncode != 0:
            process = start(words, trial / "out", trial / "tmp")
            said = ended_well(process)
            # An import that was killed once its folder had been put in its place is whole.
            found += [one for one in said if command != "import" or WHOLE_ALREADY not in one]
        found += changed(before, trial / "out")
        found += differences(content(trial / "out"), whole)
        found += [f"{path.name}: left behind" for path in trial.iterdir() if path.name not in ("out", "tmp")]
        found += [f"tmp/{path.name}: left behind" for path in (trial / "tmp").rglob("*") if path.is_file()]
        found += left_processes(trial)
        told = "good" if not found else "; ".join(found)
        print(f"{command}: {killed} of {kills}: {', '.join(moments)}: {told}", file=sys.stderr, flush=True)
        problems += [f"trial {number}: {one}" for one in found]
        if not found:
            shutil.rmtree(trial)
    return Result(seconds, killed, ended, group, problems)


def start(words: list[str], out: Path, scratch: Path, heard: bool = True) -> subprocess.Popen[bytes]:
    """The command, begun in a group of its own."""
    scratch.mkdir(exist_ok=True)
    environment = {**os.environ, MARK: str(scratch.parent), "TMPDIR": str(scratch)}
    return subprocess.Popen(
        [*SURGBENCH, *words, "--out", str(out)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE if heard else subprocess.DEVNULL,
        start_new_session=True,
    )


def kill_after(moment: float, all_of_it: bool, process: subprocess.Popen[bytes]) -> bool:
    """Kill it after so many seconds, alone or with its group; whether it was still at work."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment)
        return False
    if all_of_it:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()
    return True


def ended_well(process: subprocess.Popen[bytes]) -> list[str]:
    """A line unless it ends with 0."""
    said = process.communicate()[1].decode(errors="replace").strip().splitlines()
    return [] if process.returncode == 0 else [f"exit code {process.returncode}: {said[-1] if said else 'no word'}"]


def written(out: Path) -> dict[str, bytes]:
    """The records in a folder."""
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*-r*.json")}


def changed(before: dict[str, bytes], out: Path) -> list[str]:
    """A line for each record that was there before and is another now: it was made twice."""
    now = written(out)
    return [f"{name}: was written already, and changed" for name in before if before[name] != now.get(name)]


def content(out: Path) -> dict[str, Any]:
    """All files of a folder, without the times that they tell."""
    found: dict[str, Any] = {}
    for path in sorted(out.rglob("*")):
        if path.is_file():
            name, data = path.relative_to(out).as_posix(), path.read_bytes()
            if name.endswith(".json") and b"surgbench-record-" in data[-200_000:]:
                found[name] = without_times(json.loads(data))
            elif name == "log.csv":
                found[name] = [row[:-1] for row in csv.reader(io.StringIO(data.decode()))]
            else:  # the state of a training, which is for going on with it, has the log with its times
                found[name] = None if name == "training.safetensors" else data
    return found


def without_times(value: Any) -> Any:
    """A record without what a clock said."""
    if isinstance(value, dict):
        return {key: without_times(one) for key, one in value.items() if not key.startswith(TIMES)}
    return value


def differences(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """A line for each file that is missing, too many, or another."""
    return [
        *(f"{name}: lost" for name in expected.keys() - found.keys()),
        *(f"{name}: left behind" for name in found.keys() - expected.keys()),
        *(f"{name}: another" for name in expected.keys() & found.keys() if expected[name] != found[name]),
    ]


def left_processes(trial: Path) -> list[str]:
    """A line for each process of a trial that does not end by itself."""
    mark = f"{MARK}={trial}".encode()
    deadline = time.monotonic() + NOTICED_S
    while True:
        alive = []
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if mark in (folder / "environ").read_bytes().split(b"\0"):
                    alive.append(folder.name)
        if not alive or time.monotonic() > deadline:
            return [f"process {pid}: outlived its command" for pid in alive]
        time.sleep(0.1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = ("generate", "run", "import", "train")
    parser.add_argument("commands", nargs="*", default=commands, metavar="COMMAND", help=f"of {', '.join(commands)}")
    parser.add_argument("--kills", type=int, default=50, help="for each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--keep", type=Path, help="a new folder for what is made; of bad trials it is kept")
    options = parser.parse_args()
    rows, bad = [], False
    for command in options.commands:
        folder = Path(tempfile.mkdtemp()) if options.keep is None else options.keep / command
        folder.mkdir(parents=True, exist_ok=True)
        result = trials(command, options.kills, options.seed, folder)
        if options.keep is None:
            shutil.rmtree(folder)
        for problem in result.problems:
            print(f"{command}: {problem}", file=sys.stderr, flush=True)
        bad |= bool(result.problems)
        rows.append((command, result))
    print(f"| command | undisturbed (s) | kills (seed {options.seed}) | of its group | had ended before | all good |")
    print("|---|---:|---:|---:|---:|---|")
    for command, result in rows:
        good = "no" if result.problems else "yes"
        print(
            f"| `{command}` | {result.seconds:.1f} | {result.kills} | {result.group} | {result.ended} | {good} |",
            flush=True,
        )
    sys.exit(bad)


if __name__ == "__main__":
    main()
