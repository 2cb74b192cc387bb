"""What the ledgers of a dataset that is being written know, and what they do not believe."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from surgbench.dataset.writer import SCRATCH_NAME, DatasetWriter, collect, read_part, remove_ledgers, write_files
from surgbench.errors import DatasetError

FILES = {"a/one": b"first", "two": b"second"}


def ledger(root: Path, part: str = "p") -> Path:
    return root / SCRATCH_NAME / f"{part}.jsonl"


def test_the_manifest_gets_what_was_in_hand(tmp_path: Path) -> None:
    DatasetWriter(tmp_path, "p").write("k", FILES, {"frames": 3})
    DatasetWriter(tmp_path, "q").write("k", {"three": b""})
    (tmp_path / "two").write_bytes(b"damage")
    files = collect(tmp_path, ["p", "q"], ["a/one", "two", "three"])
    for file, data in {**FILES, "three": b""}.items():
        assert (files[file].bytes, files[file].sha256) == (len(data), hashlib.sha256(data).hexdigest())
    assert read_part(tmp_path, "p")["k"].about == {"frames": 3}
    remove_ledgers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "three", "two"]


def test_another_process_knows_what_is_done(tmp_path: Path) -> None:
    DatasetWriter(tmp_path, "p").write("k", FILES, {"frames": 3})
    writer = DatasetWriter(tmp_path, "p")
    done = writer.done("k")
    assert done is not None
    assert done.about == {"frames": 3}
    assert writer.done("other") is None
    assert DatasetWriter(tmp_path, "q").done("k") is None


@pytest.mark.parametrize("data", [None, b"", b"secon", b"sEcond", b"second "])
def test_what_the_disk_does_not_hold_is_not_done(tmp_path: Path, data: bytes | None) -> None:
    writer = DatasetWriter(tmp_path, "p")
    writer.write("k", FILES)
    assert writer.done("k") is not None
    (tmp_path / "two").unlink()
    if data is not None:
        (tmp_path / "two").write_bytes(data)
    assert writer.done("k") is None
    writer.write("k", FILES)
    assert writer.done("k") is not None


def test_a_line_is_whole_or_does_not_count_and_spoils_no_other(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, "p")
    writer.write("first", {"one": b"1"})
    whole = ledger(tmp_path).read_bytes()
    writer.write("second", {"two": b"2"})
    both = ledger(tmp_path).read_bytes()
    for end in range(len(whole), len(both)):
        ledger(tmp_path).write_bytes(both[:end])
        # All but the line's end is a whole line too.
        known = {"first", "second"} if end == len(both) - 1 else {"first"}
        assert set(read_part(tmp_path, "p")) == known
        DatasetWriter(tmp_path, "p").write("third", {"three": b"3"})
        assert set(read_part(tmp_path, "p")) == {*known, "third"}
    ledger(tmp_path).write_bytes(b"\0\0\n" + whole + b"\xff\n[]\n{}\n3")
    assert set(read_part(tmp_path, "p")) == {"first"}


def test_the_last_word_counts(tmp_path: Path) -> None:
    for data in (b"old", b"newer"):
        DatasetWriter(tmp_path, "p").write("k", {"one": data})
    assert collect(tmp_path, ["p"], ["one"])["one"].bytes == 5
    assert DatasetWriter(tmp_path, "p").done("k") is not None


def test_nothing_is_noted_of_what_could_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    with pytest.raises(OSError, match="one"):
        DatasetWriter(tmp_path, "p").write("k", {"two": b"2", "one": b"1"})
    assert read_part(tmp_path, "p") == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


def test_a_full_disk_names_the_file_and_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system names none where it was open already."""

    def full(path: Path, data: bytes) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="one") as raised:
        write_files(tmp_path, {"one": b"1"})
    assert (raised.value.errno, raised.value.filename) == (28, str(tmp_path / "one"))
    assert not list(tmp_path.iterdir())


def test_a_file_that_nobody_wrote_is_one_line(tmp_path: Path) -> None:
    write_files(tmp_path, {"one": b"1"})
    with pytest.raises(DatasetError, match=r"^[^\n]*one: not in the ledgers in [^\n]*$"):
        collect(tmp_path, ["p"], ["one"])
