"""A recorded motion of a tool, or of the feature that it holds, becomes trials of the viewpoint task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.config import Positive, Section
from surgbench.contract import Plugin
from surgbench.dataset.manifest import dataset_name
from surgbench.errors import ConfigError, DatasetError, unknown_name
from surgbench.geometry import FloatArray, rotation_angle
from surgbench.leftovers import without_leftovers
from surgbench.recordings.pose_bags import count_messages, is_bag, read_pose_bag
from surgbench.recordings.pose_table import TABLE_SUFFIXES, QuaternionOrder, count_rows, read_pose_table
from surgbench.recordings.poses import FIELDS, LengthUnit, TimeUnit, put_in_order
from surgbench.recordings.resampling import resample, usual_gap_s
from surgbench.tasks.viewpoint.imported import write_trials
from surgbench.tasks.viewpoint.scene_file import (
    CAMERA_BASE,
    WORLD,
    FeatureEntry,
    Normal,
    SceneFile,
    load_scene,
)
from surgbench.tasks.viewpoint.surroundings import Surroundings, first_joints, surround
from surgbench.viewpoint.arm_files import DEFAULT_CAMERA_ARM, load_camera_arm
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import WorkspaceError

# Between two samples a tool that a hand moves is never as fast: the measurement jumped.
JUMP_M_S, JUMP_RAD_S = 0.5, 20.0


class TrajectoryImporter(Plugin):
    """Poses over time, of a table or a bag, in a scene that is told or put around them."""

    name: ClassVar[str] = "trajectory"
    summary: ClassVar[str] = "a tool's recorded motion: CSV (time, position, quaternion), TUM, bags of ROS 1 and 2"
    task: ClassVar[str] = "viewpoint"
    several: ClassVar[bool] = True
    examples: ClassVar[tuple[str, ...]] = (
        "surgbench import trajectory path.csv --out data/mine",
        "surgbench import trajectory one.bag two.bag --topic /PSM1/measured_cp --scene scene.yaml --out data/mine",
    )

    class Config(Section):
        """Options."""

        scene: Annotated[
            Path | None,
            Field(description="FILE: zone, base, touches, camera arm, as YAML; default: put around the motion."),
        ] = None
        frame: Annotated[
            str | None,
            Field(description="NAME: frame that poses are in: world (default), camera-base, or one of the scene."),
        ] = None
        of: Annotated[
            Literal["tool", "feature"],
            Field(description="Whether poses are the tool's, 33 mm behind the feature that it holds, or its own."),
        ] = "tool"
        normal: Annotated[
            Normal | None, Field(description="Axis of the tool that is the feature's normal; default: y.")
        ] = None
        topic: Annotated[
            str | None, Field(description="NAME: a bag's topic; default: the only one that ends in measured_cp.")
        ] = None
        columns: Annotated[
            str | None, Field(description="NAMES: columns, as time=stamp,qw=w; default: found by what they are called.")
        ] = None
        quaternion: Annotated[
            QuaternionOrder, Field(description="Order of the quaternion in tables without names.")
        ] = "xyzw"
        unit: Annotated[LengthUnit | None, Field(description="Of positions; default: as named (x_mm), else m.")] = None
        time_unit: Annotated[
            TimeUnit | None, Field(description="Of the time; default: as named (t_ms), by its size, else s.")
        ] = None
        dt: Annotated[Positive, Field(description="Seconds between samples.")] = 0.0126
        gap: Annotated[
            float | None,
            Field(
                gt=0,
                allow_inf_nan=False,
                description="Longest time without a pose that is bridged, seconds; default: 5 steps, at least 0.1.",
            ),
        ] = None
        camera_arm: Annotated[
            str | None, Field(description="NAME: the arm that holds the camera, or FILE.yaml; default: psm_classic.")
        ] = None
        name: Annotated[str | None, Field(description="Of the dataset; default: as the first file.")] = None

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path | Sequence[Path]) -> int:
        """How many poses there are, about."""
        self._columns()
        return sum(
            count_messages(path, self.config.topic) if is_bag(path) else count_rows(path)
            for path in find_trajectories(source)
        )

    def run(self, source: Path | Sequence[Path], out: Path, progress: Callable[[float], None]) -> list[str]:
        """Make the dataset; returns what was made of the recordings, line by line."""
        config = self.config
        paths = find_trajectories(source)
        scene = SceneFile() if config.scene is None else load_scene(config.scene)
        spec = load_camera_arm(config.camera_arm or scene.camera_arm or DEFAULT_CAMERA_ARM)
        arm, lines = spec.arm(), list[str]()
        tool = scene.feature if config.normal is None else scene.feature.model_copy(update={"normal": config.normal})
        if config.of == "feature":
            tool = FeatureEntry(offset_m=(0.0, 0.0, 0.0), normal=tool.normal)
        motions: dict[str, FloatArray] = {}
        for path in paths:
            trial_id = dataset_name(path.name if path.is_dir() else path.stem)
            if trial_id in motions:
                raise DatasetError(f"{path}: there are two recordings called '{trial_id}'; rename one of them")
            motions[trial_id] = self._motion(path, scene, tool, progress, lines)
        try:
            around = surround(scene, arm, np.concatenate([measured(poses) for poses in motions.values()]))
        except (WorkspaceError, ConfigError) as error:
            raise type(error)(f"{config.scene}: {error}") from None
        lines += around.lines
        trials = [_trial(trial_id, poses, config.dt, scene, arm, around, lines) for trial_id, poses in motions.items()]
        told = config.model_dump(mode="json", exclude={"scene", "name", "camera_arm"})
        configuration = {
            "importer": self.name,
            "sources": [path.name for path in paths],
            "options": told,
            "scene": scene.model_dump(mode="json", exclude={"camera_arm"}),
        }
        write_trials(out, trials, name=config.name or next(iter(motions)), configuration=configuration, camera_arm=spec)
        return lines

    def _motion(
        self, path: Path, scene: SceneFile, tool: FeatureEntry, progress: Callable[[float], None], lines: list[str]
    ) -> FloatArray:
        """``(T, 4, 4)`` T_world_feature of a recording at even times; NaN where it was not measured."""
        config, frame = self.config, ""
        if is_bag(path):
            raw, frame = read_pose_bag(path, topic=config.topic, progress=progress)
        else:
            raw = read_pose_table(path, columns=self._columns(), order=config.quaternion, progress=progress)
        poses = put_in_order(raw, config.unit, config.time_unit)
        even, gaps = resample(poses, config.dt, usual_gap_s(poses) if config.gap is None else config.gap)
        lines += _about(path, [*poses.lines, *gaps])
        wanted = config.frame or scene.frame
        if wanted is None and frame:
            lines += _about(path, [f"poses are in frame '{frame}', taken as the world's (--frame says otherwise)"])
        features = np.asarray(frame_pose(wanted or WORLD, scene) @ even @ tool.matrix())
        jumps = count_jumps(features, config.dt)
        if jumps:
            lines += _about(path, [
                f"warning: {jumps} of {len(features)} samples are faster than {JUMP_M_S:g} m/s or {JUMP_RAD_S:g} "
                "rad/s; the measurement jumps there"
            ])  # fmt: skip
        return features

    def _columns(self) -> dict[str, str]:
        told: dict[str, str] = {}
        for part in self.config.columns.split(",") if self.config.columns else ():
            name, equals, column = (word.strip() for word in part.partition("="))
            if not equals or not column:
                raise ConfigError(f"--columns: must be like time=stamp,qw=w, not '{part}'")
            if name not in FIELDS:
                raise ConfigError(f"--columns: {unknown_name('field', name, FIELDS)}")
            told[name] = column
        return told


def find_trajectories(source: Path | Sequence[Path]) -> list[Path]:
    """The recordings that are meant: files, bags, and all of those in folders.

    Raises:
        DatasetError: One is not there, or a folder has none; one line.
    """
    found: list[Path] = []
    for path in [source] if isinstance(source, Path) else source:
        if not path.exists():
            raise DatasetError(f"{path}: no such file or folder; expected {', '.join(TABLE_SUFFIXES)} or a bag")
        if not path.is_dir() or is_bag(path):
            found.append(path)
            continue
        inside = [
            one
            for one in sorted(without_leftovers(path.iterdir()))
            if is_bag(one) or (one.is_file() and one.suffix.lower() in TABLE_SUFFIXES)
        ]
        if not inside:
            raise DatasetError(f"{path}: holds no recording; expected {', '.join(TABLE_SUFFIXES)} or a bag")
        found += inside
    return found


def frame_pose(name: str, scene: SceneFile) -> FloatArray:
    """``(4, 4)`` where in the world the frame is that poses are in.

    Raises:
        ConfigError: The scene does not say.
    """
    if name == WORLD:
        return np.eye(4)
    if name == CAMERA_BASE:
        if scene.base is None:
            raise ConfigError(f"--frame {name}: needs 'base' in the file of --scene: where it is in the world")
        return scene.base.matrix()
    if name not in scene.frames:
        known = [WORLD, CAMERA_BASE, *scene.frames]
        raise ConfigError(f"--frame: {unknown_name('frame', name, known)}; 'frames' of --scene says where others are")
    return scene.frames[name].matrix()


def measured(poses: FloatArray) -> FloatArray:
    """Those of ``(T, 4, 4)`` poses that are not NaN."""
    return poses[np.isfinite(poses).all(axis=(1, 2))]


def count_jumps(poses: FloatArray, dt_s: float) -> int:
    """How many steps of ``(T, 4, 4)`` poses are faster than any hand; those beside gaps do not count."""
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / dt_s
    turn = rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]) / dt_s
    return int(((speed > JUMP_M_S) | (turn > JUMP_RAD_S)).sum())


def _trial(
    trial_id: str,
    poses: FloatArray,
    dt_s: float,
    scene: SceneFile,
    arm: CameraArm,
    around: Surroundings,
    lines: list[str],
) -> Trial:
    start, warning = first_joints(scene, arm, around, measured(poses)[0])
    if warning is not None:
        lines.append(f"{trial_id}: {warning}")
    times_s: FloatArray = dt_s * np.arange(len(poses), dtype=np.float64)
    trial = Trial(
        trial_id, dt_s, times_s, poses, around.T_world_base, around.touches,
        around.workspace.zone.points, start, None, scene.distance_m, scene.floor_m, scene.proximity_m,
        around.workspace.preferred_side,
    )  # fmt: skip
    return replace(trial, arm=arm)


def _about(path: Path, lines: Sequence[str]) -> list[str]:
    """Lines that say what they are about; of a warning that it is one comes first."""
    mark = "warning: "
    return [
        f"{mark}{path.name}: {line.removeprefix(mark)}" if line.startswith(mark) else f"{path.name}: {line}"
        for line in lines
    ]
