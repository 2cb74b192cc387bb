"""The public names: where they are, that a page lists them, and that they load nothing before they are used."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import surgbench
from surgbench import metrics
from surgbench.version import __version__

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "api.md"
HEAVY = ("torch", "mitsuba", "drjit", "numba", "cv2", "pandas", "pyarrow", "scipy", "trimesh", "matplotlib")


def listed() -> dict[str, str]:
    """Name to module, as the page has it."""
    lines = re.findall(r"^\| `surgbench\.(\w+)` \| .+ \| `([\w.]+)` \|$", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    assert len({name for name, _ in lines}) == len(lines)
    return dict(lines)


def test_the_page_lists_the_public_names() -> None:
    assert set(listed()) == set(surgbench.__all__)
    assert set(surgbench.__all__) <= set(dir(surgbench))


@pytest.mark.parametrize("name", surgbench.__all__)
def test_a_public_name_is_where_the_page_says(name: str) -> None:
    module = importlib.import_module(listed()[name])
    assert getattr(surgbench, name) is (module if name == "metrics" else getattr(module, name))


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "surgbench" / "__init__.py").read_text("utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert imported >= set(surgbench.__all__)


def test_every_metric_is_public() -> None:
    own = {
        name for name, found in inspect.getmembers(metrics, inspect.isfunction) if found.__module__ == metrics.__name__
    }
    assert {name for name in own if not name.startswith("_")} <= set(surgbench.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'surgbench' has no attribute 'Tracker'"):
        surgbench.Tracker  # noqa: B018
    with pytest.raises(ImportError, match="Tracker"):
        exec("from surgbench import Tracker")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="tomllib is in Python 3.11 and newer")
def test_the_version_is_the_projects() -> None:
    import tomllib

    assert tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"] == __version__


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import surgbench",
        "import surgbench.cli",
        "from surgbench.cli import main; sys.argv = ['surgbench', '--help']; main()",
        "from surgbench.cli import main; sys.argv = ['surgbench', 'run', '--help']; main()",
    ],
    ids=["import", "import cli", "help", "run help"],
)
def test_nothing_heavy_is_loaded_before_it_is_used(code: str) -> None:
    program = f"""
import atexit, sys
atexit.register(lambda: print("loaded:", *(name for name in {HEAVY} if name in sys.modules)))
{code}
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_the_import_and_the_help_need_no_numpy() -> None:
    """The two that everybody waits for."""
    for code in ("import surgbench", "from surgbench.cli import main; sys.argv = ['surgbench', '--help']; main()"):
        program = f"import atexit, sys; atexit.register(lambda: print('numpy' in sys.modules)); {code}"
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "False", code
