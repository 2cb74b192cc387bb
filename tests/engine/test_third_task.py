"""A task of a stranger's, behind entry points: no file of the engine knows of it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOY = Path(__file__).parents[1] / "toy"
MINE = """
class Twice:
    name, task = "twice", "counting"
    def reset(self, scene, state, rng): self.last = float(state[0])
    def step(self, observation):
        answer, self.last = 2 * self.last, observation
        return answer
"""


def surgbench(*arguments: object, expect: int = 0, installed: Path = TOY) -> str:
    """The command in a process of its own, in which the stranger's package is installed."""
    code = "from surgbench.cli import main; main()"
    path = os.pathsep.join([str(installed), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == expect, done.stderr
    return done.stdout if expect == 0 else done.stderr


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("counting")
    (folder / "series.yaml").write_text("task: counting\nname: series\n")
    surgbench("generate", folder / "series.yaml", "--out", folder / "data")
    return folder / "data"


@pytest.mark.slow
def test_it_generates_runs_and_stands_in_the_leaderboard(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    assert "sound; 'series', 2 series" in surgbench("validate", dataset)
    run = ("run", "--dataset", dataset, "--tracker", "counter", "--tracker", f"{tmp_path / 'mine.py'}:Twice")
    surgbench(*run, "--out", tmp_path / "runs")
    rows = json.loads(surgbench("report", tmp_path / "runs", "--format", "json"))
    assert [(row["row_id"], row["status"], row["task"], row["frames"]) for row in rows] == [
        ("counter", "ok", "counting", 20),
        ("twice", "ok", "counting", 20),
    ]
    assert rows[0]["count_error"] == 0.0 < rows[1]["count_error"]
    assert "| counter | **0.00** |" in surgbench("report", tmp_path / "runs", "--format", "markdown")
    assert "counter" in surgbench("report", tmp_path / "runs")
    page = surgbench("report", tmp_path / "runs", "--format", "html")
    assert "runs of the counting task have no pictures" in page


@pytest.mark.slow
def test_it_is_listed_and_its_trackers_are_refused_by_others(dataset: Path, tmp_path: Path) -> None:
    assert "counting" in surgbench("list", "tasks")
    assert "[counting] one more than the last number" in surgbench("list", "trackers")
    complaint = surgbench("run", "--dataset", dataset, "--tracker", "cmaes", "--out", tmp_path / "no", expect=2)
    assert "this dataset is of the counting task" in complaint
    complaint = surgbench("run", "--dataset", dataset, "--tracker", "counter", "--view", "x", "--out", "no", expect=2)
    assert "'view' is for the instrument task; 'series' is of the counting task" in complaint


@pytest.mark.slow
def test_without_the_package_its_data_are_one_line(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from surgbench.dataset.open import open_dataset
    from surgbench.errors import DatasetError

    with pytest.raises(DatasetError, match=r"'task': unknown task 'counting'.*valid: instrument, viewpoint"):
        open_dataset(dataset)


@pytest.mark.slow
def test_records_depend_on_all_of_its_package(dataset: Path, tmp_path: Path) -> None:
    """Its worker makes the estimates, though nothing of the engine imports it."""
    toy = shutil.copytree(TOY, tmp_path / "toy")
    run = ("run", "--dataset", dataset, "--tracker", "counter", "--sequences", 1, "--out", tmp_path / "runs")
    surgbench(*run, installed=toy)
    surgbench(*run, installed=toy)
    assert len(list((tmp_path / "runs").rglob("*-r0.json"))) == 1
    worker = toy / "surgbench_toy" / "worker.py"
    worker.write_text(worker.read_text().replace("float(tracker.step(value))", "float(tracker.step(value)) / 2"))
    surgbench(*run, installed=toy)
    rows = json.loads(surgbench("report", tmp_path / "runs", "--format", "json", installed=toy))
    assert sorted(row["count_error"] > 0 for row in rows) == [False, True]


@pytest.mark.parametrize(
    "text", ["raise OSError('no licence')", "from surgbench.task import Task\nclass T(Task):\n    name = 'counting'"]
)
def test_one_that_cannot_be_used_harms_no_other(dataset: Path, tmp_path: Path, text: str) -> None:
    toy = shutil.copytree(TOY, tmp_path / "toy")
    (toy / "surgbench_toy" / "task.py").write_text(text.replace("class T(", "class CountingTask("))
    assert "--initialiser" in surgbench("run", "--help", installed=toy)
    assert "mini" in surgbench("list", "presets", installed=toy)
    complaint = surgbench("validate", dataset, expect=2, installed=toy)
    assert "task 'counting' (surgbench_toy.task" in complaint
    assert "Traceback" not in complaint
