"""Two that would write in one place at once: one does, the other is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from commandline import surgbench

from surgbench.errors import DatasetError, SurgbenchError
from surgbench.locks import locked_beside, sole_writer


def test_one_writes_and_the_other_is_told(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with sole_writer(out, "import"):
        told = pytest.raises(DatasetError, match=r"^[^\n]*out: another 'surgbench import' is at work here[^\n]*--out$")
        with told, sole_writer(out, "import"):
            pass
        (out / "file").touch()
    with sole_writer(out, "import"):  # it is free again
        pass
    assert (out / "file").exists()


def test_nothing_is_left_where_nothing_came_of_it(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for name in ("old", "new"):
        with pytest.raises(ValueError, match="half way"), sole_writer(tmp_path / name, "import"):
            raise ValueError("half way")
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


def test_a_folder_that_is_put_in_its_place_is_held_no_longer(tmp_path: Path) -> None:
    """As an importer does: it works beside, and renames at the end."""
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    with sole_writer(out, "import"):
        scratch.mkdir()
        (scratch / "file").touch()
        scratch.rename(out)
        with sole_writer(out, "import"):
            assert (out / "file").exists()
    assert (out / "file").exists()


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_a_file_is_no_folder(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    refused = pytest.raises(SurgbenchError, match=r"^[^\n]*file: is a file; --out needs a folder$")
    with refused, sole_writer(tmp_path / place, "import"):
        pass


def test_a_lock_that_a_killed_process_left_holds_nobody_up(tmp_path: Path) -> None:
    (tmp_path / "rows.csv.lock").touch()
    with locked_beside(tmp_path / "rows.csv") as ours:
        assert ours
        with locked_beside(tmp_path / "rows.csv") as theirs:
            assert not theirs
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "arguments"),
    [("import", ("masks", "nowhere", "--out")), ("train", ("keypoints", "resnet18", "--out"))],
)
def test_every_command_that_fills_a_folder_holds_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, arguments: tuple[str, ...]
) -> None:
    with sole_writer(tmp_path, command):
        surgbench(command, *arguments, tmp_path, expect=2)
    complaint = capsys.readouterr().err
    assert f"another 'surgbench {command}' is at work here" in complaint
    assert complaint.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_model_does_not_move_into_something_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dataset.json").touch()
    surgbench("train", "keypoints", "--out", tmp_path, expect=2)
    assert "holds something else ('dataset.json')" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.json"]
