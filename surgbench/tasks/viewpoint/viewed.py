"""Trials and runs of the viewpoint task put on a stage: scene, ring, camera arm, what its eye sees, errors, rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import NotFoundError, unknown_name
from surgbench.geometry import FloatArray
from surgbench.report.drawing import Colour
from surgbench.report.recorded import choose_runs, titles
from surgbench.report.stage import CORNER_PX, Stage, Subject, others
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.draw import EDGES
from surgbench.tasks.viewpoint.film.film import COLOURS
from surgbench.tasks.viewpoint.film.raster import Mesh
from surgbench.tasks.viewpoint.film.shot import ERRORS, Shot
from surgbench.tasks.viewpoint.film.space import FLOOR, GRID_HALF, GRID_M, NEAR, RING_TRAIL, ZONE
from surgbench.tasks.viewpoint.film.things import BEYOND_M, SHAFT_RADIUS_M, held_ring, wire_mesh
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint import kinematics
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.registration import Method
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

# How far before the eye its picture hangs, as a share of the wanted distance: well before the ring.
PLANE_SHARE = 0.45
LINE_M, AXIS_M, DOT_PX = 0.0004, 0.01, 4.0
MEASURED: Colour = (150, 90, 20)
START: Colour = (120, 120, 120)
FEATURE, MEASURE, SCENE, ROWS, ERROR, RULES = "ring", "measured", "scene", "rows", "errors", "rules"
# Columns of records that say how far a rule is broken, and of what is seen.
DEPTHS = ("no_go_mm", "floor_mm", "orientation_deg", "proximity_mm", "joint_limit_deg")
SEEN, EYES = "ring_seen", ("left", "right")


@dataclass(frozen=True, eq=False)
class Viewed:
    """One trial, and what ran on it; none where the dataset is looked at."""

    name: str
    trial: Trial
    records: tuple[ViewpointRecord, ...] = ()


def view(subject: Subject, stage: Stage, progress: Callable[[str, float], Any]) -> list[str]:
    """Put what is asked for on a stage; see :meth:`surgbench.task.Task.view`."""
    chosen, names = _choose(subject)
    with progress("trials and runs", sum(1 + len(viewed.records) for viewed in chosen)) as advance:
        for viewed in chosen:
            _put(viewed, stage, advance)
    return others(names, [viewed.name for viewed in chosen], subject)


def _choose(subject: Subject) -> tuple[list[Viewed], list[str]]:
    """The trials that are asked for, the first one where none is; and the ids of all that there are."""
    if subject.dataset is None:
        records: Sequence[Any] = [record for record in subject.records if getattr(record.frames, "joints", None)]
        jobs = choose_runs(ViewpointDataset, records, subject.units, subject.rows, subject.moved)
        shown = jobs if subject.units else jobs[:1]
        found = [Viewed(job.name, job.dataset.trial(job.records[0].spec.sequence), job.records) for job in shown]
        return found, [job.name for job in jobs]
    dataset = subject.dataset
    assert isinstance(dataset, ViewpointDataset)
    names = [trial.id for trial in dataset.trials]
    for name in subject.units:
        if name not in names:
            raise NotFoundError(unknown_name("unit", name, names))
    return [Viewed(name, dataset.trial(name)) for name in subject.units or names[:1]], names


def _put(viewed: Viewed, stage: Stage, advance: Callable[[float], None]) -> None:
    trial = viewed.trial
    root: list[object] = [viewed.name]
    frames, seconds = np.arange(len(trial.timestamps_s)), trial.timestamps_s
    stage.put(root, stage.rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    stage.space(root, f"{viewed.name}: in space")
    _put_scene(stage, [*root, SCENE], trial)
    known = trial.T_world_feature if trial.truth is None else trial.truth.T_world_feature
    _put_ring(stage, [*root, FEATURE], frames, seconds, known, trial.proximity_m)
    if trial.truth is not None:
        _put_measured(stage, [*root, MEASURE], frames, seconds, trial.T_world_feature)
    advance(1)
    if not viewed.records:
        base = trial.T_world_base if trial.truth is None else trial.truth.T_world_base
        _put_arm(stage, [*root, "start"], trial.arm, base, trial.start[None], frames[:1], seconds[:1], START)
        _put_eye(stage, [*root, "start", "camera"], trial, base @ trial.arm.forward(trial.start[None]), frames, seconds)
    for number, (record, title) in enumerate(zip(viewed.records, titles(viewed.records), strict=True)):
        _put_row(stage, root, viewed, record, title, COLOURS[number % len(COLOURS)])
        advance(1)
    if viewed.records:
        for name, words, unit in ERRORS:
            stage.curves([*root, ERROR, name], f"{words} [{unit}]")
        for name in DEPTHS:
            stage.curves([*root, RULES, name], f"beyond: {name}")
        stage.curves([*root, SEEN], "share of the ring that is seen")


def _put_scene(stage: Stage, place: list[object], trial: Trial) -> None:
    """What stands still: zone, floor, wire."""
    zone = NoGoZone(trial.zone_m)
    stage.lines([*place, "zone"], [zone.corners[list(edge)] for edge in EDGES], 2 * LINE_M, ZONE)
    workspace = Workspace(zone, trial.floor_m, trial.proximity_m, trial.preferred_side)
    along = zone.points[1] - zone.points[0]
    along /= np.linalg.norm(along)
    side = np.cross(zone.up, along)
    middle = zone.points[:4].mean(axis=0) + workspace.floor_m * zone.up
    grid = []
    for step in range(-GRID_HALF, GRID_HALF + 1):
        for one, other in ((along, side), (side, along)):
            start = middle + step * GRID_M * one
            grid.append(np.stack([start - GRID_HALF * GRID_M * other, start + GRID_HALF * GRID_M * other]))
    stage.lines([*place, "floor"], grid, LINE_M, FLOOR)
    if trial.truth is not None and trial.truth.wire is not None:
        _put_mesh(stage, [*place, "wire"], wire_mesh(trial.truth.wire))


def _put_mesh(stage: Stage, place: list[object], mesh: Mesh) -> None:
    stage.body(place, mesh.points_m, mesh.faces, mesh.colours)


def _put_ring(
    stage: Stage,
    place: list[object],
    frames: NDArray[np.int64],
    seconds: FloatArray,
    poses: FloatArray,
    proximity_m: float,
) -> None:
    """The ring with what holds it, its way, and the ball that the camera has to stay out of."""
    stage.poses(place, frames, seconds, poses)
    _put_mesh(stage, [*place, "body"], held_ring())
    if proximity_m > 0:
        stage.ball([*place, "nearest allowed"], proximity_m, LINE_M / 2, NEAR)
    way = poses[:, :3, 3]
    stage.lines([*place[:-1], f"{place[-1]}, its way"], [way[np.isfinite(way).all(axis=1)]], LINE_M, RING_TRAIL)


def _put_measured(
    stage: Stage, place: list[object], frames: NDArray[np.int64], seconds: FloatArray, poses: FloatArray
) -> None:
    """Where the ring was measured, with its normal."""
    stage.poses(place, frames, seconds, poses)
    normal = np.array([[0.0, 0.0, 0.0], [0.0, AXIS_M, 0.0]])
    stage.lines([*place, "normal"], [normal], 1.5 * LINE_M, MEASURED)


def _put_row(
    stage: Stage, root: list[object], viewed: Viewed, record: ViewpointRecord, title: str, colour: Colour
) -> None:
    """A controller's arm and eye, where a hand led the ring that too, and the errors and rules."""
    trial, kept = viewed.trial, record.frames
    method = cast(Method, record.spec.registration)
    scene = make_scene(trial, registration=method, missing_face=record.spec.missing_face)
    shot = Shot.of(record, trial, scene, title, colour)
    # What a step led to is there when it ends; of a run longer than its trial, as with a hand, steps go on.
    after = np.arange(1, shot.steps + 1)
    seconds = np.where(
        after < len(trial.timestamps_s),
        trial.timestamps_s[np.minimum(after, len(trial.timestamps_s) - 1)],
        trial.timestamps_s[0] + after * trial.dt_s,
    )
    place = [*root, ROWS, title]
    _put_arm(stage, [*place, "arm"], scene.arm, shot.T_world_base, shot.joints, after, seconds, colour)
    _put_eye(stage, [*place, "camera"], trial, shot.T_world_camera, after, seconds)
    picture = [*place, "camera", "left eye"]
    led = [*place, FEATURE] if kept.ring else [*root, FEATURE]
    seen = [[*root, SCENE], [*led, "body"]]
    stage.picture(picture, f"{viewed.name}: {title}, left eye", seen)
    if len(kept.projected_px) == shot.steps:
        pixels = np.array([row[:2] for row in kept.projected_px], dtype=np.float64)
        inside = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        dots = stage.rr.Points2D.columns(
            positions=pixels[inside] + CORNER_PX,
            colors=stage.painted(colour, len(inside)),
            radii=[DOT_PX] * len(inside),
        )
        stage.series([*picture, "ring"], after[inside], seconds[inside], dots)
    if kept.ring:
        stage.poses([*place, FEATURE], after, seconds, shot.T_world_feature)
        _put_mesh(stage, [*place, FEATURE, "body"], held_ring())
    for name, _, _ in ERRORS:
        _put_curve(stage, [*root, ERROR, name, title], after, seconds, shot.errors[name], title, colour)
    for name in DEPTHS:
        values = np.array(getattr(kept, name), dtype=np.float64)
        _put_curve(stage, [*root, RULES, name, title], after, seconds, values, title, colour)
    shares = np.array(kept.ring_seen, dtype=np.float64).reshape(-1, 2)
    for eye, share in zip(EYES, shares.T, strict=True):
        _put_curve(stage, [*root, SEEN, eye, title], after, seconds, share, f"{title}, {eye}", colour)


def _put_curve(
    stage: Stage,
    place: list[object],
    frames: NDArray[np.int64],
    seconds: FloatArray,
    values: FloatArray,
    title: str,
    colour: Colour,
) -> None:
    if len(values) == len(frames):
        stage.numbers(place, frames, seconds, values, title, colour)


def _put_arm(
    stage: Stage,
    place: list[object],
    arm: CameraArm,
    T_world_base: FloatArray,
    joints: FloatArray,
    frames: NDArray[np.int64],
    seconds: FloatArray,
    colour: Colour,
) -> None:
    """Shaft, wrist and head as a line with corners, of the instrument's thickness: the shaft goes in and out."""
    corners = np.empty((len(joints), 4, 3))
    cameras, unit = arm.forward(joints)[:, :3, 3], np.empty((5, 3))
    for row, own, camera in zip(corners, np.ascontiguousarray(joints, dtype=np.float64), cameras, strict=True):
        kinematics.axes(own, unit)
        wrist = float(own[2] + arm.packed[0] + arm.packed[1]) * unit[1]
        row[:] = [-BEYOND_M * unit[1], wrist, wrist + arm.packed[2] * unit[3], camera]
    corners = corners @ T_world_base[:3, :3].T + T_world_base[:3, 3]
    count = len(corners)
    columns = stage.rr.LineStrips3D.columns(
        strips=corners, radii=[SHAFT_RADIUS_M] * count, colors=stage.painted(colour, count)
    )
    stage.series(place, frames, seconds, columns)


def _put_eye(
    stage: Stage,
    place: list[object],
    trial: Trial,
    T_world_camera: FloatArray,
    frames: NDArray[np.int64],
    seconds: FloatArray,
) -> None:
    """The camera over time, and its left eye with the plane of its picture."""
    count = len(T_world_camera)
    stage.poses(place, frames[:count], seconds[:count], T_world_camera)
    stage.pose([*place, "left eye"], AUTOCAM_STEREO.T_camera_left)
    stage.camera([*place, "left eye"], AUTOCAM_STEREO.left, PLANE_SHARE * trial.distance_m)
