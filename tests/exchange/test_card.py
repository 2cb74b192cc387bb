"""Dataset cards: what they say is what the manifest says, and of published datasets what their tables say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from commandline import surgbench
from small_dataset import CAMERA, DT_S, FRAMES, make_pair

from surgbench.dataset.card import size_category
from surgbench.version import DATA_VERSION

ROOT = Path(__file__).parents[2]
CARDS = ROOT / "docs" / "datasets"


def head_of(text: str) -> dict[str, Any]:
    """The YAML head of a card."""
    _, head, _ = text.split("---\n", 2)
    content: dict[str, Any] = yaml.safe_load(head)
    return content


def card_of(dataset: Path, out: Path, *more: str) -> str:
    sets = [word for text in more for word in ("--set", f"card.{text}")]
    surgbench("export", dataset, "--format", "card", "--out", out, *sets)
    (written,) = out.iterdir()
    assert written.name == "README.md"
    return written.read_text(encoding="utf-8")


def test_a_card_says_what_the_manifest_says(tmp_path: Path) -> None:
    dataset = make_pair(tmp_path / "pairs", images=True)
    text = card_of(dataset.path, tmp_path / "card", "license=cc-by-4.0", "what=Two arms.")
    head = head_of(text)
    assert (head["license"], head["pretty_name"]) == ("cc-by-4.0", "pairs")
    assert head["size_categories"] == ["n<1K"]
    assert "synthetic" in head["tags"]
    assert all(list(dataset.path.glob(one["path"])) for one in head["configs"][0]["data_files"])
    size = sum(entry.bytes for entry in dataset.manifest.files.values())
    assert f"2 sequences, {2 * FRAMES} frames, {size / 1e6:.1f} MB" in text
    for number in range(2):
        assert f"| {number:03d} | {FRAMES} |" in text
    assert f"`{dataset.hash}`" in text
    assert "\nTwo arms.\n" in text
    assert f"{1 / DT_S:.4g} frames a second" in text
    assert f"{CAMERA.width} x {CAMERA.height} pixels, fx {CAMERA.fx:g}" in text
    assert "images, 8-bit RGB" in text
    for word, convention in dataset.manifest.conventions.items():
        assert f"- {word}: {convention}" in text
    assert "surgbench generate" not in text  # of no preset of ours


def test_a_card_may_lie_in_the_dataset(tmp_path: Path) -> None:
    dataset = make_pair(tmp_path / "pairs", sequences=1)
    (dataset.path / "README.md").write_text(card_of(dataset.path, tmp_path / "card"), encoding="utf-8")
    surgbench("validate", dataset.path)


def test_a_card_of_a_recording_claims_no_truth_and_no_licence(tmp_path: Path) -> None:
    text = card_of(make_pair(tmp_path / "taken", truth=False).path, tmp_path / "card")
    assert head_of(text)["license"] == "unknown"
    assert "a recording without truth" in text
    assert "@software" not in text
    assert "images, 8-bit RGB" not in text


@pytest.mark.slow
def test_a_card_of_a_preset_says_how_it_is_made_again(tmp_path: Path) -> None:
    first = tmp_path / "first"
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", 100, "--seed", 3, "--out", first)
    text = card_of(first, tmp_path / "card")
    (command,) = [line for line in text.splitlines() if line.startswith("surgbench generate")]
    *words, _ = command.split()[1:]
    surgbench(*words, tmp_path / "again")
    manifest = first / "dataset.json"
    assert (tmp_path / "again" / "dataset.json").read_bytes() == manifest.read_bytes()
    assert json.loads(manifest.read_text())["created_by"] == f"surgbench {DATA_VERSION}"


def test_a_card_is_of_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("export", tmp_path / "nowhere", "--format", "card", "--out", tmp_path / "out", expect=2)
    assert "no such file or folder" in capsys.readouterr().err


def test_size_categories_are_those_of_the_hubs() -> None:
    assert [size_category(frames) for frames in (999, 1000, 16_000, 10**7)] == [
        "n<1K",
        "1K<n<10K",
        "10K<n<100K",
        "n>1M",
    ]


@pytest.mark.extras
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of mlcroissant and what it stands on
def test_croissant_of_trials_is_read_by_mlcroissant(tmp_path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    data = tmp_path / "chaser"
    surgbench("generate", "wire-chaser-mini", "--sequences", 2, "--frames", 100, "--out", data)
    surgbench("export", data, "--format", "croissant", "--out", tmp_path / "out")
    (tmp_path / "out" / "croissant.json").rename(data / "croissant.json")
    surgbench("validate", data)
    read = mlcroissant.Dataset(jsonld=str(data / "croissant.json"))
    assert not read.metadata.ctx.issues.errors
    assert len(list(read.records("observations"))) == len(list(read.records("feature"))) == 200


# Of published datasets. In the repository: what was measured on them is not shipped.


def published() -> dict[str, dict[str, Any]]:
    """Hash of every generated dataset behind a committed table to what the table says of it."""
    found = {}
    for place in sorted((ROOT / "results").glob("*/records.json")):
        for about in json.loads(place.read_text(encoding="utf-8"))["datasets"].values():
            found[about["sha256"]] = about | {"table": place.parent.name}
    return found


@pytest.mark.skipif(not (ROOT / "results").is_dir(), reason="not a checkout")
def test_every_published_dataset_has_a_card_with_its_hash() -> None:
    texts = {path.stem: path.read_text(encoding="utf-8") for path in CARDS.glob("*.md")}
    for sha256, about in published().items():
        (name,) = [name for name, text in texts.items() if sha256 in text]
        assert about["name"].startswith(name)
        assert f"`{about['table']}`" in texts[name]
        assert f" {about['frames']} " in texts[name]


@pytest.mark.skipif(not (ROOT / "results").is_dir(), reason="not a checkout")
def test_published_metadata_have_the_hashes_of_the_tables() -> None:
    known = published()
    for path in CARDS.glob("*.croissant.json"):
        manifest, *sets = json.loads(path.read_text(encoding="utf-8"))["distribution"]
        about = known[manifest["sha256"]]
        card = path.with_name(path.name.replace(".croissant.json", ".md")).read_text(encoding="utf-8")
        assert f"other file: `{manifest['sha256']}`" in card
        for one in sets:
            assert len({place.split("/")[1] for place in one["includes"]}) == about["sequences"]


@pytest.mark.extras
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", sorted(CARDS.glob("*.croissant.json")), ids=lambda path: path.name.partition(".")[0])
def test_published_metadata_are_croissant(path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    assert not mlcroissant.Dataset(jsonld=str(path)).metadata.ctx.issues.errors
