"""Install the wheel with the lowest declared versions, and under every Python there is, and run the quick tests.

    make lowest                                       # all trials, then a table; also build/lowest/table.md
    .venv/bin/python tools/lowest.py --python 3.11 --versions lowest

A trial is an interpreter and a set of versions: `lowest`, where every direct dependency is pinned to the lower bound in
pyproject.toml and pip resolves the rest, or `pinned`, which is constraints.txt. Each has a virtual environment of its
own in build/lowest/, and its log. Only wheels are installed: a bound that would have to be compiled is none for users.

PyTorch is the exception: its pinned version only, and only under the interpreter that this script runs under, which has
it already. Elsewhere it would be a download of gigabytes; tests that need it are skipped there.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "lowest"
OWN = "{}.{}".format(*sys.version_info)
CANDIDATES = ("3.10", "3.11", "3.12", "3.13")
# What tests import of the extra `dev`; linters and builders need no lower bound tried.
TEST_TOOLS = ("cmaes", "hypothesis", "pytest", "pytest-xdist")
# What an old library calls may be deprecated by a younger interpreter, which is no failure of ours.
PYTEST = ("-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-m", "not slow", "-W", "default::DeprecationWarning")


@dataclass(frozen=True)
class Trial:
    """An interpreter and a set of versions."""

    version: str
    python: Path
    versions: str
    torch: bool

    @property
    def folder(self) -> Path:
        """Where its environment and its log lie."""
        return BUILD / f"{self.version}-{self.versions}"


def interpreters() -> dict[str, Path]:
    """Version to executable, of those that start: on the PATH, else in pyenv's folder."""
    pyenv = shutil.which("pyenv")
    root = Path(subprocess.run([pyenv, "root"], capture_output=True, text=True).stdout.strip()) if pyenv else None
    found = {}
    for version in CANDIDATES:
        places = [Path(sys.executable)] if version == OWN else []
        places += [Path(place) for place in [shutil.which(f"python{version}")] if place]
        places += sorted((root / "versions").glob(f"{version}.*/bin/python"), reverse=True) if root else []
        # pyenv's shims are on the PATH for versions that are not switched on: only a start tells.
        probe = "import sys, venv; print('{}.{}'.format(*sys.version_info))"
        for place in places:
            started = subprocess.run([place, "-c", probe], capture_output=True, text=True)
            if started.stdout.strip() == version:
                found[version] = place
                break
    return found


def declared(version: str) -> list[Requirement]:
    """Direct dependencies under an interpreter, and what tests import."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = [Requirement(line) for line in project["dependencies"]]
    tools = [Requirement(line) for line in project["optional-dependencies"]["dev"]]
    found += [tool for tool in tools if canonicalize_name(tool.name) in TEST_TOOLS]
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    return [one for one in found if one.marker is None or one.marker.evaluate(environment)]


def lower_bound(requirement: Requirement) -> str:
    """The version after `>=`."""
    (bound,) = [one.version for one in requirement.specifier if one.operator == ">="]
    return bound


def asked_of_pip(trial: Trial) -> list[str]:
    """What to install, and the file of constraints."""
    lines, pins = [], []
    for requirement in declared(trial.version):
        if requirement.name != "torch":
            lines.append(f"{requirement.name}{requirement.specifier}")
            pins.append(f"{requirement.name}=={lower_bound(requirement)}")
        elif trial.torch:
            lines.append("torch")
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if trial.versions == "pinned":
        pins = pinned
    elif trial.torch:
        pins += [line for line in pinned if line.startswith("torch==")]
    constraints = trial.folder / "constraints.txt"
    constraints.write_text("\n".join(pins) + "\n", encoding="utf-8")
    return ["-c", str(constraints), *lines]


def run(trial: Trial, wheel: Path) -> tuple[bool, str]:
    """Whether it passed, and in a few words how."""
    shutil.rmtree(trial.folder, ignore_errors=True)
    elsewhere = trial.folder / "elsewhere"  # where the repository's folders cannot be imported
    elsewhere.mkdir(parents=True)
    venv = trial.folder / "venv"
    python = str(venv / "bin" / "python")
    pip = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--only-binary", ":all:"]
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["SURGBENCH_EXPECT_SITE"] = str(venv)
    tests = [python, *PYTEST, "-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT), str(ROOT / "tests")]
    steps = [
        ("no environment", [str(trial.python), "-m", "venv", str(venv)]),
        ("not to be had", [*pip, *asked_of_pip(trial)]),
        ("wheel not installed", [*pip, "--no-deps", str(wheel)]),
        ("tests", tests),
    ]
    log = trial.folder / "log.txt"
    for name, command in steps:
        with log.open("a", encoding="utf-8") as out:
            done = subprocess.run(command, cwd=elsewhere, env=environment, stdout=out, stderr=subprocess.STDOUT)
        text = log.read_text(encoding="utf-8")
        if name == "tests":
            summary = re.findall(r"^(?:=+ )?(\d+ \w+.* in [\d.]+s.*?)(?: =+)?$", text, flags=re.MULTILINE)
            return done.returncode == 0, summary[-1] if summary else "no test ran"
        if done.returncode != 0:
            errors = re.findall(r"^ERROR: (.*)$", text, flags=re.MULTILINE)
            return False, f"{name}: {errors[-1] if errors else 'see the log'}"
    raise AssertionError


def build_wheel() -> Path:
    """The wheel that every trial installs."""
    BUILD.mkdir(parents=True, exist_ok=True)
    for old in BUILD.glob("*.whl"):
        old.unlink()
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # setuptools would ship what was deleted since
    command = [sys.executable, "-m", "build", "-q", "--wheel", "--no-isolation", "--outdir", str(BUILD), str(ROOT)]
    subprocess.run(command, check=True)
    (wheel,) = BUILD.glob("*.whl")
    return wheel


def main() -> int:
    """Run the trials that were asked for, one at a time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", choices=CANDIDATES, help="may be repeated; all without")
    parser.add_argument("--versions", choices=("lowest", "pinned"), help="both without")
    asked = parser.parse_args()
    pythons, wheel = interpreters(), build_wheel()
    rows = ["| Python | versions | PyTorch | result |", "|---|---|---|---|"]
    failed = False
    for version in asked.python or CANDIDATES:
        if version not in pythons:
            rows.append(f"| {version} | | | not tried: no such interpreter here |")
            continue
        for versions in [asked.versions] if asked.versions else ["lowest", "pinned"]:
            trial = Trial(version, pythons[version], versions, torch=version == OWN)
            print(f"{version} {versions} ...", file=sys.stderr, flush=True)
            passed, how = run(trial, wheel)
            failed |= not passed
            torch = "pinned" if trial.torch else "none"
            rows.append(f"| {version} | {versions} | {torch} | {'' if passed else '**failed** '}{how} |")
    bounds = ", ".join(f"{one.name} {lower_bound(one)}" for one in declared(OWN) if one.name != "torch")
    table = "\n".join([*rows, "", f"Lowest: {bounds}."])
    (BUILD / "table.md").write_text(table + "\n", encoding="utf-8")
    print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
