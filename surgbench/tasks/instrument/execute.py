"""One run of an instrument tracker from its job to its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench import metrics
from surgbench.contract import Mask, Observation
from surgbench.geometry import FloatArray
from surgbench.processes.child import Child, ChildProblemError
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JOINTS, POSITION, STATE_NAMES, STATE_SIZE
from surgbench.suite.running import Run
from surgbench.suite.settings import Job, Plug
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.judge import frames_that_count, judged_columns
from surgbench.tasks.instrument.pairs import OwnMasks, exchanged_readings, hidden, pair_errors
from surgbench.tasks.instrument.plan import InstrumentSettings, shows_own
from surgbench.tasks.instrument.records import ANSWER_COLUMNS, ARM_COLUMNS, SHARES, SOURCE_COLUMNS, SOURCE_ERROR
from surgbench.tasks.instrument.references import absent_from_masks, reference_errors
from surgbench.tasks.instrument.told_prompts import told
from surgbench.tasks.instrument.units import UnitData
from surgbench.tasks.instrument.worker import Answer, Setup, waiting
from surgbench.timing import steps_s

WORKER = "surgbench.tasks.instrument.worker"


def own_settings(job: Job) -> InstrumentSettings:
    """The job's settings, which must be of this task."""
    assert isinstance(job.settings, InstrumentSettings)
    return job.settings


def unit_data(job: Job, dataset: InstrumentDataset) -> UnitData:
    """The frames of a job's unit."""
    assert isinstance(job.unit, InstrumentUnit)
    settings = own_settings(job)
    source = settings.mask_source
    true_masks = source is not None and source.needs_truth
    return UnitData(dataset, job.unit, settings.readings, settings.view, settings.masks, true_masks=true_masks)


def child_setup(job: Job, data: UnitData, first: int = 0) -> Setup:
    """What the child of a job is told before frame ``first``, with which tracking begins."""
    settings = own_settings(job)
    source, scene = settings.mask_source, data.scene()
    # The dataset's name and not its hash, so that a part of it is run with the same random numbers.
    axes: dict[str, str | int] = {
        "seed": settings.conditions.seed,
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
        replace(scene, device=settings.conditions.device),
        own(settings.tracker),
        own(settings.initialiser),
        settings.scored,
        source,
        () if source is None else told(settings.prompts, data.sequence, data.unit.arms, first, settings.view),
    )


def true_states(job: Job, data: UnitData, first: int = 0) -> FloatArray | None:
    """What a filter with ``needs_truth`` is given from a frame on, ``(T, 9 * arms)``; ``None`` for any other."""
    if data.truth is None or not own_settings(job).filter.needs_truth:
        return None
    return data.truth.reshape(data.frames, -1)[first:]


def first_truth(job: Job, data: UnitData, first: int = 0) -> FloatArray | None:
    """What an initialiser with ``needs_truth`` is given of frame ``first``, ``(9 * arms,)``; ``None`` for any other."""
    if data.truth is None or not own_settings(job).initialiser.needs_truth:
        return None
    return np.asarray(data.truth[first].reshape(-1))


def execute(job: Job, dataset: InstrumentDataset, run: Run, *, waits: bool = True) -> dict[str, Any]:
    """Run a job in a child process and measure what it estimated; see :meth:`surgbench.task.Task.execute`.

    Args:
        job: What is to be run.
        dataset: What it is run on.
        run: Gives the child process, and is told how far it is.
        waits: Tracking begins in the first frame in whose mask an instrument shows; else in the first of all.
    """
    settings = own_settings(job)
    data = unit_data(job, dataset)
    evaluator = SilhouetteEvaluator(data.instruments, data.camera)
    answers: list[Answer] = []
    mask_errors: list[tuple[float | None, float | None]] = []
    source_errors: list[float | None] = []
    shares: list[float] = []
    initial: FloatArray | None = None
    measures_source = settings.mask_source is not None and data.truth is not None
    own_masks = OwnMasks.of(data)
    status, error, trace, initialise_s = "ok", None, None, None
    try:
        with run.child(WORKER, settings.conditions.timeout_s, settings.conditions.memory) as child:
            first = _first_seen(settings, data, job.frames) if waits else 0
            child.send("setup", child_setup(job, data, first))
            child.ready()
            run.advance(first)
            for frame in range(first, job.frames):
                run.check()
                observation = data.observation(frame)
                if initial is None:
                    initialise_s, initial = _initialise(child, job, data, observation, run)
                    if initial is None:
                        run.advance(1)
                        continue
                    answers, mask_errors = [waiting(initial)] * frame, [(None, None)] * frame
                    source_errors, shares = [None] * frame, [0.0] * frame
                child.send("step", observation)
                clean = None if data.truth is None else data.sequence.clean_mask(data.unit.kind, frame)
                answer: Answer = child.receive()[1]
                answers.append(answer)
                seen = observation.mask if answer.seen is None else answer.seen.mask
                if not data.has_masks:
                    shares.append(float(seen.mean()))
                mask_errors.append(_mask_errors(evaluator, answer.state, seen, clean))
                if measures_source:
                    source_errors.append(metrics.masks_apart(seen, data.true_mask(frame)))
                if own_masks is not None:
                    own_masks.measure(frame, answer.state)
                run.advance(1)
            if initial is None:
                raise ChildProblemError("failed", NOTHING_SEEN.format(job.frames))
    except ChildProblemError as problem:
        status, error, trace = problem.status, f"frame {len(answers)}: {problem}", problem.traceback
    away = out_of_view(data, len(answers), shares)
    states = _states(data, answers)
    hint = (
        (None if own_masks is None else own_masks.hint(data.unit.arms))
        or exchanged_readings(data, states, lost_arms(answers, len(data.unit.arms)))
        or outside_limits(data, states)
    )
    return {
        "status": status,
        "error": error,
        "traceback": trace,
        "initialise_s": initialise_s,
        "frames": _frames(answers),
        "errors": _errors(data, answers, mask_errors, own_masks, away)
        | _judged(settings, data, answers, mask_errors)
        | ({SOURCE_ERROR: source_errors} if measures_source else {}),
        **({} if initial is None or settings.mask_source is None else {"initial_state": initial.tolist()}),
        **({} if hint is None else {"hint": hint}),
    }


# A reading may be a little outside, and so may be who follows it.
BEYOND_RAD = 0.01


def outside_limits(data: UnitData, states: FloatArray) -> str | None:
    """One line where joints of ``(T, arms, 9)`` estimates are outside their limits, and by how much at most."""
    joints = states[..., JOINTS]
    beyond = np.abs(joints - data.scene().joint_limits.clip(joints))
    frames = int((beyond > BEYOND_RAD).any(axis=(1, 2)).sum())
    if not frames:
        return None
    worst = int(beyond.max(axis=(0, 1)).argmax())
    by = f"{STATE_NAMES[JOINTS][worst]} by up to {beyond[..., worst].max():.2f} rad"
    return f"joints outside their limits in {frames} of {len(states)} frames, {by}"


NOTHING_SEEN = "no instrument shows in any of {} masks: nothing to start from"


def _first_seen(settings: InstrumentSettings, data: UnitData, frames: int) -> int:
    """The frame that tracking begins with, or where masks are made of images, the first of which one is made.

    Raises:
        ChildProblemError: There is none.
    """
    made = not shows_own(settings.mask_source) and not settings.initialiser.needs_truth
    first = 0 if made else data.first_seen(frames)
    if first is None:
        raise ChildProblemError("failed", NOTHING_SEEN.format(frames))
    if first and settings.prompts.get(data.sequence.id):
        raise ChildProblemError("failed", f"points are told of frame 0, but no instrument shows before frame {first}")
    return first


def _initialise(
    child: Child, job: Job, data: UnitData, observation: Observation, run: Run
) -> tuple[float, FloatArray | None]:
    """Have the state of the first frame with an instrument found.

    Returns:
        The seconds that it took, and the state; ``None`` where the mask that was made shows no instrument.
    """
    label = f"{own_settings(job).row_id} {job.unit.id}: finding the instrument"
    first = observation.index
    child.send("first", observation, first_truth(job, data, first), true_states(job, data, first))
    while (message := child.receive())[0] == "progress":
        run.stage(label, message[1])
    run.stage(label, 1.0)
    state, elapsed_s = message[1:]
    return float(elapsed_s), None if state is None else np.asarray(state)


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
    names = [*ANSWER_COLUMNS, *(ARM_COLUMNS if answers and answers[0].lost_arms is not None else ())]
    names += SOURCE_COLUMNS if any(answer.seen is not None for answer in answers) else ()
    for name in names:
        values = [getattr(answer, name) for answer in answers]
        columns[name] = [value.tolist() if isinstance(value, np.ndarray) else value for value in values]
    return columns


def _errors(
    data: UnitData,
    answers: list[Answer],
    mask_errors: list[tuple[float | None, float | None]],
    own_masks: OwnMasks | None,
    away: NDArray[np.bool_],
) -> dict[str, list[Any] | None]:
    """Errors of all frames; ``None`` where there is no truth to hold them against."""
    errors: dict[str, list[Any] | None] = dict.fromkeys(
        (*metrics.POSE_ERRORS, "translation_error_scaled_m", "frames_to_recover", *SHARES)
    )
    shape = (len(answers), len(data.unit.arms), STATE_SIZE)
    states = _states(data, answers)
    starts = np.array([answer.start for answer in answers]).reshape(shape)
    lost = lost_arms(answers, shape[1])
    if own_masks is not None:
        errors |= {name: _finite(values) for name, values in own_masks.errors(away).items()}
    if data.truth is not None:
        truth = data.truth[: len(answers)]
        per_arm = [
            metrics.pose_errors(instrument, data.camera, states[:, arm], truth[:, arm])
            for arm, instrument in enumerate(data.instruments)
        ]
        for name in metrics.POSE_ERRORS:
            values = np.stack([arm[name] for arm in per_arm], axis=1)
            errors[name] = _finite(np.where(away, np.nan, values))
        tip_errors = [arm["tip_error_m"] for arm in per_arm]
        gone = away | hidden(data, len(answers))
        recovered = [metrics.frames_to_recover(*arm) for arm in zip(tip_errors, gone.T, strict=True)]
        errors["frames_to_recover"] = _finite(np.array(recovered))
        if shape[1] == 2:
            sure = np.array([answer.confidence_arms for answer in answers], dtype=np.float64).reshape(shape[:2])
            found = pair_errors(data, states, np.stack(tip_errors, axis=1), lost, sure, away)
            errors |= {name: _finite(values) for name, values in found.items()}
        places = np.where(away[..., None], np.nan, states[..., POSITION])
        scaled = [metrics.translation_error_scaled(places[:, arm], truth[:, arm, POSITION]) for arm in range(shape[1])]
        errors["translation_error_scaled_m"] = _finite(np.array(scaled))
        deviations = _deviations(answers, shape)
        covered = [
            metrics.interval_coverages(
                states[:, arm], deviations[:, arm], truth[:, arm], instrument.observed, instrument.symmetry
            )
            for arm, instrument in enumerate(data.instruments)
        ]
        for name in metrics.INTERVAL_COVERAGES:
            values = np.stack([arm[name] for arm in covered], axis=1)
            errors[name] = _finite(np.where(away, np.nan, values))
    else:
        errors |= {name: _finite(values) for name, values in reference_errors(data, states, away).items()}
    for name, share in (("lost_precision", metrics.lost_precision), ("lost_recall", metrics.lost_recall)):
        per_arm_shares = [share(*arm) for arm in zip(lost.T, away.T, strict=True)]
        errors[name] = _finite(per_arm_shares[0] if shape[1] == 1 else np.stack(per_arm_shares, axis=1))
    # There is nothing to be held against a silhouette where no instrument shows.
    nothing = np.asarray(away.all(axis=1))
    seen, clean = zip(*mask_errors, strict=True) if mask_errors else ((), ())
    errors["mask_error"] = [None if gone else value for value, gone in zip(seen, nothing, strict=True)]
    if data.truth is None:
        errors["mask_error_true"] = None
    else:
        errors["mask_error_true"] = [None if gone else value for value, gone in zip(clean, nothing, strict=True)]
    states, starts = (np.where(away[..., None], np.nan, values) for values in (states, starts))
    tips = [instrument.tips_cam(states[:, arm]) for arm, instrument in enumerate(data.instruments)]
    errors["lag_ms"] = _lags(states, data)
    errors["start_lag_ms"] = _lags(starts, data)
    errors["jitter"] = _finite(np.array([metrics.jitter(arm, _steps(data, len(answers))) for arm in tips]))
    return errors


def _states(data: UnitData, answers: list[Answer]) -> FloatArray:
    """``(T, arms, 9)``."""
    return np.array([answer.state for answer in answers]).reshape(len(answers), len(data.unit.arms), STATE_SIZE)


def lost_arms(answers: list[Answer], arms: int) -> NDArray[np.bool_]:
    """Of which frames each arm is said to be lost, ``(T, arms)``."""
    own = [answer.lost if answer.lost_arms is None else answer.lost_arms for answer in answers]
    return np.array(own, dtype=bool).reshape(len(answers), arms)


def _judged(
    settings: InstrumentSettings,
    data: UnitData,
    answers: list[Answer],
    mask_errors: list[tuple[float | None, float | None]],
) -> dict[str, list[float | None]]:
    """What a recording without truth has instead; see :func:`surgbench.tasks.instrument.judge.judged_columns`."""
    states = _states(data, answers)
    counts = frames_that_count((answer.lost for answer in answers), (seen for seen, _ in mask_errors))
    return judged_columns(
        data.sequence, data.unit.arms, data.instruments, states, counts, settings.readings, settings.references
    )


def out_of_view(data: UnitData, frames: int, shares: Sequence[float] = ()) -> NDArray[np.bool_]:
    """In which of a unit's first frames an arm is out of view, ``(frames, arms)``.

    That is by the silhouette of its true state, so that it is the same for an arm alone and in a pair, and whatever
    happens to masks; without truth, by the masks.

    Args:
        data: A unit.
        frames: How many.
        shares: Of the picture that the mask which the tracker saw takes in each frame: what there is to go by where a
            recording has no masks of its own; not looked at elsewhere.
    """
    if data.truth is None and not data.has_masks:
        return np.repeat(np.array(shares)[:, None] < metrics.OUT_OF_VIEW_SHARE, len(data.unit.arms), axis=1)
    if data.truth is None:
        return absent_from_masks(data, frames)
    away = np.zeros((frames, len(data.unit.arms)), dtype=bool)
    if not frames:
        return away
    camera = data.camera
    nothing = Reference(np.zeros((camera.height, camera.width), dtype=bool))
    for arm, instrument in enumerate(data.instruments):
        areas = SilhouetteEvaluator((instrument,), camera).score(data.truth[:frames, arm], nothing).area
        away[:, arm] = areas < metrics.OUT_OF_VIEW_SHARE * camera.width * camera.height
    return away


def _deviations(answers: list[Answer], shape: tuple[int, ...]) -> FloatArray:
    """Standard deviations of all frames, NaN where a tracker gave none."""
    unknown = np.full(int(np.prod(shape[1:])), np.nan)
    given = [answer.standard_deviations for answer in answers]
    return np.array([unknown if one is None else one for one in given]).reshape(shape)


def _lags(states: FloatArray, data: UnitData) -> list[Any] | None:
    """Of each arm, milliseconds that the wrist of ``(T, arms, 9)`` states trails behind."""
    if data.truth is None:
        return None
    places, true_places = states[..., POSITION], data.truth[: len(states), :, POSITION]
    steps = _steps(data, len(states))
    lags = [metrics.lag(places[:, arm], true_places[:, arm], steps) for arm in range(states.shape[1])]
    return _finite(1e3 * np.array(lags))


def _steps(data: UnitData, frames: int) -> FloatArray:
    """Seconds from each of a unit's first frames to the next."""
    return steps_s(data.sequence.timestamps_s[:frames], data.sequence.dt_s)


def _finite(values: FloatArray) -> list[Any]:
    """Nested lists with ``None`` for NaN, which JSON has not."""
    nested = values.astype(object)
    nested[~np.isfinite(values)] = None
    return list(nested.tolist())
