"""Cards and Croissant metadata of the datasets behind the committed tables, in ``docs/datasets/``.

    .venv/bin/python tools/dataset_cards.py             # all; minutes, for a little of each preset is generated
    .venv/bin/python tools/dataset_cards.py paper mini  # some

Datasets of gigabytes are not made anew for this: what is in one is seen from its first frames, how large it is and its
hash from ``results/*/records.json``, as it was when the table was made.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from surgbench.dataset.card import card
from surgbench.dataset.open import open_dataset
from surgbench.exchange.exporters.card import facts_of
from surgbench.reproduce.load import load_table
from surgbench.reproduce.table import DatasetRequest

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "datasets"
PRESETS = ROOT / "configs" / "presets"
# As few frames as the generators make.
FEWEST = {"instrument": 30, "viewpoint": 100}
SAMPLE = "000"
LICENCE_ADDRESS = "https://www.apache.org/licenses/LICENSE-2.0"
HASH_NOTE = (
    "It is the hash of the dataset that the committed tables were run on. On a processor of another family the last "
    "digits of some numbers, and with them the hash, may differ; `surgbench reproduce … --check` then compares hashes "
    "of the first frames (`first_sha256` in `records.json`)."
)


@dataclass
class Published:
    """A dataset behind one or more tables.

    Attributes:
        request: What makes it.
        about: What ``records.json`` says of it.
        tables: Names.
    """

    request: DatasetRequest
    about: dict[str, Any]
    tables: list[str] = field(default_factory=list)

    @property
    def command(self) -> str:
        """What makes it."""
        asked = self.request
        words = ["surgbench generate", asked.preset]
        words += [
            f"--{key} {value}" for key in ("sequences", "frames", "seed") if (value := getattr(asked, key)) is not None
        ]
        words += [f"--corruption {asked.corruption}"] if asked.corruption else []
        words += [f"--set {key}={value}" for key, value in asked.set.items()]
        return " ".join([*words, f"--out data/{asked.folder}"])


def published() -> dict[str, list[Published]]:
    """Preset to the datasets of it that are behind committed tables, the largest first."""
    found: dict[str, Published] = {}
    for place in sorted((ROOT / "results").glob("*/records.json")):
        about = json.loads(place.read_text(encoding="utf-8"))["datasets"]
        for block in load_table(place.parent.name).table.blocks:
            request = block.dataset
            if isinstance(request, DatasetRequest) and request.folder in about:
                one = found.setdefault(request.folder, Published(request, about[request.folder]))
                if place.parent.name not in one.tables:
                    one.tables.append(place.parent.name)
    by_preset: dict[str, list[Published]] = {}
    for one in sorted(found.values(), key=lambda one: -one.about["frames"]):
        by_preset.setdefault(one.request.preset, []).append(one)
    return by_preset


def first_frames(preset: str, folder: Path) -> None:
    """Generate a little of a preset."""
    task = yaml.safe_load((PRESETS / f"{preset}.yaml").read_text(encoding="utf-8")).get("task", "instrument")
    command = [
        "-m",
        "surgbench",
        "generate",
        preset,
        "--sequences",
        "1",
        "--frames",
        str(FEWEST[task]),
        "--out",
        str(folder),
    ]
    subprocess.run([sys.executable, *command], check=True)


def what_it_is(preset: str) -> str:
    """The comment at the head of its file."""
    lines = (PRESETS / f"{preset}.yaml").read_text(encoding="utf-8").splitlines()
    head = lines[: next(number for number, line in enumerate(lines) if not line.startswith("#"))]
    text = " ".join(line.removeprefix("#").strip() for line in head)
    return re.sub(r"([\w-]+)\.yaml", r"`\1`", text)


def write_card(preset: str, variants: list[Published], sample: Path) -> None:
    """Card and Croissant metadata of a preset's largest dataset, with the hashes of the others."""
    whole = variants[0]
    about = whole.about
    dataset = open_dataset(sample)
    notes = [HASH_NOTE]
    if len(variants) > 1:
        rows = [f"| `{one.command}` | {one.about['frames']} | `{one.about['sha256']}` |" for one in variants[1:]]
        notes.append(
            "\n".join(["Further ones of this preset:", "", "| command | frames | SHA-256 |", "|---|---:|---|", *rows])
        )
    facts = replace(
        facts_of(dataset, what_it_is(preset)),
        name=about["name"],
        units=dict.fromkeys(about["first_sha256"]),
        frames=about["frames"],
        bytes=None,
        sha256=about["sha256"],
        command=whole.command,
        tables=sorted({table for one in variants for table in one.tables}),
        notes=notes,
    )
    (OUT / f"{preset}.md").write_text(card(facts), encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        told = {"license": LICENCE_ADDRESS, "creator": "The surgbench developers", "published": "2026-11-30"}
        sets = [word for key, value in told.items() for word in ("--set", f"croissant.{key}={value}")]
        command = ["-m", "surgbench", "export", str(sample), "--format", "croissant", "--out", f"{folder}/out", *sets]
        subprocess.run([sys.executable, *command], check=True)
        content = json.loads(Path(folder, "out", "croissant.json").read_text(encoding="utf-8"))
    content["citeAs"] = facts.cite  # braces would be YAML on the command line
    manifest, *sets_of_files = content["distribution"]
    manifest["sha256"] = about["sha256"]
    del manifest["contentSize"]  # of the sample's
    for one in sets_of_files:
        one["includes"] = [
            place.replace(f"/{SAMPLE}/", f"/{id_}/") for id_ in about["first_sha256"] for place in one["includes"]
        ]
    content["description"] = content["description"].replace(
        f"; {dataset.manifest.counts}. ", f"; {len(about['first_sha256'])} sequences, {about['frames']} frames. "
    )
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (OUT / f"{preset}.croissant.json").write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="*", help="only these")
    asked = parser.parse_args().presets
    OUT.mkdir(exist_ok=True)
    for preset, variants in published().items():
        if not asked or preset in asked:
            with tempfile.TemporaryDirectory() as folder:
                first_frames(preset, Path(folder) / "sample")
                write_card(preset, variants, Path(folder) / "sample")


if __name__ == "__main__":
    main()
