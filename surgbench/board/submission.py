"""A submission: the records of runs in one file, with their hashes and a statement of what was run."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from surgbench.config import Section, one_line, parse_model
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import MOST_JSON_BYTES, sha256_bytes, sha256_file, write_atomic
from surgbench.leftovers import without_leftovers
from surgbench.records.format import SKIPPED, Record
from surgbench.records.reader import parse_record, read_record
from surgbench.records.seal import check_seal
from surgbench.syntax import parse_json
from surgbench.version import __version__

FORMAT: Literal["surgbench-submission-1"] = "surgbench-submission-1"
ABOUT = "submission.json"
# Nobody hands in as much; what has more was made to take all memory.
MOST_RECORDS, MOST_BYTES = 100_000, 1 << 30
# Every file bears the same date, so that the same runs are the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Line = Annotated[str, Field(max_length=1000), AfterValidator(one_line)]


class Listed(Section):
    """A record of a submission."""

    file: Annotated[str, Field(pattern=r"^records/\d{1,6}\.json$")]
    sha256: Sha256
    spec_hash: Annotated[str, Field(max_length=64)]


class Statement(Section):
    """What a submission says of itself.

    Attributes:
        format: Of the file.
        created_by: Version that made it.
        by: Who hands it in.
        text: What they say of it: where the method is described, where its code is.
        rows: Names of its rows.
        datasets: Name to SHA-256 of the ``dataset.json`` that its runs are about.
        machines: Processors that it was run on.
        records: All of its records.
    """

    format: Literal["surgbench-submission-1"]
    created_by: Line
    by: Line
    text: Annotated[str, Field(max_length=10_000), AfterValidator(one_line)] = ""
    rows: tuple[Line, ...]
    datasets: dict[str, Sha256]
    machines: tuple[Line, ...]
    records: Annotated[tuple[Listed, ...], Field(min_length=1, max_length=MOST_RECORDS)]


@dataclass(frozen=True)
class Submission:
    """A submission that was read.

    Attributes:
        path: The file.
        statement: What it says of itself.
        records: As a report reads them, in order.
        sha256: Of the file.
    """

    path: Path
    statement: Statement
    records: tuple[Record, ...]
    sha256: str

    def content(self, number: int) -> dict[str, Any]:
        """The whole content of a record."""
        name = self.statement.records[number].file
        with zipfile.ZipFile(self.path) as archive:
            content: dict[str, Any] = _json(archive, name, self.path)
            return content


def write_submission(places: Iterable[Path], out: Path, by: str, text: str = "") -> Statement:
    """Put runs into one file. The same runs give the same bytes.

    Args:
        places: Folders of records.
        out: The file.
        by: Who hands them in.
        text: What they say of them.

    Returns:
        What it says of itself.

    Raises:
        DatasetError: A folder has no records, or one is damaged or altered.
        SurgbenchError: A run failed, was skipped or knew the truth, or the file cannot be written.
    """
    found: dict[str, tuple[Record, bytes]] = {}
    for place in places:
        if not place.is_dir():
            raise DatasetError(f"{place}: no such folder of records")
        for path in sorted(without_leftovers(place.rglob("*.json"), place)):
            record = read_record(path)
            if record is not None:
                found.setdefault(record.spec_hash, (record, path.read_bytes()))
    if not found:
        raise DatasetError(f"{', '.join(map(str, places))}: no records (*.json of surgbench run)")
    for record, _ in found.values():
        _check_sound(record)
    ordered = [found[key] for key in sorted(found)]
    names = [f"records/{number:06d}.json" for number in range(len(ordered))]
    statement = Statement(
        format=FORMAT,
        created_by=f"surgbench {__version__}",
        by=by,
        text=text,
        rows=tuple(sorted({record.spec.row_id for record, _ in ordered})),
        datasets={record.spec.dataset.name: record.spec.dataset.sha256 for record, _ in ordered},
        machines=tuple(sorted({_machine(parse_json(data)) for _, data in ordered})),
        records=tuple(
            Listed(file=name, sha256=sha256_bytes(data), spec_hash=record.spec_hash)
            for name, (record, data) in zip(names, ordered, strict=True)
        ),
    )
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        _put(archive, ABOUT, (json.dumps(statement.model_dump(mode="json"), indent=1) + "\n").encode())
        for name, (_, data) in zip(names, ordered, strict=True):
            _put(archive, name, data)
    try:
        write_atomic(out, packed.getvalue())
    except OSError as error:
        raise SurgbenchError(f"{out}: cannot be written ({error.strerror})") from None
    return statement


def read_submission(path: Path) -> Submission:
    """Read a submission that anybody may have made. Nothing of it is written anywhere.

    Raises:
        DatasetError: It is none, or a record of it is missing, too many, damaged, altered, or not sound; one line.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive, path)
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file (made by: surgbench submit)") from None
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise DatasetError(f"{path}: no submission (a file that surgbench submit makes): {error}") from None


def _read(archive: zipfile.ZipFile, path: Path) -> Submission:
    sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    if len(sizes) != len(archive.infolist()) or len(sizes) > MOST_RECORDS + 1 or sum(sizes.values()) > MOST_BYTES:
        raise DatasetError(f"{path}: holds a name twice, more than {MOST_RECORDS} records, or more than 1 GiB")
    if ABOUT not in sizes:
        raise DatasetError(f"{path}: no submission: it lacks {ABOUT}")
    statement = parse_model(Statement, _json(archive, ABOUT, path), f"{path}: {ABOUT}")
    listed = {one.file for one in statement.records}
    strangers = sorted(sizes.keys() - listed - {ABOUT})
    if strangers or len(listed) != len(statement.records):
        raise DatasetError(f"{path}: holds what it does not list ({', '.join(strangers[:1]) or 'a record twice'})")
    records = []
    for one in statement.records:
        if one.file not in sizes:
            raise DatasetError(f"{path}: lacks {one.file}, which it lists")
        data = _bytes(archive, one.file, path)
        place = path / one.file
        if sha256_bytes(data) != one.sha256:
            raise DatasetError(f"{place}: not the record that the submission lists (another hash)")
        content = _parsed(data, place)
        if not isinstance(content, dict):
            raise DatasetError(f"{place}: not a record")
        check_seal(content, place)
        record = parse_record(content, place)
        if record.spec_hash != one.spec_hash:
            raise DatasetError(f"{place}: a record of another run than the submission lists")
        _check_sound(record)
        records.append(record)
    if len({record.spec_hash for record in records}) < len(records):
        raise DatasetError(f"{path}: holds one run twice")
    return Submission(path, statement, tuple(records), sha256_file(path))


def _check_sound(record: Record) -> None:
    what = f"{record.spec.row_id} {record.spec.unit} r{record.spec.repeat}"
    if record.status == SKIPPED:
        raise SurgbenchError(f"{what}: was skipped ({record.error}); hand in runs that were made")
    if record.status != "ok":
        raise SurgbenchError(
            f"{what}: {record.status} ({record.error}); runs that fail are run again, or left out whole"
        )
    if record.floor:
        raise SurgbenchError(f"{what}: is a floor, which knew the truth; it is not for ranking")


def _machine(content: dict[str, Any]) -> str:
    machine = (content.get("environment") or {}).get("machine") or {}
    return str(machine.get("processor", "unknown"))


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _DATE), data, zipfile.ZIP_DEFLATED)


def _bytes(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    with archive.open(name) as file:  # the header may lie about the size
        data = file.read(MOST_JSON_BYTES + 1)
    if len(data) > MOST_JSON_BYTES:
        raise DatasetError(f"{path / name}: larger than {MOST_JSON_BYTES >> 20} MiB")
    return data


def _json(archive: zipfile.ZipFile, name: str, path: Path) -> Any:
    return _parsed(_bytes(archive, name, path), path / name)


def _parsed(data: bytes, place: Path) -> Any:
    try:
        return parse_json(data)
    except ValueError as error:
        raise DatasetError(f"{place}: truncated or not JSON ({error})") from None
