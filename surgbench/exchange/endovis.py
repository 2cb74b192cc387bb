"""EndoVis: points that people marked on two instruments, with pictures and masks where they are there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.config import Finite
from surgbench.contract import Plugin
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.footage_options import FrameOptions, Masked
from surgbench.exchange.masks import SEQUENCE_ID
from surgbench.geometry import FloatArray
from surgbench.pictures import PICTURE_SUFFIXES, as_rgb
from surgbench.recordings.endovis import MarkedPoints, read_points
from surgbench.recordings.files import read_picture
from surgbench.recordings.frame_masks import picture_size
from surgbench.recordings.json_file import find_json
from surgbench.recordings.names import number_files
from surgbench.tasks.instrument.footage import Footage
from surgbench.tasks.instrument.format import ARMS, Arm
from surgbench.tasks.instrument.imported import write_import

TIPS = ("left_clasper", "right_clasper")
# What tells from which side a shaft enters, the surest first.
_REAR = ("end", "shaft", "head")


class EndoVisImporter(Plugin):
    """``labels.json`` with its pictures, and masks where there are any."""

    name: ClassVar[str] = "endovis"
    summary: ClassVar[str] = "EndoVis: labels.json (points marked on two instruments), its pictures, camera.json"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import endovis labels.json --camera camera.json --tools tool4=left,tool1=right --out data/endovis",
    )

    class Config(FrameOptions):
        """Options."""

        fps: Annotated[Finite, Field(gt=0, description="Frames per second; EndoVis has 25.")] = 25.0
        images: Annotated[
            Path | None,
            Field(description="FOLDER of the pictures; default: where labels.json is, or images/ beside it."),
        ] = None
        tools: Annotated[
            str | None,
            Field(description="IDS of each arm, as tool4=left,tool1=right; default: by the side that shafts enter."),
        ] = None

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many pictures the labels are of."""
        return len(self._read(source).names)

    @staticmethod
    def _read(source: Path) -> MarkedPoints:
        return read_points(find_json(source, "endovis", "labels.json"))

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of it, line by line."""
        config, lines = self.config, list[str]()
        points = self._read(source)
        folder = points.path.parent
        places = {folder / name: place for place, name in enumerate(points.names)}
        numbered = number_files(places)
        order = [places[path] for path in numbered.values()]
        pictures = self._pictures(folder, [Path(points.names[place]).name for place in order])
        size = None if pictures is None else picture_size(pictures[0])
        camera = config.read(folder, size, lines.append)
        arms = tool_arms(points, config.tools)
        lines.append(
            f"{points.marked} of {len(order)} pictures are marked; "
            + ", ".join(f"{tool} is the {arm} arm" for tool, arm in arms.items())
            + (" (by the side that its shaft comes from; --tools says otherwise)" if config.tools is None else "")
        )
        shown: tuple[Arm, ...] = tuple(arm for arm in ARMS if arm in arms.values())
        numbers = list(numbered)
        masked = Masked(config, config.masks, (camera.width, camera.height), numbers, shown)
        keep = masked.frames
        rows = np.array(order)[keep]
        labels = {
            label: {arm: by_tool[tool][rows] for tool, arm in arms.items()} for label, by_tool in points.labels.items()
        }

        def images(wanted: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
            assert pictures is not None
            return (as_rgb(read_picture(pictures[frame], camera.width, camera.height)) for frame in wanted)

        footage = Footage(
            id=SEQUENCE_ID,
            camera=camera,
            times_s=(np.array(numbers, dtype=np.float64)[keep] - numbers[keep[0]]) / config.fps,
            names=[Path(points.names[row]).stem for row in rows],
            shots=lambda: masked.shots(keep, None if pictures is None else images),
            arms=shown,
            kinds=masked.kinds,
            images=pictures is not None,
            tips=_tips(labels, shown),
            labels=labels,
            dt_s=1.0 / config.fps,
        )
        said = write_import(
            out,
            [footage],
            name=config.name or points.path.resolve().parent.name,
            instruments=config.instruments(),
            configuration={**config.configuration(self.name), "tools": {arm: tool for tool, arm in arms.items()}},
            progress=progress,
        )
        return [*lines, *points.notes, *masked.lines, *said]

    def _pictures(self, folder: Path, names: Sequence[str]) -> list[Path] | None:
        """Files of the pictures; ``None`` where there are none."""
        places = [self.config.images] if self.config.images is not None else [folder / "images", folder]
        for place in places:
            found = [path for name in names if (path := _picture(place, name)) is not None]
            if len(found) == len(names):
                return found
            if found or self.config.images is not None:
                there = {path.stem for path in found}
                missing = next(name for name in names if Path(name).stem not in there)
                raise DatasetError(f"{place / missing}: missing; --images FOLDER says where the pictures are")
        return None


def tool_arms(points: MarkedPoints, told: str | None) -> dict[str, Arm]:
    """Tool to arm.

    Args:
        points: What is marked of them.
        told: As ``tool4=left,tool1=right``; else the tool whose shaft is further left is the left arm's.

    Raises:
        ConfigError: More must be told; one line that names the option.
    """
    if told is not None:
        arms: dict[str, Arm] = {}
        for part in told.split(","):
            tool, _, arm = (word.strip() for word in part.partition("="))
            if tool not in points.tools or arm not in ARMS or arm in arms.values() or tool in arms:
                raise ConfigError(
                    f"--tools: must be like {_example(points.tools)} (of {', '.join(points.tools)}), not '{told}'"
                )
            arms[tool] = "left" if arm == "left" else "right"
        return arms
    if not points.tools:
        raise DatasetError(f"{points.path}: no point has an id of its tool")
    if len(points.tools) > 2:
        raise ConfigError(
            f"{points.path}: has {len(points.tools)} tools ({', '.join(points.tools)}); --tools "
            f"{_example(points.tools)} says which two are the arms"
        )
    sides = {tool: _side(points.labels, tool) for tool in points.tools}
    first, *rest = sorted(points.tools, key=lambda tool: sides[tool])
    if not rest:
        return {first: "left"}
    if not sides[first] < sides[rest[0]]:  # the same, or unknown
        raise ConfigError(f"{points.path}: which tool is which arm? --tools {_example(points.tools)}")
    return {first: "left", rest[0]: "right"}


def _side(labels: Mapping[str, Mapping[str, FloatArray]], tool: str) -> float:
    """Median column of the rearmost point that is marked."""
    for label in _REAR:
        columns = labels[label][tool][:, 0] if label in labels else np.empty(0)
        if not np.isnan(columns).all():
            return float(np.nanmedian(columns))
    every = np.concatenate([by_tool[tool][:, 0] for by_tool in labels.values()])
    return float(np.nanmedian(every)) if not np.isnan(every).all() else float("nan")


def _tips(labels: Mapping[str, Mapping[Arm, FloatArray]], arms: tuple[Arm, ...]) -> dict[Arm, FloatArray] | None:
    if not set(TIPS) <= set(labels):
        return None
    return {arm: np.stack([labels[tip][arm] for tip in TIPS], axis=1) for arm in arms}


def _picture(place: Path, name: str) -> Path | None:
    """A picture of that name, or of another kind."""
    candidates = [place / name, *(place / (Path(name).stem + suffix) for suffix in PICTURE_SUFFIXES)]
    return next((path for path in candidates if path.is_file()), None)


def _example(tools: Sequence[str]) -> str:
    return f"{tools[0]}=left,{tools[-1]}=right"
