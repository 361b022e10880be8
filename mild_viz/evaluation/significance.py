"""Whether one predictor is better than another: the paper's test beside those that its design of trials allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from mild_viz.evaluation.metrics import Measured

LEVEL = 0.05
"""Significance level, and one minus the coverage of the intervals."""
N_FLIPS = 2**16
"""Sign flips: all 2^n of them up to n = 16 trials, beyond that as many random ones."""
N_RESAMPLES = 9999
SEED = 0
POOLED = "all"
"""Stands for the action in a comparison over all actions."""
TESTS = ("mann_whitney", "sign_flip", "wilcoxon")


@dataclass(frozen=True)
class Comparison:
    """Two predictors on the same test windows of one action, or of all. An error is rad^2, or m^2 x 100."""

    first: str
    second: str
    action: str
    n_trials: int
    n_windows: int
    difference: float
    """Mean error of the first minus that of the second, as the table gives them: below 0 the first is better."""
    low: float
    """95 % cluster-bootstrap interval of the difference; NaN where an action has a single trial."""
    high: float
    a12: float
    """Vargha and Delaney's A: chance that a window of the first has the larger error (ties count half)."""
    mann_whitney_p: float
    """The paper's test, over windows. They overlap and are not independent: the p is too small."""
    sign_flip_p: float
    """Paired test of the trials' mean errors, by flipping the signs of their differences."""
    wilcoxon_p: float
    """Wilcoxon's signed-rank test of the same differences."""
    smallest_p: float
    """The smallest p that the sign-flip test can give with so many trials (and Wilcoxon's, while it is exact)."""
    mann_whitney_p_holm: float = float("nan")
    sign_flip_p_holm: float = float("nan")
    wilcoxon_p_holm: float = float("nan")
    smallest_p_holm: float = float("nan")
    """As `smallest_p`, after Holm's correction."""

    @property
    def conclusion(self) -> str:
        """In words, by the corrected sign-flip test."""
        if np.isnan(self.difference):
            return "a prediction is not a number"
        if self.smallest_p > LEVEL:
            return "too few trials"
        if self.smallest_p_holm > LEVEL:
            return "too few for so many pairs"
        if self.sign_flip_p_holm > LEVEL:
            return "no difference shown"
        return f"{self.first if self.difference < 0 else self.second} is better"

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "conclusion": self.conclusion}


def smallest_p(n: int) -> float:
    """The smallest two-sided p that a sign-flip or an exact signed-rank test of n differences can give."""
    return 2.0 / 2**n if 2**n <= N_FLIPS else 2.0 / (N_FLIPS + 1)


def sign_flip_p(differences: Float[np.ndarray, " n"], rng: np.random.Generator) -> float:
    """Two-sided p of a mean difference of 0, if every difference were as likely with the other sign.

    Exact (all 2^n signs) where that is at most `N_FLIPS`, else by random signs.
    """
    if len(differences) < 2:
        return 1.0
    result = stats.permutation_test(
        (differences, np.zeros_like(differences)),
        lambda a, b, axis: (a - b).mean(axis),
        permutation_type="samples",  # exchanges a pair's members, which flips the sign of a difference
        vectorized=True,
        n_resamples=N_FLIPS,
        batch=4096,
        rng=rng,
    )
    return float(result.pvalue)


def wilcoxon_p(differences: Float[np.ndarray, " n"]) -> float:
    """Two-sided p of Wilcoxon's signed-rank test; differences of 0 are left out, as he did."""
    differences = differences[differences != 0]
    if not len(differences):
        return 1.0
    result: Any = stats.wilcoxon(differences)
    return float(result.pvalue)


def bootstrap_interval(
    sums: Float[np.ndarray, " n"], counts: Int[np.ndarray, " n"], group: Sequence[str], rng: np.random.Generator
) -> tuple[float, float]:
    """95 % interval of a mean over windows (averaged over groups), resampling whole trials within each group.

    The percentile interval, widened by what it lacks for few clusters (expanded percentiles: Hesterberg, "What
    teachers should know about the bootstrap", 2015): by sqrt(n / (n - 1)) and from the normal to the t quantile.

    Args:
        sums: Sum over the windows of each trial.
        counts: Number of windows of each trial.
        group: Action of each trial.
        rng: Where the resamples come from.

    Returns:
        Low and high end, NaN where a group has a single trial.
    """
    names = np.array(group)
    members = [np.flatnonzero(names == name) for name in dict.fromkeys(group)]
    if min(map(len, members)) < 2:
        return float("nan"), float("nan")

    def mean(*trials: np.ndarray, axis: int) -> np.ndarray:
        return np.mean([sums[index].sum(axis) / counts[index].sum(axis) for index in trials], axis=0)

    n, freedom = len(sums), len(sums) - len(members)
    tail = float(stats.norm.cdf(-np.sqrt(n / freedom) * stats.t.ppf(1 - LEVEL / 2, freedom)))
    interval = stats.bootstrap(
        members,
        mean,
        n_resamples=N_RESAMPLES,
        vectorized=True,
        confidence_level=1 - 2 * tail,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _compare(first: Measured, second: Measured, names: tuple[str, str], action: str) -> Comparison:
    of = np.full(len(first.trial), True) if action == POOLED else first.of_action(action)
    a, b, trial = first.errors[of], second.errors[of], first.trial[of]
    trials, index = np.unique(trial, return_inverse=True)
    actions = [first.actions[i] for i in trials]
    counts = np.bincount(index)
    sums = np.bincount(index, a - b)
    difference = np.mean(
        [(a - b)[np.isin(trial, trials[np.array(actions) == name])].mean() for name in dict.fromkeys(actions)]
    )
    low = high = a12 = windows_p = flip_p = rank_p = float("nan")
    if np.isfinite(difference):
        test = stats.mannwhitneyu(a, b)
        a12, windows_p = test.statistic / len(a) / len(b), test.pvalue
        flip_p = sign_flip_p(sums / counts, np.random.default_rng(SEED))
        rank_p = wilcoxon_p(sums / counts)
        low, high = bootstrap_interval(sums, counts, actions, np.random.default_rng(SEED))
    return Comparison(
        *names, action, len(trials), len(a), float(difference), low, high, float(a12), float(windows_p), flip_p, rank_p,
        smallest_p(len(trials)),
    )  # fmt: skip


def holm_p(p: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """p values after Holm's step-down correction over a family, NaN (tests that were not made) left out."""
    corrected = np.full_like(p, np.nan)
    order = np.argsort(p)[: np.count_nonzero(~np.isnan(p))]  # NaN is sorted last
    steps = p[order] * np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected


def holm(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Fill in the p values after Holm's correction over these comparisons, each test for itself."""
    corrected = {f"{test}_p_holm": holm_p(np.array([getattr(c, f"{test}_p") for c in comparisons])) for test in TESTS}
    # No corrected p is below this: Holm multiplies the smallest by their number, and lets none fall below it.
    floor = min(1.0, len(comparisons) * min((comparison.smallest_p for comparison in comparisons), default=1.0))
    return [
        replace(
            comparison,
            **{name: float(p[i]) for name, p in corrected.items()},
            smallest_p_holm=max(comparison.smallest_p, floor),
        )
        for i, comparison in enumerate(comparisons)
    ]


def compare(pairs: Sequence[tuple[tuple[str, Measured], tuple[str, Measured]]]) -> list[Comparison]:
    """Compare pairs of named predictors, measured on the same windows, per action and over all of them.

    Over all actions, the difference is that of the table's last column (actions count equally), trials and windows
    are pooled. Holm's correction has two families: the comparisons over all actions, which answer the question, and
    those of single actions, which say where. Where there is one action, it is all.
    """
    pooled, single = [], []
    for (first_name, first), (second_name, second) in pairs:
        if not np.array_equal(first.trial, second.trial) or first.actions != second.actions:
            raise ValueError(f"{first_name} and {second_name} were not measured on the same windows")
        names, actions = (first_name, second_name), dict.fromkeys(first.actions)
        single += [_compare(first, second, names, action) for action in actions if len(actions) > 1]
        pooled.append(_compare(first, second, names, POOLED))
    pooled, single = holm(pooled), holm(single)
    each = len(single) // max(len(pooled), 1)
    return [c for i, last in enumerate(pooled) for c in (*single[i * each : (i + 1) * each], last)]
