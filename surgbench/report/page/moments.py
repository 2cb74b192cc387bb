"""Which moments of which runs are shown, and their pictures."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from surgbench.dataset.open import open_dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.records.format import Record
from surgbench.report.drawing import Picture
from surgbench.report.encoders import has_h264
from surgbench.report.filmed import Filmed
from surgbench.report.movie import write_video
from surgbench.report.page.content import Filmstrip, Gallery, Moment, clipped
from surgbench.report.page.curves import Curves, values_of
from surgbench.task import find_task

KINDS = ("best", "median", "worst")
SEQUENCES = 3  # of each table: those that its best row is best, middling and worst on
AROUND_S = 1.0  # that a film shows before and after its moment
AROUND_BYTES = 1000  # that the page has beside a picture: its caption, its place
QUALITY = 80  # of WebP
NO_FILMS = (
    "There are no films: this page was made without an encoder for H.264, which browsers play "
    "(pip install 'surgbench[video]')."
)
FULL = "Some pictures or films are left out: the page would be larger than {} MB."

Progress = Callable[[str, float], Any]


@dataclass(frozen=True)
class Choice:
    """A moment of a run, not yet drawn."""

    kind: str
    place: int


def choose(values: FloatArray) -> list[Choice]:
    """The best, the median and the worst of a run's frames; fewer where they are the same or there are none.

    Args:
        values: ``(T,)``, less is better, NaN for none.
    """
    there = np.flatnonzero(np.isfinite(values))
    if not len(there):
        return []
    known = values[there]
    middle = there[np.argmin(np.abs(known - np.median(known)))]
    places = (there[np.argmin(known)], middle, there[np.argmax(known)])
    found: dict[int, str] = {}
    for kind, place in zip(KINDS, places, strict=True):
        found.setdefault(int(place), kind)
    return [Choice(kind, place) for place, kind in found.items()]


def chosen_units(curves: Curves, place: int) -> list[str]:
    """Units that a row is best, middling and worst on."""
    means = {}
    for unit in curves.units:
        record = curves.runs.get((place, unit))
        values = np.empty(0) if record is None else values_of(record, curves.measures[0])
        if np.isfinite(values).any():
            means[unit] = float(np.nanmean(values))
    ordered = sorted(means, key=lambda unit: (means[unit], unit))
    places = {round(one) for one in np.linspace(0, len(ordered) - 1, min(SEQUENCES, len(ordered)))}
    return [ordered[one] for one in sorted(places)]


@dataclass(frozen=True)
class Drawing:
    """What is to be drawn of one run."""

    curves: Curves
    row: int
    unit: str
    choices: tuple[Choice, ...]

    @property
    def record(self) -> Record:
        """The run."""
        return self.curves.runs[self.row, self.unit]

    def anchor(self, choice: Choice) -> str:
        """What links to a moment name."""
        unit = self.curves.units.index(self.unit)
        return f"moment-{self.curves.group.number}-{self.row}-{unit}-{choice.kind}"


def planned(all_curves: Sequence[Curves], rows: int) -> list[Drawing]:
    """What to draw: of each table so many of its best sound rows, on the same few units.

    Args:
        all_curves: Of all tables.
        rows: Of each.
    """
    drawings = []
    for curves in all_curves:
        sound = [place for place in curves.group.whole if curves.group.rows[place]["status"] == "ok"][:rows]
        if not sound or not curves.measures:
            continue
        for unit in chosen_units(curves, sound[0]):
            for place in sound:
                if (place, unit) in curves.runs:
                    values = values_of(curves.runs[place, unit], curves.measures[0])
                    drawings.append(Drawing(curves, place, unit, tuple(choose(values))))
    return [one for one in drawings if one.choices]


class Still(NamedTuple):
    """A picture as a ``data:`` URI, its width and height."""

    data: str
    size: tuple[int, int]


class Pictures:
    """Draws moments until there is no more room for them.

    Args:
        room: Bytes that all of them may take on the page.
        known: Hashes of the datasets that there are runs on.
        moved: Where the dataset of some of the runs is now.

    Raises:
        DatasetError: There is no dataset where it is said to be, or none that any of them was made on.

    Attributes:
        problems: Why some runs have no pictures, one line each.
        full: Something was left out.
    """

    def __init__(self, room: int, known: Collection[str], moved: Path | None = None) -> None:
        self.problems: list[str] = []
        self.full = False
        self._room = room
        self._moved = moved
        self._moved_hash = None if moved is None else open_dataset(moved).hash
        if self._moved_hash is not None and self._moved_hash not in known:
            raise DatasetError(f"{moved}: not the dataset of any of these runs (its hash differs)")
        self._missing: set[str] = set()

    def draw(self, drawings: Sequence[Drawing], progress: Progress) -> list[Gallery]:
        """Draw stills of all, then films as far as there is room."""
        stills: dict[str, Still] = {}
        clips: dict[str, str] = {}
        legends: dict[int, str] = {}
        films = has_h264()
        total = sum(len(one.choices) for one in drawings) * (2 if films else 1)
        if not total:
            return []
        with progress("pictures drawn", total) as advance:
            runs: list[tuple[Drawing, Filmed]] = []
            for number, drawing in enumerate(drawings):
                filmed = self._filmed(drawing.record)
                if filmed is None:
                    advance(len(drawing.choices) * (2 if films else 1))
                    continue
                runs.append((drawing, filmed))
                legends[number] = filmed.legend
                for choice in drawing.choices:
                    picture = self._still(filmed, drawing, choice)
                    data = None if picture is None else self._kept(_webp(picture))
                    if picture is not None and data is not None:
                        stills[drawing.anchor(choice)] = Still(data, (picture.shape[1], picture.shape[0]))
                    advance(1)
            for drawing, filmed in runs if films else ():
                for choice in drawing.choices:
                    if drawing.anchor(choice) in stills and not self.full:
                        clip = self._kept(self._clip(filmed, drawing, choice))
                        if clip is not None:
                            clips[drawing.anchor(choice)] = clip
                    advance(1)
        return _galleries(drawings, stills, clips, legends)

    def _filmed(self, record: Record) -> Filmed | None:
        dataset = record.spec.dataset
        if dataset.sha256 in self._missing:
            return None
        task = find_task(record.spec.task)
        try:
            return task.filmed(record, self._moved if dataset.sha256 == self._moved_hash else None)
        except DatasetError:
            # Where it was is nobody's business whom the page is sent to.
            self._missing.add(dataset.sha256)
            self._say(
                f"Dataset '{clipped(dataset.name)}' is not where it was when the runs were made, or has changed: "
                "there are no pictures of them (surgbench report … --dataset PATH)."
            )
        except SurgbenchError as error:
            self._say(clipped(str(error)))
        return None

    def _still(self, filmed: Filmed, drawing: Drawing, choice: Choice) -> Picture | None:
        try:
            frame = drawing.record.frames.index[choice.place]
            return filmed.picture(frame) if 0 <= frame < filmed.frames else None
        except SurgbenchError as error:
            self._say(clipped(f"{drawing.record.spec.row_id}, {drawing.unit}: {error}"))
            return None

    def _clip(self, filmed: Filmed, drawing: Drawing, choice: Choice) -> bytes | None:
        frame = drawing.record.frames.index[choice.place]
        around = max(1, round(AROUND_S / filmed.dt_s / filmed.every)) * filmed.every
        frames = [one for one in range(frame - around, frame + around + 1, filmed.every) if 0 <= one < filmed.frames]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "clip.mp4"
            try:
                write_video(path, _pictures(filmed, frames), 1.0 / (filmed.every * filmed.dt_s))
            except SurgbenchError as error:
                self._say(clipped(f"{drawing.record.spec.row_id}, {drawing.unit}: {error}"))
                return None
            return path.read_bytes()

    def _kept(self, data: bytes | None) -> str | None:
        """As a ``data:`` URI, where there is room for it."""
        if data is None:
            return None
        kind = "image/webp" if data[:4] == b"RIFF" else "video/mp4"
        text = f"data:{kind};base64,{base64.b64encode(data).decode()}"
        needed = len(text) + AROUND_BYTES
        if needed > self._room:
            self.full = True
            return None
        self._room -= needed
        return text

    def _say(self, problem: str) -> None:
        if problem not in self.problems:
            self.problems.append(problem)


def _pictures(filmed: Filmed, frames: Sequence[int]) -> Iterator[Picture]:
    for frame in frames:
        yield filmed.picture(frame)


def _webp(picture: Picture) -> bytes:
    done, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not done:
        raise SurgbenchError("pictures cannot be encoded: OpenCV has no WebP encoder")
    return data.tobytes()


def _galleries(
    drawings: Sequence[Drawing], stills: dict[str, Still], clips: dict[str, str], legends: dict[int, str]
) -> list[Gallery]:
    """What was drawn, table by table, unit by unit."""
    strips: dict[int, list[Filmstrip]] = {}
    titles: dict[int, str] = {}
    for number, drawing in enumerate(drawings):
        moments = [
            described(drawing, choice, stills.get(anchor), clips.get(anchor))
            for choice in drawing.choices
            if (anchor := drawing.anchor(choice)) in stills
        ]
        if moments:
            group = drawing.curves.group
            titles[group.number] = group.title
            row = row_name(drawing.curves, drawing.row)
            strips.setdefault(group.number, []).append(
                Filmstrip(row, clipped(drawing.unit), legends[number], tuple(moments))
            )
    return [Gallery(titles[number], tuple(own)) for number, own in strips.items()]


def row_name(curves: Curves, place: int) -> str:
    """What a row is called, with its variant where others of its table have its name."""
    rows = curves.group.rows
    row = rows[place]
    namesakes = [rows[other] for other in curves.group.whole if rows[other]["row_id"] == row["row_id"]]
    return clipped(f"{row['row_id']} ({row['variant']})" if len(namesakes) > 1 else row["row_id"], 200)


def described(drawing: Drawing, choice: Choice, still: Still | None = None, clip: str | None = None) -> Moment:
    """A moment with its frame and error."""
    measure = drawing.curves.measures[0]
    value = float(values_of(drawing.record, measure)[choice.place])
    text = f"{measure.name} {value:.{3 if measure.decimals is None else measure.decimals}f}"
    return Moment(
        drawing.anchor(choice),
        choice.kind,
        choice.place,
        drawing.record.frames.index[choice.place],
        f"{text} {measure.unit}".strip(),
        None if still is None else still.data,
        (0, 0) if still is None else still.size,
        clip,
    )
