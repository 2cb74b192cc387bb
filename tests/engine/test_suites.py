"""Suite files: what is crossed with what, and on which datasets."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from commandline import records, surgbench
from small_dataset import make_pair

from surgbench.errors import ConfigError, NotFoundError
from surgbench.suite.suites import load_suite


def put(folder: Path, **content: object) -> Path:
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_a_grid_is_every_combination_each_with_a_name(tmp_path: Path) -> None:
    grid = {"population": [50, 70], "kalman.noise": ["tuned", "published"]}
    options = {"cmaes": {"iterations": 3}}
    suite = load_suite(str(put(tmp_path, rows=[{"tracker": "cmaes", "options": options, "grid": grid}])))
    assert {row.row_id: row.options for row in suite.rows} == {
        f"cmaes-population-{count}-noise-{noise}": {
            "cmaes": {"iterations": 3, "population": count},
            "kalman": {"noise": noise},
        }
        for count in (50, 70)
        for noise in ("tuned", "published")
    }


def test_options_within_options_are_crossed_too(tmp_path: Path) -> None:
    row = {"tracker": "cmaes", "row_id": "tips", "grid": {"cmaes.loss.keypoints": [0.0, 0.0005]}}
    suite = load_suite(str(put(tmp_path, rows=[row, {"tracker": "xnes"}])))
    assert [row.row_id for row in suite.rows] == ["tips-keypoints-0.0", "tips-keypoints-0.0005", None]
    assert suite.rows[1].options == {"cmaes": {"loss": {"keypoints": 0.0005}}}


@pytest.mark.parametrize("grid", [{}, [1, 2], {"population": 50}, {"population": []}])
def test_a_grid_without_values_is_one_line(grid: object, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'grid' maps options to lists of values"):
        load_suite(str(put(tmp_path, rows=[{"tracker": "cmaes", "grid": grid}])))


def test_a_grid_within_a_value_is_one_line(tmp_path: Path) -> None:
    row = {"tracker": "cmaes", "options": {"cmaes": {"loss": 3}}, "grid": {"cmaes.loss.keypoints": [0.0]}}
    with pytest.raises(ConfigError, match=r"'grid': cmaes\.loss\.keypoints: 'loss' is set to a value already"):
        load_suite(str(put(tmp_path, rows=[row])))
    with pytest.raises(ConfigError, match="options"):
        load_suite(str(put(tmp_path, rows=[{**row, "options": 3}])))


def test_a_grid_of_an_unknown_tracker_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="did you mean 'cmaes'"):
        load_suite(str(put(tmp_path, rows=[{"tracker": "cmase", "grid": {"population": [50]}}])))


@pytest.mark.slow
def test_one_file_runs_trackers_on_datasets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("first", "second"):
        make_pair(tmp_path / "data" / name, name=name, frames=2, sequences=1)
    row = {"tracker": "cmaes", "keypoints": "observed", "sequences": 1, "grid": {"iterations": [1, 2]}}
    suite = put(tmp_path, rows=[row], datasets=["data/first", "data/second"])
    surgbench("run", "--suite", suite, "--out", tmp_path / "runs")
    made = records(tmp_path / "runs")
    assert {(one["spec"]["dataset"]["name"], one["spec"]["row_id"]) for one in made} == {
        (name, f"cmaes-iterations-{count}") for name in ("first", "second") for count in (1, 2)
    }
    capsys.readouterr()
    surgbench("run", "--suite", suite, "--dataset", tmp_path / "data/first", "--out", tmp_path / "one", "--dry-run")
    assert len(capsys.readouterr().out.split()) == 2
    surgbench("run", "--tracker", "cmaes", "--out", tmp_path / "none", expect=2)
    assert "say on what: --dataset DIR" in capsys.readouterr().err
