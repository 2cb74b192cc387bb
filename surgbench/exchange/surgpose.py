"""SurgPose: both arms, their marked points, joints and jaws, and either camera's pictures."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.config import Finite
from surgbench.contract import Plugin
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.footage_options import FrameOptions
from surgbench.exchange.lags import move_readings, read_lags
from surgbench.exchange.surgpose_masks import ArmMasks
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.instrument.arms import load_arm
from surgbench.pictures import as_rgb
from surgbench.recordings import surgpose as files
from surgbench.recordings.beside import RobotArmOption
from surgbench.recordings.frame_masks import picked
from surgbench.recordings.video import MaskVideo
from surgbench.tasks.instrument.footage import Footage, SecondView
from surgbench.tasks.instrument.format import ARMS, ROBOT_ARM, Arm
from surgbench.tasks.instrument.imported import write_import

# As others of the package that take lags out of readings call it.
LAGS_KEY = "lag_frames_taken_out"
WRIST_PITCH, WRIST_YAW = 4, 5


class SurgPoseImporter(Plugin):
    """SurgPose as it lies on a disk: one sequence for each trajectory."""

    name: ClassVar[str] = "surgpose"
    summary: ClassVar[str] = "SurgPose: 000000/, ... with videos, marked points, joints, jaws and calibration"
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import surgpose SurgPose --trajectories 0-7,30-33 --half --masks sam2 --out data/surgpose",
        "surgbench import surgpose SurgPose --masks sam2/left --other-masks sam2/right --out data/surgpose-stereo",
    )

    class Config(FrameOptions, RobotArmOption):
        """Options."""

        trajectories: Annotated[
            str | None, Field(description="NUMBERS of trajectories, as 0-7,30-33; default: all that are there.")
        ] = None
        eye: Annotated[Literal["left", "right"], Field(description="Whose pictures and points.")] = "left"
        other_masks: Annotated[
            Path | None,
            Field(
                description="Masks of the other eye, laid out as --masks: it becomes an auxiliary view (run --view "
                "right-eye, or left-eye)."
            ),
        ] = None
        half: Annotated[
            bool,
            Field(description="Pictures, points and camera of half the size (700x493), as Hu et al. have them."),
        ] = False
        lag: Annotated[
            str | None,
            Field(
                description="FRAMES that readings are late, or a CSV file of them (trajectory,arm,frames); they are "
                "moved by it."
            ),
        ] = None
        fps: Annotated[Finite, Field(gt=0, description="Frames per second that the points were marked at.")] = files.FPS

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self._videos: dict[Path, MaskVideo] = {}

    def frames(self, source: Path) -> int:
        """How many frames all videos have together."""
        return sum(len(self._video(folder).numbers) for folder in self._trajectories(source).values())

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of it, line by line."""
        config, lines = self.config, list[str]()
        if config.other_masks is not None and config.masks is None:
            raise ConfigError("--other-masks: an auxiliary view goes with masks of its own eye; name them with --masks")
        instruments = config.instruments()
        trajectories = self._trajectories(source)
        lags = read_lags(config.lag, list(trajectories))
        footages, stereos = [], dict[str, Any]()
        for name, folder in trajectories.items():
            footages.append(self._footage(name, folder, lags, lines))
            stereos[name] = files.read_stereo(folder / files.CALIBRATION_FILE).T_right_left.ravel().tolist()
        if "instrument" not in config.model_fields_set:
            lines += [
                f"warning: {name}: which instruments it shows is not published; taken for {config.instrument} "
                "(--instrument says otherwise)"
                for name in trajectories
                if name.isdecimal() and int(name) not in files.NEEDLE_DRIVERS
            ]
        robot_arm = load_arm(config.robot_arm).model_dump(mode="json")
        configuration = {**config.configuration(self.name), "T_right_left": stereos, ROBOT_ARM: robot_arm}
        if lags:
            configuration[LAGS_KEY] = {name: lags[name] for name in trajectories if name in lags}
        said = write_import(
            out,
            footages,
            name=config.name or "surgpose",
            instruments=instruments,
            configuration=configuration,
            progress=progress,
        )
        return [*lines, *said]

    def _trajectories(self, source: Path) -> dict[str, Path]:
        found = files.find_trajectories(source)
        if self.config.trajectories is None:
            return found
        numbered = {int(name): name for name in found if name.isdecimal()}
        wanted = set[int]()
        for numbers in parse_numbers(self.config.trajectories, "--trajectories"):
            # The first that is missing ends it, however many were asked for.
            missing = next((number for number in numbers if number not in numbered), None)
            if missing is not None:
                raise ConfigError(f"--trajectories: {source} has no trajectory {missing:06d}")
            wanted |= set(numbers)
        return {numbered[number]: found[numbered[number]] for number in sorted(wanted)}

    def _video(self, folder: Path) -> MaskVideo:
        place = folder / files.VIDEO_FILE.format(eye=self.config.eye)
        if place not in self._videos:
            self._videos[place] = MaskVideo(place)
        return self._videos[place]

    def _footage(self, name: str, folder: Path, lags: dict[str, dict[str, float]], lines: list[str]) -> Footage:
        config, video = self.config, self._video(folder)
        self._check_rate(video)
        count, size = len(video.numbers), video.size
        stereo = files.read_stereo(folder / files.CALIBRATION_FILE)
        camera = stereo.cameras[config.eye]
        if config.camera is not None:
            camera = config.read(folder, size, lines.append)
        if size != (camera.width, camera.height):
            raise DatasetError(
                f"{folder / files.CALIBRATION_FILE}: is of {camera.width}x{camera.height} pixels, the video of "
                f"{size[0]}x{size[1]}; --camera FILE names another calibration"
            )
        labels = files.read_keypoints(folder / files.KEYPOINTS_FILE.format(eye=config.eye), count, lines.append)
        arm_joints = files.read_joints(folder / files.JOINTS_FILE, count, lines.append)
        jaws = files.read_jaws(folder, count, lines.append)
        times_s = np.arange(count) / config.fps
        if name in lags:
            for arm, lag in lags[name].items():
                if abs(lag) >= count:
                    raise ConfigError(
                        f"--lag: {lag:g} frames of the {arm} arm in {name}, which has {count}: no reading is left"
                    )
            arm_joints = {arm: move_readings(own, lags[name].get(arm, 0.0)) for arm, own in arm_joints.items()}
            if jaws is not None:
                jaws = {arm: move_readings(own[:, None], lags[name].get(arm, 0.0))[:, 0] for arm, own in jaws.items()}
        masks = ArmMasks(config, folder if config.masks is None else config.masks / name, name, size, video.numbers)
        if config.masks is not None:
            masks.must_be_there()
        other = self._other_masks(name, masks, stereo, video.numbers)
        lines += [*masks.lines, *([] if other is None else other.lines)]
        keep = masks.frames
        if len(keep) < count:
            lines.append(f"{name}: {count - len(keep)} frames lack a mask, and are left out")

        def images(wanted: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
            return (as_rgb(picture) for picture in picked(video.pictures(), wanted))

        return Footage(
            id=name,
            camera=camera,
            times_s=times_s[keep],
            names=[f"frame{frame}" for frame in keep],
            shots=lambda: masks.shots(images),
            arms=ARMS,
            kinds=masks.kinds,
            images=True,
            tips=_tips(labels, keep),
            joints=None if jaws is None else {arm: _readings(arm_joints[arm], jaws[arm])[keep] for arm in ARMS},
            arm_joints={arm: arm_joints[arm][keep] for arm in ARMS},
            labels={label: {arm: by_arm[arm][keep] for arm in ARMS} for label, by_arm in labels.items()},
            views={} if other is None else self._second_view(folder, stereo, other, count),
            speed="fast" if name.isdecimal() and int(name) in files.FAST else "nominal",
            halved=config.half,
            dt_s=1.0 / config.fps,
        )

    @property
    def _other_eye(self) -> Literal["left", "right"]:
        return "right" if self.config.eye == "left" else "left"

    def _other_masks(self, name: str, masks: ArmMasks, stereo: files.Stereo, numbers: Sequence[int]) -> ArmMasks | None:
        """Masks of the other eye, where they were told; both eyes then keep the frames that both have."""
        if self.config.other_masks is None:
            return None
        camera = stereo.cameras[self._other_eye]
        other = ArmMasks(
            self.config,
            self.config.other_masks / name,
            f"{self._other_eye} eye, {name}",
            (camera.width, camera.height),
            numbers,
        )
        other.must_be_there()
        masks.keep_as(other)
        return other

    def _second_view(self, folder: Path, stereo: files.Stereo, masks: ArmMasks, count: int) -> dict[str, SecondView]:
        labels = files.read_keypoints(folder / files.KEYPOINTS_FILE.format(eye=self._other_eye), count)
        to_other = stereo.T_right_left if self._other_eye == "right" else inverse_transform(stereo.T_right_left)
        view = SecondView(stereo.cameras[self._other_eye], to_other, masks.masks, _tips(labels, masks.frames))
        return {f"{self._other_eye}-eye": view}

    def _check_rate(self, video: MaskVideo) -> None:
        """Points are of so many frames a second: those of a video with another rate are others."""
        if video.times_s is None or len(video.times_s) < 2:
            return
        rate = 1.0 / float(np.median(np.diff(video.times_s)))
        if abs(rate - self.config.fps) > 0.01 * self.config.fps:
            raise DatasetError(
                f"{video.place}: has {rate:.4g} frames per second, the points were marked at {self.config.fps:g}; if "
                f"they are of its frames, --fps {rate:.4g}"
            )


def parse_numbers(text: str, option: str) -> list[range]:
    """Numbers and ranges of them, as ``0-7,30-33``.

    Raises:
        ConfigError: It is something else; one line with an example.
    """
    numbers: list[range] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        given = (first, last) if dash else (first, first)
        # Longer ones are no number of a folder, and some of them none that can be read.
        if not all(re.fullmatch(r"[0-9]{1,18}", one) for one in given) or int(given[1]) < int(given[0]):
            raise ConfigError(f"{option}: must be like 0-7,30-33, not '{text}'")
        numbers.append(range(int(given[0]), int(given[1]) + 1))
    return numbers


def _tips(labels: Mapping[str, Mapping[str, FloatArray]], keep: Sequence[int]) -> dict[Arm, FloatArray]:
    """Of each arm ``(kept frames, 2, 2)``."""
    return {arm: np.stack([labels[tip][arm][list(keep)] for tip in files.TIPS], axis=1) for arm in ARMS}


def _readings(arm_joints: FloatArray, jaw_rad: FloatArray) -> FloatArray:
    """``(frames, 3)``: the wrist's joints, and half of the jaw."""
    return np.column_stack([arm_joints[:, WRIST_PITCH], arm_joints[:, WRIST_YAW], jaw_rad / 2.0])
