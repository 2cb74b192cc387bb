"""One run of an instrument tracker from its job to its record."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from surgbench import metrics
from surgbench.contract import Mask, Observation, Scene, View, no_image
from surgbench.dataset.masks import read_image
from surgbench.dataset.reader import Dataset, Sequence, Unit
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import POSITION, STATE_SIZE
from surgbench.suite.child import Child, ChildProblemError
from surgbench.suite.head import head
from surgbench.suite.plan import InstrumentSettings, Job, Plug, Readings
from surgbench.suite.worker import Answer, Setup


class UnitData:
    """A unit's frames as observations, and its truth.

    Args:
        dataset: The dataset.
        unit: One of its units.
        readings: Which joint readings observations hold.
        view: Auxiliary view that observations hold besides the endoscope's.
    """

    def __init__(self, dataset: Dataset, unit: Unit, readings: Readings, view: str | None = None) -> None:
        self.unit = unit
        self.sequence: Sequence = dataset.sequence(unit.sequence)
        self.camera = self.sequence.camera
        self.instruments: tuple[Instrument, ...] = tuple(
            dataset.instrument(self.sequence.entry.instruments[arm]) for arm in unit.arms
        )
        self._keypoints = [self.sequence.keypoints(arm) for arm in unit.arms]
        self.truth = self._stack([self.sequence.states(arm) for arm in unit.arms])
        self._joints = self._joint_readings(readings)
        # From the same encoders as the joints' readings, and never better than those.
        self._kinematics = None if readings == "none" else self._stack([self.sequence.kinematics(a) for a in unit.arms])
        self._auxiliary = None if view is None else self.sequence.auxiliary(view)
        self._limits = self.scene().joint_limits

    @staticmethod
    def _stack(per_arm: list[FloatArray | None]) -> FloatArray | None:
        """``(T, arms, ...)`` from one ``(T, ...)`` per arm."""
        present = [values for values in per_arm if values is not None]
        return np.stack(present, axis=1) if len(present) == len(per_arm) else None

    def _joint_readings(self, readings: Readings) -> FloatArray | None:
        if readings == "none":
            return None
        if readings == "true":
            return None if self.truth is None else self.truth[:, :, 6:]
        return self._stack([self.sequence.readings(arm) for arm in self.unit.arms])

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.sequence.frames

    def scene(self) -> Scene:
        """What stays the same over the sequence."""
        bases = [base for arm in self.unit.arms if (base := self.sequence.T_cam_base(arm)) is not None]
        cameras = [(self.camera, np.eye(4))]
        if self._auxiliary is not None:
            cameras.append((self._auxiliary.camera, self._auxiliary.T_view_cam(self.unit.kind)[0]))
        nothing = (None,) * len(self.unit.arms)
        return Scene(
            instruments=self.instruments,
            views=tuple(
                View(camera, T_view_cam, np.zeros((camera.height, camera.width), dtype=bool), keypoints=nothing)
                for camera, T_view_cam in cameras
            ),
            limits=tuple(instrument.search_limits for instrument in self.instruments),
            dt_s=self.sequence.dt_s,
            arms=len(self.unit.arms),
            speed=self.sequence.speed,
            T_cam_base=np.stack(bases) if bases else None,
        )

    def observation(self, frame: int, mask: Mask) -> Observation:
        """What a tracker may know of a frame; ``start`` is the engine's to fill in."""
        keypoints = _seen(self._keypoints, frame)
        path = self.sequence.image_path(frame)
        # Only the file's place: a bound method would carry the sequence, its readings and its truth along.
        image = no_image if path is None else partial(read_image, path, self.camera.width, self.camera.height)
        joints = None
        if self._joints is not None and not np.isnan(self._joints[frame]).any():
            clipped = self._limits.clip(self._joints[frame])
            joints = clipped[0] if len(clipped) == 1 else clipped
        kinematics = None
        if self._kinematics is not None and not np.isnan(self._kinematics[frame]).any():
            kinematics = self._kinematics[frame]
        return Observation(
            index=frame,
            timestamp_s=float(self.sequence.timestamps_s[frame]),
            views=(View(self.camera, np.eye(4), mask, keypoints=keypoints, image=image), *self._further_views(frame)),
            start=np.zeros(STATE_SIZE * len(self.unit.arms)),
            joints=joints,
            kinematics=kinematics,
        )

    def _further_views(self, frame: int) -> tuple[View, ...]:
        view, kind = self._auxiliary, self.unit.kind
        if view is None:
            return ()
        keypoints = _seen([view.keypoints(kind, arm) for arm in self.unit.arms], frame)
        return (View(view.camera, view.T_view_cam(kind)[frame], view.mask(kind, frame), keypoints=keypoints),)


def _seen(keypoints: list[FloatArray], frame: int) -> tuple[FloatArray | None, ...]:
    """Of each arm both tips of a frame, or ``None``."""
    return tuple(None if np.isnan(arm[frame]).any() else arm[frame] for arm in keypoints)


def own_settings(job: Job) -> InstrumentSettings:
    """The job's settings, which must be of this task."""
    assert isinstance(job.settings, InstrumentSettings)
    return job.settings


def unit_data(job: Job, dataset: Dataset) -> UnitData:
    """The frames of a job's unit."""
    assert isinstance(job.unit, Unit)
    return UnitData(dataset, job.unit, own_settings(job).readings, own_settings(job).view)


def child_setup(job: Job, scene: Scene) -> Setup:
    """What the child of a job is told before the first frame."""
    settings = own_settings(job)
    # The dataset's name and not its hash, so that a part of it is run with the same random numbers.
    axes: dict[str, str | int] = {
        "seed": settings.protocol.seed,
        "dataset": job.dataset_name,
        "unit": job.unit.id,
        "repeat": job.repeat,
    }

    def own(plug: Plug) -> dict[str, str | int]:
        return {**axes, plug.kind: plug.name}

    return Setup(
        settings.tracker,
        settings.initialiser,
        settings.filter,
        settings.keypoints,
        replace(scene, device=settings.protocol.device),
        own(settings.tracker),
        own(settings.initialiser),
    )


def true_states(job: Job, data: UnitData) -> FloatArray | None:
    """What a filter with ``needs_truth`` is given, ``(T, 9 * arms)``; ``None`` for any other."""
    if data.truth is None or not own_settings(job).filter.needs_truth:
        return None
    return data.truth.reshape(data.frames, -1)


def execute(
    job: Job,
    dataset: Dataset,
    environment: dict[str, Any],
    advance: Callable[[float], None],
    initialising: Callable[[float], None],
    children: set[Child],
    stopping: threading.Event,
) -> dict[str, Any]:
    """Run a job in a child process and measure what it estimated.

    Args:
        job: What to run.
        dataset: The dataset it is about.
        environment: Where it runs, for the record.
        advance: Called with 1 for each frame done.
        initialising: Called with how far the initialiser is, 0 to 1.
        children: Holds the child while it lives, so that it can be stopped from outside.
        stopping: Set when the run is to end; then nothing new is begun.

    Returns:
        The record, whatever became of the run.

    Raises:
        SurgbenchError: The dataset itself is at fault.
    """
    settings = own_settings(job)
    data = unit_data(job, dataset)
    evaluator = SilhouetteEvaluator(data.instruments, data.camera)
    answers: list[Answer] = []
    mask_errors: list[tuple[float, float | None]] = []
    status, error, trace, initialise_s = "ok", None, None, None
    child = Child(settings.protocol.timeout_s)
    children.add(child)
    try:
        if stopping.is_set():
            raise ChildProblemError("failed", "stopped before it began")
        child.send("setup", child_setup(job, data.scene()))
        child.receive()
        for frame in range(job.frames):
            if stopping.is_set():
                raise ChildProblemError("failed", "stopped")
            mask = data.sequence.mask(data.unit.kind, frame)
            observation = data.observation(frame, mask)
            if frame == 0:
                truth = None
                if data.truth is not None and settings.initialiser.needs_truth:
                    truth = data.truth[0].reshape(-1)
                child.send("first", observation, truth, true_states(job, data))
                while (message := child.receive())[0] == "progress":
                    initialising(message[1])
                initialising(1.0)
                initialise_s = message[2]
            child.send("step", observation)
            clean = None if data.truth is None else data.sequence.clean_mask(data.unit.kind, frame)
            answer: Answer = child.receive()[1]
            answers.append(answer)
            mask_errors.append(_mask_errors(evaluator, answer.state, mask, clean))
            advance(1)
    except ChildProblemError as problem:
        status, error, trace = problem.status, f"frame {len(answers)}: {problem}", problem.traceback
    finally:
        children.discard(child)
        child.stop()
    return {
        **head(job, dataset, environment),
        "status": status,
        "error": error,
        "traceback": trace,
        "initialise_s": initialise_s,
        "frames": _frames(answers),
        "errors": _errors(data, answers, mask_errors),
    }


def _mask_errors(
    evaluator: SilhouetteEvaluator, state: FloatArray, mask: Mask, clean: Mask | None
) -> tuple[float, float | None]:
    def error(mask: Mask) -> float:
        reference = Reference(mask)
        score = evaluator.score(state[None], reference)
        return float(metrics.mask_error(score.area[0], reference.area, score.overlap[0]))

    return error(mask), None if clean is None else error(clean)


def _frames(answers: list[Answer]) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = {"index": list(range(len(answers)))}
    for name in Answer.__dataclass_fields__:
        values = [getattr(answer, name) for answer in answers]
        columns[name] = [value.tolist() if isinstance(value, np.ndarray) else value for value in values]
    return columns


def _errors(
    data: UnitData, answers: list[Answer], mask_errors: list[tuple[float, float | None]]
) -> dict[str, list[Any] | None]:
    """Errors of all frames; ``None`` where there is no truth to hold them against."""
    errors: dict[str, list[Any] | None] = {name: None for name in metrics.POSE_ERRORS}
    shape = (len(answers), len(data.unit.arms), STATE_SIZE)
    states = np.array([answer.state for answer in answers]).reshape(shape)
    starts = np.array([answer.start for answer in answers]).reshape(shape)
    if data.truth is not None:
        per_arm = [
            metrics.pose_errors(instrument, data.camera, states[:, arm], data.truth[: len(answers), arm])
            for arm, instrument in enumerate(data.instruments)
        ]
        for name in metrics.POSE_ERRORS:
            errors[name] = _finite(np.stack([arm[name] for arm in per_arm], axis=1))
    errors["mask_error"] = [observed for observed, _ in mask_errors]
    errors["mask_error_true"] = None if data.truth is None else [clean for _, clean in mask_errors]
    tips = [instrument.tips_cam(states[:, arm]) for arm, instrument in enumerate(data.instruments)]
    errors["lag_ms"] = _lags(states, data)
    errors["start_lag_ms"] = _lags(starts, data)
    errors["jitter"] = _finite(np.array([metrics.jitter(arm, data.sequence.dt_s) for arm in tips]))
    return errors


def _lags(states: FloatArray, data: UnitData) -> list[Any] | None:
    """Of each arm, milliseconds that the wrist of ``(T, arms, 9)`` states trails behind."""
    if data.truth is None:
        return None
    places, true_places = states[..., POSITION], data.truth[: len(states), :, POSITION]
    lags = [metrics.lag(places[:, arm], true_places[:, arm], data.sequence.dt_s) for arm in range(states.shape[1])]
    return _finite(1e3 * np.array(lags))


def _finite(values: FloatArray) -> list[Any]:
    """Nested lists with ``None`` for NaN, which JSON has not."""
    nested = values.astype(object)
    nested[~np.isfinite(values)] = None
    return list(nested.tolist())
