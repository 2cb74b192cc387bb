"""Rows held against each other: tests as SciPy and the books have them, what is left out, and how it is shown."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import surgbench as command
from fabricate import failed, record, with_seed, write
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import friedmanchisquare, wilcoxon

import surgbench
from surgbench.errors import ConfigError
from surgbench.records.reader import read_records
from surgbench.report import comparison_tables
from surgbench.report.column import Column
from surgbench.report.comparison import PAIR_COLUMNS, compare_records, pair_rows
from surgbench.report.field import keys
from surgbench.report.paired_tests import Comparison, compare_rows, holm, least_p, rank, signed_rank_p

ERROR = Column("mask_error", "mask error", decimals=3, best=True)
Means = dict[str, dict[str, float]]


def of(**errors: Any) -> Means:
    """Rows to their errors on the sequences 000, 001, …; a sequence that is None was not done."""
    return {
        name: {f"{n:03d}": float(value) for n, value in enumerate(values) if value is not None}
        for name, values in errors.items()
    }


def compared(**errors: Any) -> Comparison:
    return compare_rows("mini", "single arms", ERROR, of(**errors))


def test_a_known_difference_comes_out_with_its_interval_and_scipys_p() -> None:
    rng = np.random.default_rng(1)
    theirs = rng.uniform(0.1, 0.3, 20)
    ours = theirs - 0.02 + rng.normal(0.0, 0.005, 20)
    pair = compared(ours=ours, theirs=theirs).pair("ours", "theirs")
    assert pair.difference == pytest.approx((ours - theirs).mean())
    assert pair.low is not None
    assert pair.high is not None
    assert -0.025 < pair.low < (ours - theirs).mean() < pair.high < -0.015
    assert pair.p == pair.p_holm == wilcoxon(ours, theirs).pvalue
    assert pair.significant
    assert (pair.sequences, pair.wins, pair.losses, pair.ties) == (20, 20, 0, 0)


def test_holms_correction_as_worked_out_by_hand() -> None:
    # Smallest first: 0.005 x 4, 0.01 x 3, 0.03 x 2, 0.04 x 1, and none below one before it.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_the_correction_is_for_all_pairs_of_a_table() -> None:
    found = compared(a=np.arange(8) / 100, b=np.arange(8) / 100 + 0.1, c=np.arange(8) / 100 + 0.3)
    assert {pair.p for pair in found.pairs} == {2 / 2**8}
    assert {pair.p_holm for pair in found.pairs} == {3 * 2 / 2**8}


def test_identical_rows_are_tied() -> None:
    found = compared(a=[0.1, 0.2, 0.3], b=[0.1, 0.2, 0.3], c=[0.1, 0.2, 0.3])
    for pair in found.pairs:
        assert (pair.p, pair.p_holm, pair.difference) == (1.0, 1.0, 0.0)
        assert (pair.wins, pair.losses, pair.ties) == (0, 0, 3)
        assert (pair.low, pair.high) == (0.0, 0.0)
    assert found.ranks is not None
    assert set(found.ranks.mean.values()) == {2.0}
    assert found.ranks.p == 1.0


def test_the_truth_wins_everywhere() -> None:
    rng = np.random.default_rng(2)
    found = compared(truth=np.zeros(9), a=rng.uniform(0.1, 0.2, 9), b=rng.uniform(0.1, 0.2, 9))
    for other in ("a", "b"):
        pair = found.pair("truth", other)
        assert (pair.wins, pair.losses, pair.significant) == (9, 0, True)
    assert found.rows[0] == "truth"
    assert found.ranks is not None
    assert found.ranks.mean["truth"] == 1.0


def test_ranks_are_friedmans_and_the_critical_difference_is_nemenyis() -> None:
    rng = np.random.default_rng(3)
    errors = {name: rng.uniform(0.1, 0.2, 10) for name in "abcd"}
    ranks = rank(of(**errors))
    assert ranks is not None
    assert ranks.p == pytest.approx(friedmanchisquare(*errors.values()).pvalue)
    # Demšar 2006, Table 5: q of four classifiers is 2.569; CD = q sqrt(k (k + 1) / 6 N).
    assert ranks.critical_difference == pytest.approx(2.569 * np.sqrt(4 * 5 / (6 * 10)), abs=1e-3)
    assert sum(ranks.mean.values()) == pytest.approx(10)
    assert rank(of(a=[0.1, 0.2], b=[0.2, 0.3])) is None


def test_only_common_sequences_count() -> None:
    found = compared(a=[0.1, 0.2, None, 9.0], b=[0.2, 0.3, 0.4, None], c=[0.1, 0.1, 0.1, 0.1])
    pair = found.pair("a", "b")
    assert (pair.sequences, pair.wins) == (2, 2)
    assert pair.difference == pytest.approx(-0.1)
    assert found.ranks is not None
    assert found.ranks.sequences == 2
    apart = compared(a=[0.1, None], b=[None, 0.1]).pair("a", "b")
    assert (apart.sequences, apart.difference, apart.low, apart.p, apart.p_holm) == (0, None, None, None, None)


def test_few_sequences_cannot_tell_and_it_is_said() -> None:
    assert least_p(5) == wilcoxon(np.arange(1.0, 6.0)).pvalue
    assert least_p(1) == 1.0
    few = compared(a=[0.1] * 5, b=[0.2] * 5)
    assert few.too_few
    assert "5 sequences for 1 pair are too few for any difference to be significant." in (
        comparison_tables.comparison_notes(few)
    )
    assert not compared(a=[0.1] * 6, b=[0.2] * 6).too_few
    one = compared(a=[0.1], b=[0.2])
    assert (one.pairs[0].p, one.pairs[0].low, one.too_few) == (1.0, None, True)
    assert signed_rank_p([]) is None


@settings(deadline=None, max_examples=20)
@given(st.lists(st.tuples(*[st.sampled_from([0.0, 0.1, 0.1000001, 0.3, 7.0])] * 2), min_size=1, max_size=8))
def test_from_the_other_side_it_is_the_same(values: list[tuple[float, float]]) -> None:
    a, b = zip(*values, strict=True)
    found = compared(a=a, b=b)
    ours, theirs = found.pair("a", "b"), found.pair("b", "a")
    assert ours.difference is not None
    assert theirs.difference == -ours.difference
    assert (ours.wins, ours.losses, ours.ties) == (theirs.losses, theirs.wins, theirs.ties)
    assert (ours.p, ours.p_holm) == (theirs.p, theirs.p_holm)
    assert signed_rank_p(np.subtract(a, b)) == pytest.approx(signed_rank_p(np.subtract(b, a)))
    if ours.low is not None:
        assert ours.high is not None
        assert (theirs.low, theirs.high) == (-ours.high, -ours.low)
        assert ours.low <= ours.high
    assert 0 <= (ours.p or 0) <= 1


def line(name: str, errors: list[float], **axes: Any) -> list[dict[str, Any]]:
    """A row's records with these mask errors, a sequence each."""
    records = []
    for number, error in enumerate(errors):
        one = record(name, f"{number:03d}-left", frames=2, **axes)
        one["errors"]["mask_error"] = [error, error]
        records.append(one)
    return records


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    ours = line("ours", [0.01 * n for n in range(1, 8)])
    theirs = line("theirs", [0.01 * n + 0.02 for n in range(1, 8)])
    third = line("third", [0.01 * n + 0.005 * (-1) ** n for n in range(1, 8)])
    return write(tmp_path / "runs", *ours, *theirs, *third)


def test_records_are_compared_by_what_they_are_ranked_by_and_by_what_is_asked_for(runs: Path) -> None:
    (found,) = compare_records(read_records([runs]))
    assert (found.dataset, found.title, found.error.key) == ("mini", "single arms", "mask_error")
    assert found.rows[-1] == "theirs"
    assert found.pair("ours", "theirs").difference == pytest.approx(-0.02)
    (other,) = compare_records(read_records([runs]), "tip_error_m")
    assert other.pair("ours", "theirs").ties == 7
    with pytest.raises(ConfigError, match="unknown error 'tip_eror_m'; did you mean 'tip_error_m'"):
        compare_records(read_records([runs]), "tip_eror_m")
    with pytest.raises(ConfigError, match="unknown error 'jitter'"):  # less of it may be worse
        compare_records(read_records([runs]), "jitter")


def test_repeats_are_averaged(tmp_path: Path) -> None:
    records = [*line("a", [0.1, 0.2]), *line("a", [0.3, 0.4], repeat=1), *line("b", [0.2, 0.2])]
    (found,) = compare_records(read_records([write(tmp_path, *records)]))
    assert found.pair("a", "b").difference == pytest.approx(0.05)
    assert (found.pair("a", "b").ties, found.pair("a", "b").losses) in [(1, 1), (0, 1), (0, 2)]


def test_failed_sequences_and_floors_are_not_compared_and_that_is_said(tmp_path: Path) -> None:
    bad = failed(row_id="gone")
    floor = [one | {"floor": True} for one in line("floor", [0.0, 0.0])]
    half = [*line("half", [0.1]), failed(row_id="half", unit="001-left")]
    (found,) = compare_records(read_records([write(tmp_path, bad, *floor, *half, *line("whole", [0.2, 0.3]))]))
    assert set(found.rows) == {"half", "whole"}
    assert found.pairs[0].sequences == 1
    assert set(found.left_out) == {"gone: no sound sequence with a value", "floor: a floor"}


def test_rows_of_one_name_are_told_apart(tmp_path: Path) -> None:
    seeded = [with_seed(seed, one, variant="v") for seed in (1, 2) for one in line("a", [0.1 * seed])]
    (found,) = compare_records(read_records([write(tmp_path / "a", seeded[0]), write(tmp_path / "b", seeded[1])]))
    assert set(found.rows) == {"a (v, settings 111111)", "a (v, settings 222222)"}


def test_groups_and_datasets_are_not_mixed(tmp_path: Path) -> None:
    records = [record("a"), record("b"), record("a", "000"), record("b", dataset=("other", "cd" * 32))]
    found = compare_records(read_records([write(tmp_path / str(n), one) for n, one in enumerate(records)]))
    assert [(one.dataset, one.title, one.rows) for one in found] == [
        ("mini", "single arms", ("a", "b")), ("mini", "both arms together", ("a",)), ("other", "single arms", ("b",)),
    ]  # fmt: skip
    assert len(pair_rows(found)) == 1


def test_the_frame_of_a_notebook_is_what_the_command_writes(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = surgbench.compare(runs)
    assert tuple(frame.columns) == keys(PAIR_COLUMNS)
    command("compare", runs, "--format", "csv")
    lines = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [float(one["difference"]) for one in lines] == frame["difference"].tolist()
    command("compare", runs, "--format", "json")
    assert [one["p"] for one in json.loads(capsys.readouterr().out)] == frame["p"].tolist()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_it_is_shown_at_any_width(runs: Path, width: int) -> None:
    text = comparison_tables.table(compare_records(read_records([runs])), width)
    assert max(map(len, text.splitlines())) <= width
    assert "7:0*" in text
    assert "0.047" in text  # three times 2 / 2^7


def test_markdown_and_latex_have_matrix_and_pairs(runs: Path, tmp_path: Path) -> None:
    command("compare", runs, "--format", "markdown", "--out", tmp_path / "a.md")
    page = (tmp_path / "a.md").read_text(encoding="utf-8")
    assert "### Compared by pairs: mini, single arms: mask error" in page
    assert "| 3 | theirs | 3.00 | 0:7* | 0:7* | – |" in page
    assert "| ours | theirs | −0.020 |" in page
    command("compare", runs, "--format", "latex", "--out", tmp_path / "a.tex")
    source = (tmp_path / "a.tex").read_text(encoding="utf-8")
    assert source.count(r"\begin{tabular}") == 2
    assert r"ours & theirs & $-$0.020 &" in source


def test_names_are_no_markup(tmp_path: Path) -> None:
    found = compare_records(read_records([write(tmp_path, *line("a|[b]$", [0.1, 0.2]), *line("c", [0.2, 0.3]))]))
    assert "a|[b]$" in comparison_tables.table(found)
    assert r"a\|[b]$" in comparison_tables.markdown(found)
    assert r"a\textbar{}[b]\$" in comparison_tables.latex(found)


def test_the_markdown_leaderboard_has_it_too(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command("report", runs, "--format", "markdown")
    assert "### Compared by pairs: mini, single arms: mask error" in capsys.readouterr().out


@pytest.mark.extras
@pytest.mark.parametrize("ending", ["png", "svg"])
def test_ranks_are_drawn_the_same_each_time(runs: Path, tmp_path: Path, ending: str) -> None:
    pytest.importorskip("matplotlib")
    paths = [tmp_path / f"{name}.{ending}" for name in "ab"]
    for path in paths:
        command("compare", runs, "--diagram", path)
    content = paths[0].read_bytes()
    assert content == paths[1].read_bytes()
    if ending == "svg":
        assert b"theirs" in content
        assert b"critical difference" in content


@pytest.mark.parametrize(("rows", "name", "said"), [(2, "a.png", "three rows"), (3, "a.gif", ".png or .svg")])
def test_what_cannot_be_drawn_is_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rows: int, name: str, said: str
) -> None:
    records = [one for row in range(rows) for one in line(f"row{row}", [0.1, 0.2])]
    command("compare", write(tmp_path / "runs", *records), "--diagram", tmp_path / name, expect=2)
    assert said in capsys.readouterr().err
