"""What trackers tell of themselves, how sure they are and whether they are lost, held against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commandline import RUN, STRANGERS, records, surgbench
from fabricate import record, write

import surgbench as public
from surgbench.errors import InvalidAnswerError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.presets import load_preset
from surgbench.metrics import (
    INTERVAL_COVERAGES,
    RECOVERED_M,
    frames_to_recover,
    interval_coverages,
    jitter,
    lag,
    lost_precision,
    lost_recall,
)
from surgbench.randomness import generator
from surgbench.records.reader import read_records
from surgbench.report.rows import read_rows
from surgbench.state import twin
from surgbench.tasks.instrument.columns import OUT_OF_VIEW, SURE
from surgbench.tasks.instrument.page import _told_table
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.worker import check_standard_deviations

# Radians, metres, radians: of every component another one.
DEVIATIONS = np.array([0.01, 0.05, 0.02, 0.001, 0.002, 0.003, 0.1, 0.2, 0.05])
TRUTH = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3])


# How sure


def test_errors_as_large_as_stated_are_held_by_nine_intervals_of_ten() -> None:
    errors = DEVIATIONS * generator(test="told").standard_normal((20_000, 9))
    for scale, expected in ((1.0, 0.9), (0.5, 0.589), (2.0, 0.999)):  # Gaussian within 1.6449, 0.8224 and 3.2897 sigma
        shares = interval_coverages(TRUTH + errors, scale * DEVIATIONS, TRUTH)
        for name in INTERVAL_COVERAGES:
            assert shares[name].mean() == pytest.approx(expected, abs=0.01), name


def test_a_group_is_its_components() -> None:
    off = np.where([1, 0, 0, 1, 1, 0, 0, 1, 0], 2.0 * DEVIATIONS, DEVIATIONS)
    shares = {name: float(share) for name, share in interval_coverages(TRUTH + off, DEVIATIONS, TRUTH).items()}
    assert list(shares.values()) == pytest.approx([5 / 9, 2 / 3, 1 / 3, 1.0, 0.0, 1.0])


def test_the_twin_and_full_turns_are_no_error() -> None:
    turned = TRUTH + np.array([2 * np.pi, 0, -2 * np.pi, 0, 0, 0, 0, 0, 0])
    for estimate in (twin(TRUTH), twin(twin(TRUTH)), turned):
        assert interval_coverages(estimate, DEVIATIONS, TRUTH)["interval_coverage"] == 1.0


def test_a_frame_without_standard_deviations_has_no_coverage() -> None:
    deviations = np.stack([DEVIATIONS, np.full(9, np.nan)])
    share = interval_coverages(np.stack([TRUTH, TRUTH]), deviations, TRUTH)["interval_coverage"]
    np.testing.assert_array_equal(share, [1.0, np.nan])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("narrow", "standard deviations of str, not an array of 9 numbers"),
        (np.ones(7), r"standard deviations of shape \(7,\), not \(9,\)"),
        (np.where(np.arange(9) == 4, np.nan, DEVIATIONS), "standard deviations with NaN or infinity"),
        (np.where(np.arange(9) == 4, np.inf, DEVIATIONS), "standard deviations with NaN or infinity"),
        (np.where(np.arange(9) == 4, -0.001, DEVIATIONS), "a standard deviation of -0.001, not above 0"),
    ],
)
def test_wrong_standard_deviations_are_told_in_one_line(value: object, message: str) -> None:
    with pytest.raises(InvalidAnswerError, match=f"^tracker 'mine' returned {message}$"):
        check_standard_deviations(value, 9, "tracker 'mine'")


def test_standard_deviations_may_be_left_out_and_may_be_a_list() -> None:
    assert check_standard_deviations(None, 9, "tracker 'mine'") is None
    np.testing.assert_array_equal(check_standard_deviations(DEVIATIONS.tolist(), 9, "tracker 'mine'"), DEVIATIONS)


# Lost

AWAY = np.array([False, True, True, True, False, False])


@pytest.mark.parametrize(
    ("lost", "precision", "recall"),
    [
        (AWAY, 1.0, 1.0),
        (np.ones(6, dtype=bool), 0.5, 1.0),
        (np.arange(6) == 2, 1.0, 1 / 3),
        (~AWAY, 0.0, 0.0),
        (np.zeros(6, dtype=bool), None, 0.0),
    ],
)
def test_precision_and_recall_of_being_lost(lost: np.ndarray, precision: float | None, recall: float) -> None:
    told = lost_precision(lost, AWAY)
    assert (None if np.isnan(told).all() else np.nanmean(told)) == precision
    assert np.nanmean(lost_recall(lost, AWAY)) == pytest.approx(recall)


def test_where_nothing_is_ever_out_of_view_lost_is_neither_right_nor_wrong() -> None:
    nothing = np.zeros(6, dtype=bool)
    assert np.isnan(lost_precision(~nothing, nothing)).all()
    assert np.isnan(lost_recall(~nothing, nothing)).all()


def test_frames_to_recover_are_the_median_over_returns() -> None:
    right, wrong = 0.5 * RECOVERED_M, 2.0 * RECOVERED_M
    errors = np.array([right, wrong, right, right, wrong, wrong, wrong, right, wrong, wrong, wrong, wrong])
    away = np.array([0, 1, 0, 0, 1, 0, 0, 0, 1, 1, 0, 0], dtype=bool)
    # At once; after two frames; not within the two that are left.
    assert frames_to_recover(errors, away) == 2.0
    assert frames_to_recover(errors[:8], away[:8]) == 1.0


def test_what_never_returns_never_recovers() -> None:
    errors = np.zeros(4)
    assert np.isnan(frames_to_recover(errors, np.zeros(4, dtype=bool)))
    assert np.isnan(frames_to_recover(errors, np.array([False, False, True, True])))
    # In the middle of what is asked for, the first frame is no return.
    assert np.isnan(frames_to_recover(errors[:0], np.zeros(0, dtype=bool)))


def test_lag_and_jitter_leave_out_frames_that_do_not_count() -> None:
    true = np.outer(np.sin(np.linspace(0, 3, 40)), [0.01, 0.02, 0.02])
    late = np.concatenate([true[:1], true[:-1]])
    spoilt = late.copy()
    spoilt[10:15] = 5.0
    known = spoilt.copy()
    known[10:15] = np.nan
    assert lag(known, true, 0.1) == pytest.approx(lag(late, true, 0.1), rel=0.01)
    assert abs(lag(spoilt, true, 0.1)) > 1.0
    whole, holed, jumping = (jitter(np.stack([path, path], axis=1), 0.1) for path in (late, known, spoilt))
    assert holed == pytest.approx(whole, rel=0.2)
    assert jumping > 100.0
    assert np.isnan(jitter(np.full((5, 2, 3), np.nan), 0.1))


# In records and tables


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of trackers on arms that leave early in a short sequence, and come back."""
    folder = tmp_path_factory.mktemp("told")
    preset = load_preset("in-and-out", pairs=1, frames=40)
    absences = preset.motion.absences
    assert absences is not None
    often = absences.model_copy(update={"every_frames": (4, 4), "out_frames": (6, 6), "travel_frames": (8, 8)})
    motion = preset.motion.model_copy(update={"absences": often, "fast_share": 0.0})
    generate(plan_dataset(preset.model_copy(update={"motion": motion})), folder / "data")
    trackers = [word for name in ("Unsure", "Still") for word in ("--tracker", f"{STRANGERS}:{name}")]
    surgbench(*RUN, "--dataset", folder / "data", *trackers, "--filter", "truth", "--out", folder / "runs")
    return folder / "runs"


@pytest.mark.slow
def test_standard_deviations_are_recorded_and_read_back(ran: Path) -> None:
    for one in read_records([ran]):
        assert isinstance(one, InstrumentRecord)
        deviations = one.frames.standard_deviations
        if one.spec.tracker.name == "still":
            assert deviations == [None] * 40
            assert np.isnan(one.errors["interval_coverage"]).all()
        else:
            assert deviations[0] == [0.5] * 3 + [0.001] * 3 + [0.5] * 3
            assert [known is None for known in deviations] == [index % 3 == 2 for index in range(40)]
    runs = public.load_records(ran)
    assert runs["interval_coverage"][runs["tracker"] == "unsure"].eq(1.0).all()
    assert runs["interval_coverage"][runs["tracker"] == "still"].isna().all()


@pytest.mark.slow
def test_frames_out_of_view_are_in_no_error(ran: Path) -> None:
    for one in records(ran):
        gone = np.array([value is None for value in one["errors"]["mask_error"]])
        assert 5 < gone.sum() < 30
        assert not gone[:4].any()
        for name in ("tip_error_m", "q3_error_rad", "interval_coverage"):
            values = [value for (value,) in one["errors"][name]]
            assert all(value is None for value, out in zip(values, gone, strict=True) if out)
        assert [value is None for value in one["errors"]["mask_error_true"]] == gone.tolist()


@pytest.mark.slow
def test_rows_say_whether_lost_is_right(ran: Path) -> None:
    rows = {row["tracker"]: row for row in read_rows([ran])}
    # It notices an empty mask, but not the last few pixels of a jaw.
    assert rows["unsure"]["lost_precision"] == 1.0
    assert 0.5 < rows["unsure"]["lost_recall"] < 1.0
    assert rows["still"]["lost_precision"] is None
    assert rows["still"]["lost_recall"] == 0.0
    assert rows["still"]["frames_to_recover"] == 0.0  # a floor: its searches start at the truth
    assert rows["still"]["interval_coverage"] is None


def test_a_page_shows_what_some_row_tells(tmp_path: Path) -> None:
    told, silent = record(row_id="told"), record(row_id="silent")
    told["errors"] |= {name: [[share]] * 4 for name, share in zip(INTERVAL_COVERAGES, np.arange(6) / 10, strict=True)}
    rows = [{**row, "label": row["row_id"]} for row in read_rows([write(tmp_path, told, silent)])]
    table = _told_table(rows, SURE)
    assert "| told | `told` | 0.0 | 10.0 | 20.0 | 30.0 | 40.0 | 50.0 |" in table
    assert "silent" not in table
    assert _told_table(rows, OUT_OF_VIEW) == ""
