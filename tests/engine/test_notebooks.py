"""The notebooks among the examples run from top to bottom, on runs made for them."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import RUN, surgbench
from small_dataset import make_pair

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")
pytest.importorskip("ipykernel")
pytest.importorskip("matplotlib")
pytestmark = [pytest.mark.extras, pytest.mark.slow]

EXAMPLES = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file()) / "examples"


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.ipynb")))
@pytest.mark.filterwarnings("ignore")  # of the notebook's own libraries
def test_a_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = make_pair(tmp_path / "data", sequences=2).path
    runs = tmp_path / "runs"
    surgbench(
        *(*RUN, "--dataset", data, "--tracker", "cmaes", "--tracker", "xnes"),
        *("--set", "cmaes.iterations=1", "--set", "xnes.iterations=1", "--out", runs),
    )
    monkeypatch.setenv("SURGBENCH_RUNS", str(runs))
    notebook = nbformat.read(EXAMPLES / name, 4)
    assert not any(cell.get("outputs") for cell in notebook.cells)  # what it shows depends on who runs it
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(EXAMPLES)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output["output_type"] in ("error", "stream")]
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
    for picture in pictures:
        drawn = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
        assert drawn is not None
        assert np.ptp(drawn) > 200  # something is on it
