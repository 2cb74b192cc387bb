"""What docs/viewpoint.md tells a newcomer with a recorded motion to type, typed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from commandline import surgbench
from trajectories import feature, put_table

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file())


@pytest.mark.slow
def test_four_commands_make_a_table_and_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "viewpoint.md").read_text(encoding="utf-8")
    block = re.search(r"## One's own motion\n.*?```sh\n(.*?)```", page, re.DOTALL)
    assert block is not None
    commands = [shlex.split(line) for line in block[1].splitlines()]
    assert [words[:2] for words in commands] == [["surgbench", word] for word in ("import", "run", "report", "video")]
    put_table(tmp_path / "path.csv", *feature())
    monkeypatch.chdir(tmp_path)
    for words in commands:
        surgbench(*words[1:])
    table = Path("mine.md").read_text(encoding="utf-8")
    for tracker in ("gaze", "autocam", "naive"):
        assert f"| {tracker} | default | all |" in table
    assert list(Path("pictures").rglob("*.mp4"))
