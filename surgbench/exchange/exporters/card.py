"""Dataset cards: ``README.md`` of a dataset, to be published beside it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from surgbench.config import Section, packaged_names
from surgbench.contract import Plugin
from surgbench.dataset.base import Dataset
from surgbench.dataset.card import CARD_NAME, Facts, card
from surgbench.errors import ConfigError
from surgbench.exporting import Material
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.version import __version__

GENERATED_LICENCE = "apache-2.0"
TAGS = ("surgical-robotics", "da-vinci", "surgbench")
CITE = """@software{surgbench,
  title = {surgbench: a benchmark suite for surgical instrument tracking},
  author = {{The surgbench developers}},
  version = {VERSION},
}"""
WHAT = {
    "instrument": "Masks of da Vinci instruments, with what a robot and a detector read of them, for estimating their "
    "poses and joints.",
    "viewpoint": "The way of a ring along a bent wire, as it was measured, for controllers of an arm that holds a "
    "camera.",
}


class CardExporter(Plugin):
    """``README.md``, as hubs for datasets show it."""

    name: ClassVar[str] = "card"
    summary: ClassVar[str] = "a dataset card, Markdown with a YAML head, to be put beside its dataset.json"

    class Config(Section):
        """Options: what a dataset does not know of itself."""

        what: Annotated[str | None, Field(description="What it is, a sentence or two.")] = None
        license: Annotated[str | None, Field(description="Its licence, as hubs name it: cc-by-4.0.")] = None
        cite: Annotated[str | None, Field(description="How to cite it, BibTeX for example.")] = None

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def count(self, material: Material) -> int:
        """Files listed in the manifest: none of them is read."""
        return len(self._dataset(material).manifest.files)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the card."""
        dataset = self._dataset(material)
        facts = facts_of(dataset, self.config.what, self.config.license, self.config.cite)
        (folder / CARD_NAME).write_text(card(facts), encoding="utf-8")
        progress(len(dataset.manifest.files))

    @staticmethod
    def _dataset(material: Material) -> Dataset[Any]:
        if material.dataset is None:
            raise ConfigError("--format card describes datasets; for runs choose csv, tum, bop or coco")
        return material.dataset


def facts_of(
    dataset: Dataset[Any], what: str | None = None, licence: str | None = None, cite: str | None = None
) -> Facts:
    """What a card says of a dataset; all of it from its manifest.

    Args:
        dataset: Of one of our tasks, or of any.
        what: What it is, if more is known of it than its task.
        licence: Its licence; that of this package for what it generated itself.
        cite: How to cite it; this package for what that generated.
    """
    manifest = dataset.manifest
    generated = manifest.origin == "generated"
    sensors, truth, cameras, limits = _told(dataset)
    lengths = {unit.sequence: dataset.length(unit.sequence) for unit in _units(dataset)}
    return Facts(
        name=manifest.name,
        task=manifest.task,
        what=what or WHAT.get(manifest.task, f"Data of the {manifest.task} task."),
        origin=manifest.origin,
        units=dict(lengths),
        frames=sum(lengths.values()),
        sensors=sensors,
        truth=truth,
        cameras=cameras,
        conventions=manifest.conventions,
        lengths=manifest.units,
        limits=limits,
        sha256=dataset.hash,
        bytes=sum(entry.bytes for entry in manifest.files.values()),
        created_by=manifest.created_by,
        command=_command(dataset) if generated else None,
        licence=licence or (GENERATED_LICENCE if generated else "unknown"),
        tags=[*TAGS, "synthetic" if generated else "recorded", manifest.task],
        cite=cite or (CITE.replace("VERSION", __version__) if generated else ""),
    )


def _units(dataset: Dataset[Any]) -> list[Any]:
    """One for each sequence."""
    if isinstance(dataset, InstrumentDataset):
        from surgbench.tasks.instrument.dataset import InstrumentUnit

        return [InstrumentUnit(one.id, one.id, one.arms, "both") for one in dataset.sequences]
    return list(dataset.units())


def _command(dataset: Dataset[Any]) -> str | None:
    """What makes it again, of a preset that comes with the package."""
    configuration = dataset.manifest.configuration
    preset = configuration.get("preset", {})
    over = configuration.get("set", {})
    name = str(preset.get("name", ""))
    # Keys that were set stand in the name, behind the preset's own.
    known = max(
        (one for one in packaged_names("presets") if name == one or name.startswith(f"{one}-")), key=len, default=None
    )
    if known is None or (name != known and not over):
        return None
    words = ["surgbench generate", known]
    for option, key in (
        ("--sequences", "pairs"),
        ("--sequences", "trials"),
        ("--frames", "frames"),
        ("--frames", "samples"),
    ):
        if preset.get(key) is not None:
            words.append(f"{option} {preset[key]}")
    words += [f"--seed {preset['seed']}"] if "seed" in preset else []
    words += [f"--set {key}={value}" for key, value in sorted(over.items())]
    return " ".join([*words, f"--out data/{re.sub(r'[^A-Za-z0-9_.-]', '-', name)}"])


def _told(dataset: Dataset[Any]) -> tuple[list[str], list[str], list[str], list[str]]:
    """Sensors, truth, cameras and limits, a line each."""
    if isinstance(dataset, InstrumentDataset):
        return _instruments(dataset)
    if isinstance(dataset, ViewpointDataset):
        return _trials(dataset)
    return ["see `dataset.json`"], [], ["see `dataset.json`"], ["not described here"]


def _instruments(dataset: InstrumentDataset) -> tuple[list[str], list[str], list[str], list[str]]:
    entries = [sequence.entry for sequence in dataset.sequences]
    kinds = sorted({kind for entry in entries for kind in entry.kinds})
    rates = sorted({f"{1 / entry.dt_s:.4g}" for entry in entries})
    views = sorted({name for entry in entries for name in entry.auxiliary})
    sensors = {
        f"{' or '.join(rates)} frames a second": True,
        f"masks of the instruments, 1 bit: {', '.join(kinds)}": bool(kinds),
        "images, 8-bit RGB": any(entry.images for entry in entries),
        "pixels of both tips of the jaws": any(entry.keypoints for entry in entries),
        "readings of wrist pitch, wrist yaw and jaw": any(entry.readings for entry in entries),
        "readings of all six joints of the arm": any(entry.arm_joints for entry in entries),
        "the robot's readings of each tool's pose": any(entry.T_cam_base for entry in entries),
        f"auxiliary cameras: {', '.join(views)}": bool(views),
        "points that somebody marked": any(entry.labels for entry in entries),
    }
    true = any(entry.truth for entry in entries)
    truth = {
        "pose and joints of each arm in each frame": true,
        "masks before corruption": true,
        "how much of each arm is seen": any(entry.visibility for entry in entries),
        "depth": any(entry.depth for entry in entries),
        "which link is seen": any(entry.links for entry in entries),
    }
    cameras = [
        f"`{name}`: {one.width} x {one.height} pixels, fx {one.fx:g}, fy {one.fy:g}, cx {one.cx:g}, cy {one.cy:g}"
        f"{', with a lens' if one.is_distorted else ''}"
        for name, one in dataset.manifest.cameras.items()
    ]
    generated = dataset.manifest.origin == "generated"
    limits = {
        "Motion, masks and readings are simulated, with errors like published ones; no robot moved.": generated,
        "Images are rendered; tissue is textured surfaces, without needles, thread or breathing.": generated
        and any(entry.images for entry in entries),
        "A silhouette hardly tells a state from its twin (beta + pi, -q1, -q2).": True,
        "Masks of one arm show it as if the other one were not there.": any(len(entry.arms) > 1 for entry in entries),
        "No truth: errors are measured against marked points, readings and masks.": not true,
    }
    return _there(sensors), _there(truth), cameras, _there(limits)


def _trials(dataset: ViewpointDataset) -> tuple[list[str], list[str], list[str], list[str]]:
    entries = dataset.manifest.trials
    rates = sorted({f"{1 / entry.dt_s:.4g}" for entry in entries})
    true = any(entry.truth for entry in entries)
    sensors = [
        f"the ring's pose, {' or '.join(rates)} times a second",
        "points that both arms touched, and five points around the no-go zone",
    ]
    truth = (
        ["the ring's pose and its contact with the wire", "the base of the camera arm, and the wire"] if true else []
    )
    cameras = [f"held by the arm `{dataset.arm.name}`; the stereo camera is surgbench's own (AutoCam's calibration)"]
    limits = {
        "The hand that leads the ring is simulated; no person took part.": dataset.manifest.origin == "generated",
        "The scene is a wire and a zone; there is no tissue.": True,
    }
    return sensors, truth, cameras, _there(limits)


def _there(lines: dict[str, bool]) -> list[str]:
    return [line for line, there in lines.items() if there]
