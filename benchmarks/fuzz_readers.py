"""Whether a reader of files ends otherwise than with one line, takes long, or takes much memory: many files for each.

    pip install atheris
    python benchmarks/fuzz_readers.py --files 10000

atheris (libFuzzer; Apache-2.0) changes sound files wherever it makes the reader go another way. Prints Markdown, a row
a reader. A file that is read, or refused with a `SurgbenchError` of one line, is good; anything else, more than 20 s,
or more than the stated memory ends the reader's row, and the file is kept.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST_S, MOST_MIB, LARGEST_BYTES = 20, 2048, 8192


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", help="only these; default: all")
    parser.add_argument("--files", type=int, default=10_000, help="for each reader")
    parser.add_argument("--keep", type=Path, default=Path("fuzzed"), help="where files that did harm are kept")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options, rest = parser.parse_known_args()
    sys.path.insert(0, str(ROOT / "tests"))
    if options.child:
        fuzz(options.child, rest)
        return
    from readers import READERS, samples

    print("| reader | files | memory (MiB) | time (s) | what came of it |")
    print("|---|---:|---:|---:|---|")
    for name in options.readers or READERS:
        with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as scratch:
            (Path(folder) / "sound").write_bytes(samples()[name])
            options.keep.mkdir(exist_ok=True)
            begun = time.monotonic()
            done = subprocess.run(
                [
                    *(sys.executable, __file__, "--child", name, folder, f"-runs={options.files}"),
                    *(f"-max_len={LARGEST_BYTES}", f"-timeout={LONGEST_S}", f"-rss_limit_mb={MOST_MIB}", "-seed=1"),
                    f"-artifact_prefix={options.keep / name}-",
                ],
                env={**os.environ, "TMPDIR": scratch},
                capture_output=True,
                text=True,
                check=False,
            )
            took = time.monotonic() - begun
        said = done.stderr
        counted = [int(number) for number in re.findall(r"^#(\d+)\s", said, re.MULTILINE)]
        memory = max([int(number) for number in re.findall(r"rss: (\d+)Mb", said)], default=0)
        outcome = "good" if done.returncode == 0 else " ".join(said.strip().splitlines()[-1:])[:120]
        print(f"| {name} | {max(counted, default=0)} | {memory} | {took:.0f} | {outcome} |", flush=True)


def fuzz(name: str, arguments: list[str]) -> None:
    """Give a reader file after file; does not return."""
    import atheris

    with atheris.instrument_imports(include=["surgbench"]):
        from readers import READERS

        from surgbench.errors import SurgbenchError

    folder = Path(tempfile.mkdtemp())
    read = READERS[name]

    def once(data: bytes) -> None:
        path = folder / name
        path.write_bytes(data)
        try:
            read(path, data)
        except SurgbenchError as error:
            if "\n" in str(error):
                raise RuntimeError(f"not one line: {error}") from error

    atheris.Setup([sys.argv[0], *arguments], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
