"""Folders and files of strangers, made to do harm: one line for each, nothing written outside, nothing waited for."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fabricate
import numpy as np
import pyarrow as pa
import pytest
from commandline import RUN, surgbench
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from pydantic import TypeAdapter, ValidationError
from readers import READERS, samples
from small_dataset import CAMERA, FRAMES, make_pair

from surgbench.dataset.open import open_as, open_dataset
from surgbench.dataset.storage import file_entry
from surgbench.dataset.tables import decode_table
from surgbench.dataset.validate import validate
from surgbench.errors import SurgbenchError
from surgbench.files import read_whole
from surgbench.records.reader import read_record, read_records
from surgbench.tasks.instrument.dataset import InstrumentDataset

MASK = "sequences/000/observed/left/000001.png"
TABLE = "sequences/000/observations.parquet"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("strangers") / "set"
    make_pair(root, sequences=1, frames=FRAMES)
    return root


@pytest.fixture
def root(sound: Path, tmp_path: Path) -> Path:
    """A copy to be altered."""
    return shutil.copytree(sound, tmp_path / "set")


def alter(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a dataset's manifest."""
    manifest = json.loads((root / "dataset.json").read_text())
    change(manifest)
    (root / "dataset.json").write_text(json.dumps(manifest))


def replace(root: Path, file: str, data: bytes) -> None:
    """Write another file in one's place, and have the manifest agree with it."""
    (root / file).write_bytes(data)
    alter(root, lambda manifest: manifest["files"].update({file: file_entry(data).model_dump()}))


def flat_png(side: int) -> bytes:
    """A small file of a large black picture."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + side // 8)) for _ in range(side)) + packer.flush()
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


# Datasets

NAMES = ["../../evil", "/tmp/evil", "", "..", "a/b", "a\\b", "a\0b", "a\nb", "\x1b[31m", "</script>", "x" * 5000]


@pytest.mark.parametrize("name", NAMES)
def test_a_dataset_cannot_choose_where_its_records_go(
    name: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alter(root, lambda manifest: manifest.update(name=name))
    there = set(tmp_path.rglob("*"))
    surgbench(*RUN, "--dataset", root, "--tracker", "cmaes", "--out", tmp_path / "a/b/out", expect=2)
    assert set(tmp_path.rglob("*")) == there
    assert capsys.readouterr().err.startswith(f"surgbench: {root}/dataset.json: 'name': ")


@pytest.mark.parametrize("name", NAMES)
def test_no_folder_or_record_has_a_name_that_leads_elsewhere(name: str, root: Path, tmp_path: Path) -> None:
    alter(root, lambda manifest: manifest["sequences"][0].update(id=name))
    with pytest.raises(SurgbenchError, match=r"'sequences\.0\.id': "):
        open_dataset(root)
    for key in ("unit", "sequence", "row_id", "dataset"):
        content = fabricate.record()
        content["spec"][key] = {"name": name, "sha256": "ab" * 32} if key == "dataset" else name
        path = tmp_path / "000-left-r0.json"
        path.write_text(json.dumps(fabricate.as_written(content)))
        if len(name) < 1000 or key == "dataset":
            if len(name) > 1000:  # long, but harmless: nothing is written by it
                continue
            with pytest.raises(SurgbenchError, match=rf"'spec\.{key}"):
                read_record(path)


@pytest.mark.parametrize("frames", [10**6, 10**9, 10**30])
def test_frames_that_are_not_there_are_not_counted(frames: int, root: Path) -> None:
    alter(root, lambda manifest: manifest["sequences"][0].update(frames=frames))
    (problem,) = validate(root)
    assert "less than or equal to 10000000" in problem or f"{frames} frames, each with a picture" in problem


def test_a_table_is_not_read_before_its_rows_are_counted() -> None:
    rows = 10_000_000
    buffer = io.BytesIO()
    column = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int8), [0.0])
    parquet.write_table(pa.table({"frame": column, "a": column}), buffer)
    assert len(buffer.getvalue()) < 100_000
    with pytest.raises(SurgbenchError, match="has 10000000 rows; expected one per frame, 4"):
        decode_table(buffer.getvalue(), "file", FRAMES, ["a"])


@pytest.mark.parametrize("side", [16_000, 50_000])
def test_a_picture_larger_than_its_camera_is_not_decoded(side: int, root: Path) -> None:
    replace(root, MASK, flat_png(side))
    (problem,) = validate(root)
    assert problem == f"{root / MASK}: is {side}x{side} pixels; its camera has {CAMERA.width}x{CAMERA.height}"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.parametrize("file", [MASK, TABLE, "dataset.json"])
def test_nobody_waits_for_a_pipe(file: str, root: Path) -> None:
    (root / file).unlink()
    os.mkfifo(root / file)
    assert validate(root)[0] == f"{root / file}: cannot be read (Not a regular file)"


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no such device here")
def test_a_device_is_no_file(root: Path) -> None:
    (root / MASK).unlink()
    (root / MASK).symlink_to("/dev/zero")
    assert validate(root) == [
        f"{root / MASK}: a link that leads out of the dataset's folder; put the file itself there"
    ]
    with pytest.raises(OSError, match="Not a regular file"):
        read_whole(root / MASK)


@pytest.mark.parametrize("target", ["/etc/hostname", "../../../../../elsewhere.png"])
@pytest.mark.parametrize("file", [MASK, TABLE])
def test_no_link_leads_out_of_a_dataset(
    target: str, file: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Though what it leads to be the very file."""
    (tmp_path / "elsewhere.png").write_bytes((root / file).read_bytes())
    (root / file).unlink()
    (root / file).symlink_to(target)
    line = f"{root / file}: a link that leads out of the dataset's folder; put the file itself there"
    assert validate(root) == [line]
    surgbench(*RUN, "--dataset", root, "--tracker", "cmaes", "--out", tmp_path / "runs", expect=2)
    assert capsys.readouterr().err.splitlines()[-1] == f"surgbench: {line}"
    (root / file).unlink()
    (root / f"{file}.real").write_bytes((tmp_path / "elsewhere.png").read_bytes())
    (root / file).symlink_to(f"{Path(file).name}.real")
    assert open_as(InstrumentDataset, root).sequence("000").mask("left", 1).any()  # within it, it may lead anywhere


@pytest.mark.parametrize(
    ("key", "value"),
    [("dt_s", 1e-320), ("dt_s", 1e300), ("fx", 1e300), ("fy", 1e-300), ("cx", 1e300), ("cy", -1e300)],
)
def test_numbers_that_no_camera_has_are_refused(
    key: str, value: float, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They made a run take minutes, and end in no numbers."""
    said = (
        "'sequences.0.dt_s': Input should be " if key == "dt_s" else f"camera 'camera': {key} is {value:g}; expected "
    )

    def change(manifest: dict[str, Any]) -> None:
        (manifest["sequences"][0] if key == "dt_s" else manifest["cameras"]["camera"]).update({key: value})

    alter(root, change)
    surgbench(*RUN, "--dataset", root, "--tracker", "cmaes", "--out", tmp_path / "runs", expect=2)
    told = capsys.readouterr().err
    assert told.startswith(f"surgbench: {root}/dataset.json: {said}")
    assert told.count("\n") == 1


def test_a_dataset_without_its_truth_is_told(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(root / "truth")
    surgbench(*RUN, "--dataset", root, "--tracker", "cmaes", "--out", tmp_path / "runs", expect=2)
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == f"surgbench: {root}/truth/000/states.parquet: missing"
    assert all(problem.endswith(": missing") for problem in validate(root))


ALIASES = "a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))


@pytest.mark.slow
@pytest.mark.parametrize("text", [ALIASES, "a: " + "[" * 5000 + "]" * 5000, "name: &a {b: *a}\n"])
def test_no_file_of_settings_takes_all_memory(
    text: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "file.yaml", ("--out", tmp_path / "out")
    file.write_text(text)
    recording = tmp_path / "recording"
    (recording / "masks").mkdir(parents=True)
    (recording / "masks/000000.png").write_bytes((root / MASK).read_bytes())
    (tmp_path / "motion.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n0.1,1,2,3,0,0,0,1\n")
    for command in (
        ("generate", file),
        ("run", "--dataset", root, "--suite", file),
        ("reproduce", file),
        ("train", "keypoints", file),
        ("train", "masks", file),
        ("import", "masks", recording, "--camera", file),
        ("import", "trajectory", tmp_path / "motion.csv", "--scene", file),
    ):
        surgbench(*command, *out, expect=2)
        told = capsys.readouterr().err
        assert told.startswith(f"surgbench: {file}: not valid YAML ("), told
        assert told.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_a_file_without_end_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "dataset.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no room
    with pytest.raises(SurgbenchError, match=r"cannot be read \(Larger than 256 MiB\)"):
        open_dataset(tmp_path)
    with pytest.raises(OSError, match="Larger than 1024 MiB"):
        read_whole(path)


def test_a_damaged_file_that_is_no_record_is_not_to_be_deleted(root: Path, tmp_path: Path) -> None:
    (root / "dataset.json").write_text("{")
    with pytest.raises(SurgbenchError, match=r"dataset\.json: truncated or not JSON \(.*\)$"):
        read_records([tmp_path])
    (root / "dataset.json").unlink()
    (tmp_path / "000-left-r0.json").write_text("{")
    with pytest.raises(SurgbenchError, match="delete it and run again"):
        read_records([tmp_path])


# Any bytes


def mutations(data: bytes) -> st.SearchStrategy[bytes]:
    """A file with some bytes replaced, cut out, doubled, or cut off, or something else altogether."""
    place = st.integers(0, len(data))
    odd = [b"\xff" * 8, b"\0" * 8, b"99999999999", b"-1e999", b"NaN", b"[" * 200, b"\n" * 3, b"&a [*a]", b"%YAML:1.0\n"]
    junk = st.binary(max_size=24) | st.sampled_from(odd)
    cut = st.tuples(place, place, junk).map(lambda t: data[: min(t[:2])] + t[2] + data[max(t[:2]) :])
    over = st.tuples(place, junk).map(lambda t: data[: t[0]] + t[1] + data[t[0] + len(t[1]) :])
    return cut | over | st.binary(max_size=200)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("fuzzed")
    yield folder
    assert {path.name for path in folder.iterdir()} <= set(READERS)


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_a_file_holds_its_reader_says_one_line(name: str, scratch: Path, data: st.DataObject) -> None:
    content = data.draw(mutations(samples()[name]))
    path = scratch / name
    path.write_bytes(content)
    said = ""
    try:
        READERS[name](path, content)
    except SurgbenchError as error:
        said = str(error)
    assert "\n" not in said


def test_what_a_stranger_says_is_one_line_without_orders_to_a_terminal() -> None:
    from surgbench.board.submission import Statement
    from surgbench.records.format import FileName, Plug

    evil = "X\x1b[2J\nfits: 4 scored again\x9b31m\x07"
    told = Statement.model_validate(
        {
            "format": "surgbench-submission-1",
            "created_by": evil,
            "by": evil,
            "text": evil,
            "rows": [evil],
            "datasets": {},
            "machines": [evil],
            "records": [{"file": "records/000000.json", "sha256": "0" * 64, "spec_hash": "0"}],
        }
    )
    for text in (told.created_by, told.by, told.text, *told.rows, *told.machines, Plug(name=evil).name):
        assert text.isprintable()
    for name in ("a\x1bb", "a\x9bb", "a\x7fb"):
        with pytest.raises(ValidationError):
            TypeAdapter(FileName).validate_python(name)


@pytest.mark.parametrize("command", ["report", "compare"])
def test_out_that_is_a_folder_is_said_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, runs = tmp_path / "data", tmp_path / "runs"
    make_pair(data)
    trackers = ("--tracker", "xnes", "--tracker", "cmaes", "--initialiser", "truth")
    surgbench(*RUN, "--dataset", data, *trackers, "--frames", 1, "--out", runs)
    for out in (tmp_path, Path("/")):
        capsys.readouterr()
        surgbench(command, runs, "--out", out, "--format", "csv", expect=2)
        assert "is a folder; name a file" in capsys.readouterr().err


def test_more_of_anything_than_anybody_needs_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data"
    make_pair(data)
    grid = tmp_path / "grid.yaml"
    keys = "".join(f"      cmaes.{key}: [{', '.join(map(str, range(10, 110)))}]\n" for key in ("a", "b", "c"))
    grid.write_text(f"rows:\n  - tracker: cmaes\n    grid:\n{keys}")
    command = (*RUN, "--dataset", data, "--out", tmp_path / "runs")
    surgbench(*command, "--suite", grid, expect=2)
    assert "1000000 combinations" in capsys.readouterr().err
    surgbench(*command, "--tracker", "cmaes", "--repeats", 10**20, expect=2)
    assert "10000" in capsys.readouterr().err
