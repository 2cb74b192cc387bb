"""The package as it is installed: every folder listed, and where a wheel is tested, the wheel it is."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

import surgbench

ROOT = Path(__file__).parents[2]
MAPPED = {"trackers": "surgbench.trackers", "generators": "surgbench.generators", "configs": "surgbench.configs"}


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib is in Python 3.11 and newer")
def test_every_package_is_listed() -> None:
    """Editable installs see an unlisted sub-package, wheels do not."""
    import tomllib

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {"surgbench": "surgbench", **MAPPED}
    expected = {
        ".".join([package, *init.parent.relative_to(ROOT / folder).parts])
        for folder, package in folders.items()
        for init in (ROOT / folder).rglob("__init__.py")
    }
    assert set(settings["packages"]) == expected


def test_no_code_folder_lacks_its_init() -> None:
    for folder in ("surgbench", *MAPPED):
        for module in (ROOT / folder).rglob("*.py"):
            assert (module.parent / "__init__.py").is_file(), module.parent


def test_tested_package_is_the_installed_one() -> None:
    expected = os.environ.get("SURGBENCH_EXPECT_SITE")
    where = Path(surgbench.__file__).resolve()
    assert where.is_relative_to(Path(expected).resolve() if expected else ROOT)


def test_data_files_are_found() -> None:
    from surgbench.config import packaged_names

    for folder in ("arms", "instruments", "presets", "published", "suites", "tables", "training"):
        assert packaged_names(folder)


def test_files_of_the_report_are_found() -> None:
    from surgbench.report.page.build import read

    for name in ("page.css", "page.html", "page.js"):
        assert read(name)


def test_the_version_is_said_alike_everywhere() -> None:
    said = surgbench.__version__
    assert f'\nversion = "{said}"\n' in (ROOT / "pyproject.toml").read_text()
    assert f"\nversion: {said}\n" in (ROOT / "CITATION.cff").read_text()
    released = re.findall(r"^## ([\d.]+) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[0] == said


def test_plugins_import_the_engine_and_their_siblings_only() -> None:
    """The leaf rule: nothing outside a plug-in folder imports it by name."""
    for module in (ROOT / "surgbench").rglob("*.py"):
        if module.parent.name == "cli":
            continue
        text = module.read_text()
        for package in ("surgbench.trackers", "surgbench.generators"):
            assert f"from {package}" not in text, module
            assert f"import {package}" not in text, module
