"""What is said where a package is missing that only a part of this one needs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import surgbench
from surgbench import extras
from surgbench.extras import EXTRAS, install, missing

PYPROJECT = Path(surgbench.__file__).parents[1] / "pyproject.toml"


def test_what_is_there_is_not_missing() -> None:
    assert missing(("json", "re")) is None


def test_what_is_missing_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    assert missing(("matplotlib",)) == "matplotlib is not installed: pip install 'surgbench[plots]'"
    assert missing(("onnx", "onnxruntime")) == "onnx and onnxruntime are not installed: pip install 'surgbench[onnx]'"
    assert install("cv2.aruco") == "pip install opencv-python-headless"


@pytest.mark.skipif(not PYPROJECT.is_file(), reason="not a checkout")
def test_the_extras_are_those_of_the_package() -> None:
    section = PYPROJECT.read_text(encoding="utf-8").partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    declared = dict(re.findall(r"^(\w+) = \[(.*?)\]$", section, re.MULTILINE | re.DOTALL))
    assert set(EXTRAS) == set(declared) - {"dev"}
    for extra, modules in EXTRAS.items():
        assert all(module in declared[extra] for module in modules)
