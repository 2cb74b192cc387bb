"""Rows of one table held against each other, sequence by sequence: who is better, and whether that may be chance.

Sequences differ more from each other than trackers do, so that what counts is the difference on the same sequence. The
tests are those of Demšar, *Statistical comparisons of classifiers over multiple data sets*, JMLR 7 (2006): of each pair
the signed ranks of Wilcoxon, with Holm's correction for the number of pairs; of three rows or more Friedman's test of
their ranks, and Nemenyi's critical difference. ``docs/metrics.md`` says how to read them.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from surgbench.geometry import FloatArray
from surgbench.report.bootstrap import mean_interval
from surgbench.report.column import Column
from surgbench.report.sequence_means import differences, shared

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class RowPair:
    """Two rows on the sequences that both have done.

    Attributes:
        row_a: Name of the one.
        row_b: Name of the other.
        sequences: How many both have.
        difference: Mean of a's error less b's: below 0 a is better; ``None`` without a common sequence.
        low: Lower end of its 95 % interval (:func:`surgbench.report.bootstrap.mean_interval`); ``None`` for one.
        high: Upper end.
        p: Two-sided, of Wilcoxon's signed ranks; ``None`` without a common sequence.
        p_holm: The same after Holm's correction for all pairs of the comparison.
        wins: Sequences in which a's error is the smaller one.
        losses: In which b's is.
        ties: In which they are the same.
    """

    row_a: str
    row_b: str
    sequences: int
    difference: float | None
    low: float | None
    high: float | None
    p: float | None
    p_holm: float | None
    wins: int
    losses: int
    ties: int

    @property
    def significant(self) -> bool:
        """Whether the difference is more than chance would make of so many pairs."""
        return self.p_holm is not None and self.p_holm < SIGNIFICANT


@dataclass(frozen=True)
class Ranks:
    """Rows ranked within every sequence that all of them have done.

    Attributes:
        sequences: How many these are.
        mean: Name to mean rank, 1 for the best; ties share theirs.
        p: Of Friedman's test that all rows are alike.
        critical_difference: Two rows whose mean ranks are less apart are not told apart (Nemenyi, at 5 %).
    """

    sequences: int
    mean: dict[str, float]
    p: float
    critical_difference: float


@dataclass(frozen=True)
class Comparison:
    """All rows of one dataset and group.

    Attributes:
        dataset: As the leaderboard calls it.
        title: As it stands over the leaderboard's table.
        error: What is compared, less is better.
        rows: Names, best mean first.
        means: Name to unit to mean error.
        pairs: Every two rows, in the order of ``rows``.
        ranks: Of three rows or more with two common sequences; else ``None``.
        left_out: One line for each row of the table that is not compared, and why.
    """

    dataset: str
    title: str
    error: Column
    rows: tuple[str, ...]
    means: Mapping[str, Mapping[str, float]]
    pairs: tuple[RowPair, ...]
    ranks: Ranks | None
    left_out: tuple[str, ...] = ()

    def pair(self, row_a: str, row_b: str) -> RowPair:
        """Two rows, as seen from the first.

        Raises:
            KeyError: One of them is not compared.
        """
        for pair in self.pairs:
            if (pair.row_a, pair.row_b) == (row_a, row_b):
                return pair
            if (pair.row_a, pair.row_b) == (row_b, row_a):
                return turned(pair)
        raise KeyError((row_a, row_b))

    @property
    def too_few(self) -> bool:
        """Whether no pair could come out significant, whatever its differences: there are too few sequences."""
        return not any(least_p(pair.sequences) * len(self.pairs) < SIGNIFICANT for pair in self.pairs)


def compare_rows(
    dataset: str,
    title: str,
    error: Column,
    means: Mapping[str, Mapping[str, float]],
    left_out: Sequence[str] = (),
) -> Comparison:
    """Hold rows against each other.

    Args:
        dataset: Whose they are.
        title: As it stands over their table.
        error: What the means are of.
        means: Name of each row to unit to mean error; finite. Each pair is compared on the units that both have, ranks
            are of those that all have.
        left_out: One line for each row that is not there, and why.

    Returns:
        The comparison; with no pairs where there are less than two rows.

    Example:
        >>> from surgbench.report.column import Column
        >>> from surgbench.report.paired_tests import compare_rows
        >>> ours = {f"{n:03d}": 0.1 + 0.01 * n for n in range(8)}
        >>> theirs = {unit: error + 0.02 for unit, error in ours.items()}
        >>> found = compare_rows("mini", "single arms", Column("mask_error", "mask error"), {"a": ours, "b": theirs})
        >>> pair = found.pair("a", "b")
        >>> pair.sequences, pair.wins, round(pair.difference, 9), round(pair.p, 4), pair.significant
        (8, 8, -0.02, 0.0078, True)
    """
    names = sorted(means, key=lambda name: (float(np.mean([*means[name].values()])), name))
    own = {name: {unit: means[name][unit] for unit in sorted(means[name])} for name in names}
    pairs = [_pair(a, b, own[a], own[b]) for a, b in combinations(names, 2)]
    corrected = iter(holm([pair.p for pair in pairs if pair.p is not None]))
    pairs = [pair if pair.p is None else replace(pair, p_holm=next(corrected)) for pair in pairs]
    return Comparison(dataset, title, error, tuple(names), own, tuple(pairs), rank(own), tuple(left_out))


def rank(means: Mapping[str, Mapping[str, float]]) -> Ranks | None:
    """Rows ranked within the sequences that all have; ``None`` for less than three rows or two such sequences."""
    from scipy.stats import friedmanchisquare, rankdata, studentized_range

    units = shared([*means.values()])
    rows, sequences = len(means), len(units)
    if rows < 3 or sequences < 2:
        return None
    errors = np.array([[own[unit] for unit in units] for own in means.values()])
    ranks = rankdata(errors, axis=0)
    # Where all rows are alike in every sequence there is nothing that could be divided by.
    p = 1.0 if (ranks == ranks[:1]).all() else float(friedmanchisquare(*errors).pvalue)
    quantile = float(studentized_range.ppf(1.0 - SIGNIFICANT, rows, np.inf)) / np.sqrt(2.0)
    return Ranks(
        sequences,
        dict(zip(means, ranks.mean(axis=1).tolist(), strict=True)),
        p,
        float(quantile * np.sqrt(rows * (rows + 1) / (6.0 * sequences))),
    )


def signed_rank_p(values: ArrayLike) -> float | None:
    """Two-sided p of Wilcoxon's signed ranks: that differences are as often and as far above 0 as below.

    Args:
        values: ``(n,)``, finite. Zeros are left out, as Wilcoxon has it.

    Returns:
        As :func:`scipy.stats.wilcoxon` chooses to calculate it, of few exactly; 1 where all are 0; ``None`` of none.

    Example:
        >>> from surgbench.report.paired_tests import signed_rank_p
        >>> signed_rank_p([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), signed_rank_p([0.0, 0.0])
        (0.03125, 1.0)
    """
    from scipy.stats import wilcoxon

    found = np.asarray(values, dtype=np.float64)
    if not found.size:
        return None
    if not found.any():
        return 1.0
    with warnings.catch_warnings():  # of few values with ties, that the p is not exact
        warnings.simplefilter("ignore")
        return float(min(1.0, wilcoxon(found).pvalue))


def holm(p: Sequence[float]) -> list[float]:
    """Holm's correction: each p times how many are no smaller, at least what a smaller one got, at most 1.

    Example:
        >>> from surgbench.report.paired_tests import holm
        >>> [round(one, 9) for one in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]
    """
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    scaled = np.minimum(1.0, values[order] * np.arange(len(values), 0, -1))
    corrected: FloatArray = np.empty_like(values)
    corrected[order] = np.maximum.accumulate(scaled)
    return [float(one) for one in corrected]


def least_p(sequences: int) -> float:
    """The smallest p that so many sequences can have: all differences have one sign.

    Example:
        Five sequences never tell two rows apart at 5 %.

        >>> from surgbench.report.paired_tests import least_p
        >>> least_p(5), least_p(6)
        (0.0625, 0.03125)
    """
    return min(1.0, 2.0 ** (1 - sequences))


def turned(pair: RowPair) -> RowPair:
    """The same pair, seen from the other row."""
    low, high = (None if end is None else -end for end in (pair.high, pair.low))
    difference = None if pair.difference is None else -pair.difference
    ends = (pair.sequences, difference, low, high, pair.p, pair.p_holm)
    return RowPair(pair.row_b, pair.row_a, *ends, pair.losses, pair.wins, pair.ties)


def _pair(row_a: str, row_b: str, a: Mapping[str, float], b: Mapping[str, float]) -> RowPair:
    values = differences(a, b)
    low, high = mean_interval(values) or (None, None)
    wins, losses = sum(value < 0 for value in values), sum(value > 0 for value in values)
    mean = float(np.mean(values)) if values else None
    p = signed_rank_p(values)
    return RowPair(row_a, row_b, len(values), mean, low, high, p, p, wins, losses, len(values) - wins - losses)
