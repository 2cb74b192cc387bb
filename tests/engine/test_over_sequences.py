"""Means and spreads over sequences, as articles print them, and masks that a table leaves to its user."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commandline import surgbench
from fabricate import record, write

from surgbench.errors import ConfigError, DatasetError
from surgbench.records.reader import read_records
from surgbench.reproduce.load import ToldMasks, load_table
from surgbench.reproduce.make import render
from surgbench.reproduce.over_sequences import FRAMES_PER_SECOND, SUFFIX, spread_over_sequences
from surgbench.reproduce.published import Figure
from surgbench.tasks.instrument.page_spread import spread_table

RESULTS = Path(__file__).parents[2] / "results"


def test_every_sequence_weighs_the_same_however_long_it_is(tmp_path: Path) -> None:
    # Errors of a frame are 0.01 (frame + 1): means of 0.015, 0.025 and 0.045.
    lengths = {"000-left": 2, "000-right": 4, "001-left": 8}
    folder = write(tmp_path, *(record(unit=unit, frames=frames) for unit, frames in lengths.items()))
    records = read_records([folder])
    row = spread_over_sequences(["mask_error_true", FRAMES_PER_SECOND], records, records)
    assert row[f"mask_error_true{SUFFIX}"] == pytest.approx(np.std([0.015, 0.025, 0.045], ddof=1))
    # A frame takes 10 ms and one more than the frame before it.
    rates = [1000 / (10 + (frames - 1) / 2) for frames in lengths.values()]
    assert row[FRAMES_PER_SECOND] == pytest.approx(np.mean(rates))
    assert row[FRAMES_PER_SECOND + SUFFIX] == pytest.approx(np.std(rates, ddof=1))


def test_of_one_sequence_there_is_no_spread(tmp_path: Path) -> None:
    records = read_records([write(tmp_path, record(), record(repeat=1))])
    row = spread_over_sequences(["mask_error_true"], records, records)
    assert row == {f"mask_error_true{SUFFIX}": None}


def test_published_and_ours_stand_one_over_the_other() -> None:
    definition = load_table("table2")
    block, published = definition.table.blocks[0], definition.published
    assert published is not None
    row = {
        "row_id": "particle-filter-1000",
        "mask_error_true": 0.125,
        f"mask_error_true{SUFFIX}": 0.0625,
        FRAMES_PER_SECOND: 50.0,
        FRAMES_PER_SECOND + SUFFIX: 0.5,
    }
    theirs, ours = spread_table(block, [row], published).splitlines()[2:]
    assert theirs.split("|")[3:5] == [" 0.2476 ± 0.0515 ", " 19.22 ± 0.45 "]
    assert ours.split("|")[3:5] == [" 0.1250 ± 0.0625 ", " 50.00 ± 0.50 "]
    figure = published.rows["cmaes-3-joints-collected"].data["collected"]["mask_error_true"]
    assert figure == Figure(mean=0.1177, std=0.0396)


def test_tables_without_a_spread_have_no_such_part() -> None:
    definition = load_table("table1")
    assert spread_table(definition.table.blocks[0], [{"row_id": "cmaes-3"}], definition.published) == ""


def test_rows_that_leave_their_masks_open_need_to_be_told() -> None:
    plain = [row.id for _, row in load_table("table1-surgpose").table.rows()]
    assert not any("online" in id_ for id_ in plain)
    told = ToldMasks("colour-edge", {"colour-edge": {"width_px": 200}})
    rows = {row.id: row for _, row in load_table("table1-surgpose", told).table.rows()}
    online = {
        f"{speed}-{tracker}-online-colour-edge" for speed in ("normal", "fast") for tracker in ("cmaes", "hybrid")
    }
    assert set(rows) - set(plain) == online
    for id_ in online:
        asked = rows[id_].asked(False)
        assert asked.model_dump()["masks"] == "colour-edge"
        assert asked.options["colour-edge"] == {"width_px": 200}
    assert rows["normal-cmaes-online-colour-edge"].published == "cmaes-online"


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        (ToldMasks("observed"), "makes no masks of images"),
        (ToldMasks("union"), "is no mask source"),
        (ToldMasks("colour-edge", {"cmaes": {"iterations": 20}}), "--set cmaes.…: is not the mask source"),
    ],
)
def test_rows_from_pixels_are_made_from_pixels_and_nothing_else_is_changed(told: ToldMasks, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        load_table("table1-surgpose", told)


def test_masks_told_to_a_table_that_leaves_none_open(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="no row of this table leaves its masks open"):
        load_table("table2", ToldMasks("colour-edge"))
    surgbench("reproduce", "table1", "--set", "sam2.model=somewhere", expect=2)
    assert "--set: is for a mask source" in capsys.readouterr().err


def test_a_page_is_not_written_of_files_that_lack_a_row() -> None:
    folder = RESULTS / "table2"
    before = (folder / "leaderboard.md").read_bytes()
    with pytest.raises(DatasetError, match=r"has no row 'gd-10' of the table; run it \(--row gd-10\)"):
        render(load_table("table1"), folder)
    assert (folder / "leaderboard.md").read_bytes() == before
