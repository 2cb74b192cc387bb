"""BOP: objects become arms; poses become states where the dataset says what joints they follow from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.camera import Camera
from surgbench.config import Finite
from surgbench.contract import Mask, Plugin
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.bop_arms import ObjectsTold, arms_of_objects, states_of_scene
from surgbench.exchange.footage_options import NamedOptions
from surgbench.instrument import Instrument, load_instrument
from surgbench.pictures import as_rgb
from surgbench.recordings.bop import JOINTS_FILE, Layer, Link, Scene, find_links, find_scenes, read_scene
from surgbench.recordings.files import read_picture
from surgbench.recordings.frame_masks import picture_size
from surgbench.tasks.instrument.footage import Footage, Shot
from surgbench.tasks.instrument.format import ARMS, Arm
from surgbench.tasks.instrument.imported import write_import

LAYERS: dict[str, Layer] = {"visible": "mask_visib", "whole": "mask"}


class BopImporter(Plugin):
    """A dataset of BOP, one of its splits, or a scene: a sequence for each scene."""

    name: ClassVar[str] = "bop"
    summary: ClassVar[str] = "BOP: scene_camera.json, scene_gt.json, mask_visib/ or mask/, rgb/ or gray/ of each scene"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import bop lnd --split test --objects 1=left,2=right --out data/lnd",
    )

    class Config(NamedOptions):
        """Options."""

        fps: Annotated[Finite, Field(gt=0, description="Images per second.")] = 30.0
        split: Annotated[str | None, Field(description="Of the dataset; default: the only one.")] = None
        objects: Annotated[
            str | None, Field(description="IDS of each arm's objects, as 1=left,2=right; several may be parts of one.")
        ] = None
        order: Annotated[
            str | None, Field(description="ARMS of objects by their place in scene_gt.json, as left,right.")
        ] = None
        masks: Annotated[
            Literal["visible", "whole"] | None,
            Field(
                description="What shows of an arm, or the arm as if nothing hid it; default: visible, and whole where "
                "there are true states."
            ),
        ] = None
        without_images: Annotated[bool, Field(description="Leave pictures out.")] = False
        arm: Annotated[
            Literal["left", "right"],
            Field(
                description="Which arm the only object is; default: left.",
                json_schema_extra={"option": "arms", "also": "arm"},
            ),
        ] = "left"

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many images all scenes have."""
        return sum(len(read_scene(folder).images) for folder in find_scenes(source, self.config.split).values())

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of it, line by line."""
        config, lines = self.config, list[str]()
        told = ObjectsTold(parse_objects(config.objects), parse_order(config.order), config.arm)
        scenes = find_scenes(source, config.split)
        links = find_links(next(iter(scenes.values())))
        footages, instruments = [], dict[Arm, Instrument]()
        for name, folder in scenes.items():
            scene = read_scene(folder)
            arms = arms_of_objects(scene, links, told)
            instruments |= self._instruments(scene, arms, links)
            footages.append(self._footage(name, scene, arms, links, instruments, lines))
        said = write_import(
            out,
            footages,
            name=config.name or source.resolve().name,
            instruments=instruments,
            configuration=config.configuration(self.name),
            progress=progress,
        )
        return [*lines, *said]

    def _instruments(
        self, scene: Scene, arms: list[list[Arm | None]], links: Mapping[int, Link]
    ) -> dict[Arm, Instrument]:
        """The instrument that is told, or that each arm's objects are links of."""
        found = self.config.instruments()
        if "instrument" in self.config.model_fields_set:
            return found
        for objects, own in zip(scene.objects, arms, strict=True):
            for one, arm in zip(objects, own, strict=True):
                if arm is not None and one in links and links[one].instrument != found[arm].name:
                    found[arm] = load_instrument(links[one].instrument)
        return found

    def _footage(
        self,
        name: str,
        scene: Scene,
        arms: list[list[Arm | None]],
        links: Mapping[int, Link],
        instruments: Mapping[Arm, Instrument],
        lines: list[str],
    ) -> Footage:
        config = self.config
        shown = tuple(arm for arm in ARMS if any(arm in own for own in arms))
        if not shown:
            raise ConfigError(f"{scene.folder}: no object is of either arm; --objects or --order says which are")
        states = states_of_scene(scene, arms, links, instruments)
        if states is None:
            lines.append(f"{name}: poses are left out: {JOINTS_FILE} and models/objects.json would say what joints are")
        layers = scene.layers()
        wanted = LAYERS[config.masks or ("whole" if states is not None and "mask" in layers else "visible")]
        if wanted not in layers:
            other = f"; --masks {next(key for key, one in LAYERS.items() if one in layers)}" if layers else ""
            raise DatasetError(f"{scene.folder / wanted}: missing{other}")
        pictures = None if config.without_images else scene.pictures()
        if pictures is not None and states is not None and pictures[0].parent.name == "gray":
            lines.append(f"{name}: gray/ is left out: with true states and no rgb/ it holds masks")
            pictures = None
        camera = self._camera(scene, wanted)
        size = (camera.width, camera.height)
        clean: Layer = "mask" if "mask" in layers else wanted

        def masks(layer: Layer, place: int) -> dict[str, Mask]:
            found: dict[str, Mask] = {arm: np.zeros(size[::-1], dtype=bool) for arm in shown}
            for number, arm in enumerate(arms[place]):
                if arm is not None:
                    found[arm] |= scene.mask(layer, scene.images[place], number, size)
            return found

        def shots() -> Iterator[Shot]:
            for place in range(len(scene.images)):
                picture = None if pictures is None else as_rgb(read_picture(pictures[place], *size))
                yield Shot(masks(wanted, place), picture, None if states is None else masks(clean, place))

        return Footage(
            id=name,
            camera=camera,
            times_s=(np.array(scene.images, dtype=np.float64) - scene.images[0]) / config.fps,
            names=[f"{image:06d}" for image in scene.images],
            shots=shots,
            arms=shown,
            kinds=shown,
            images=pictures is not None,
            states=states,
            dt_s=1.0 / config.fps,
        )

    def _camera(self, scene: Scene, layer: Layer) -> Camera:
        """The scene's matrix and the size of its masks; pictures of BOP have no lens."""
        files = sorted((scene.folder / layer).glob("*.png"))
        if not files:
            raise DatasetError(f"{scene.folder / layer}: holds no masks (000000_000000.png, ...)")
        size = picture_size(files[0])
        assert size is not None
        if self.config.camera is not None:
            return self.config.read(scene.folder, size)
        matrix = scene.matrix
        return Camera(width=size[0], height=size[1], fx=matrix[0, 0], fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2])


def parse_objects(text: str | None) -> dict[int, Arm]:
    """Ids of objects to arms, as in ``1=left,2=right``.

    Raises:
        ConfigError: It is something else; one line with an example.
    """
    found: dict[int, Arm] = {}
    for part in () if text is None else text.split(","):
        number, _, arm = (word.strip() for word in part.partition("="))
        if not number.isdecimal() or arm not in ARMS:
            raise ConfigError(f"--objects: must be like 1=left,2=right, not '{text}'")
        found[int(number)] = "left" if arm == "left" else "right"
    return found


def parse_order(text: str | None) -> tuple[Arm, ...]:
    """Arms in order, as in ``left,right``.

    Raises:
        ConfigError: It is something else; one line with an example.
    """
    words = [] if text is None else [word.strip() for word in text.split(",")]
    arms: tuple[Arm, ...] = tuple("left" if word == "left" else "right" for word in words)
    if list(arms) != words:
        raise ConfigError(f"--order: must be like left,right, not '{text}'")
    return arms
