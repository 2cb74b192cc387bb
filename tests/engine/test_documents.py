"""Documents: what they link to is there, the site builds, and its pages hold what the package has."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path
from urllib.parse import unquote

import pytest

import surgbench

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file())
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
DOCUMENTS += PAGES
# Not in the API's reference: a module, whose functions are there one by one, and a number.
NOT_IN_REFERENCE = {"metrics", "__version__"}


@cache
def prose(document: Path) -> str:
    """A document without its blocks of code."""
    text = document.read_text(encoding="utf-8")
    return re.sub(r"^( *)(```+).*?^\1\2 *$", "", text, flags=re.MULTILINE | re.DOTALL)


def links(document: Path) -> list[str]:
    """What a document links to, of itself or of other files here."""
    text = re.sub(r"`[^`\n]*`", "", prose(document))
    found = re.findall(r"\]\(\s*<?([^)>\s]+)>?(?:\s+\"[^\"]*\")?\s*\)", text)
    found += re.findall(r"^\[[^\]]+\]:\s+(\S+)", text, flags=re.MULTILINE)
    return [link for link in found if not re.match(r"[a-z][a-z0-9+.-]*:", link)]


@cache
def anchors(document: Path) -> frozenset[str]:
    """Names of a document's headings, as GitHub makes them."""
    seen: Counter[str] = Counter()
    names = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *#* *$", prose(document), flags=re.MULTILINE):
        text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
        names.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return frozenset(names) | set(re.findall(r"<a (?:name|id)=\"([^\"]+)\"", prose(document)))


def broken(document: Path) -> list[str]:
    """Links of a document that lead nowhere."""
    lost = []
    for link in links(document):
        path, _, anchor = unquote(link).partition("#")
        target = (document.parent / path).resolve() if path else document
        there = target.exists() and target.is_relative_to(ROOT.resolve())
        if not there or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            lost.append(link)
    return lost


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    assert broken(document) == []


def test_broken_links_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "other.md").write_text("# `A` heading: twice\n\n## A heading twice\n\n```sh\n# no heading\n```\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[1](other.md#a-heading-twice) [2](other.md#a-heading-twice-1) [3](other.md#no-heading) [4](none.md)\n"
        "[5](#none) `[6](none)` [7](https://example.org/none) ![8](none.png)\n\n```python\nnothing[0](none)\n```\n"
    )
    assert broken(page) == ["other.md#no-heading", "none.md", "#none", "none.png"]


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    named = re.findall(r": ([\w/-]+\.md)$", navigation, flags=re.MULTILINE)
    assert sorted(named) == sorted(path.relative_to(ROOT / "docs").as_posix() for path in PAGES)


def test_the_reference_has_all_public_names() -> None:
    text = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    assert re.findall(r"^      - (\w+)$", text, flags=re.MULTILINE) == [
        name for name in surgbench.__all__ if name not in NOT_IN_REFERENCE
    ]


@pytest.mark.extras
@pytest.mark.slow
def test_the_site_builds(tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {path.name: path for path in (tmp_path / "site").iterdir()}
    assert "Where to go" in pages["index.html"].read_text(encoding="utf-8")
    assert "surgbench generate mini" in re.sub(
        "<[^>]+>", "", (pages["tour"] / "index.html").read_text(encoding="utf-8")
    )
    reference = (pages["reference"] / "index.html").read_text(encoding="utf-8")
    for name in ("surgbench.Camera", "surgbench.leaderboard", "surgbench.contract.StateFilter"):
        assert f'id="{name}"' in reference
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r'<(?:script|img|iframe)[^>]*\ssrc="(?:https?:)?//', text), page
        assert not re.search(r'<link[^>]*\srel="(?:stylesheet|preconnect)"[^>]*\shref="(?:https?:)?//', text), page
