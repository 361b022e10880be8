"""Tests between predictors, each against enumeration, hand counting or a simulation with a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np
import pytest

from mild_viz.evaluation import significance
from mild_viz.evaluation.metrics import Measured
from mild_viz.evaluation.significance import (
    N_FLIPS,
    POOLED,
    Comparison,
    bootstrap_interval,
    compare,
    holm,
    holm_p,
    sign_flip_p,
    smallest_p,
    wilcoxon_p,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def measured(
    errors: Sequence[float] | np.ndarray, trial: Sequence[int] | np.ndarray, actions: Sequence[str]
) -> Measured:
    return Measured("made", "model", np.asarray(errors, float), np.asarray(trial), tuple(actions))


def compared(first: Measured, second: Measured) -> dict[str, Comparison]:
    return {one.action: one for one in compare([(("a", first), ("b", second))])}


def only(first: Measured, second: Measured) -> Comparison:
    """The comparison of predictors on one action."""
    (one,) = compared(first, second).values()
    return one


def enumerated(differences: np.ndarray) -> float:
    """Two-sided p of |sum| over all signs."""
    signs = np.array(list(product((-1, 1), repeat=len(differences))))
    sums = np.abs(signs @ differences)
    return float(np.mean(sums >= abs(differences.sum()) - 1e-12))


@pytest.mark.parametrize("n", [2, 3, 5, 8, 11])
def test_sign_flip_is_the_enumeration_of_all_signs(n: int) -> None:
    differences = rng(n).normal(0.3, size=n)
    assert sign_flip_p(differences, rng()) == pytest.approx(enumerated(differences), abs=1e-12)
    tied = np.round(differences)  # with zeros and ties
    assert sign_flip_p(tied, rng()) == pytest.approx(enumerated(tied), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_the_smallest_p_is_what_differences_of_one_sign_give(n: int) -> None:
    differences = rng(n).uniform(0.1, 1.0, n)
    assert sign_flip_p(differences, rng()) == pytest.approx(smallest_p(n), abs=1e-12)
    assert wilcoxon_p(differences) == pytest.approx(smallest_p(n), abs=1e-12)


def test_many_trials_are_flipped_at_random_and_reproducibly() -> None:
    differences = rng(3).normal(0.4, size=18)
    p = sign_flip_p(differences, rng(1))
    assert p == sign_flip_p(differences, rng(1)) != sign_flip_p(differences, rng(2))
    assert p == pytest.approx(enumerated(differences), rel=0.2)
    assert sign_flip_p(np.ones(30), rng()) == pytest.approx(smallest_p(30)) == pytest.approx(2 / (N_FLIPS + 1))


def test_wilcoxon_gives_the_published_value_and_that_of_enumeration() -> None:
    # Darwin's maize, the example of Fisher and of scipy's documentation
    maize = np.array([6, 8, 14, 16, 23, 24, 28, 29, 41, -48, 49, 56, 60, -67, 75.0])
    assert wilcoxon_p(maize) == pytest.approx(0.041259765625, abs=1e-12)
    differences = np.array([0.3, -0.1, 0.7, 0.4, -0.2, 0.9])
    ranks = np.sign(differences) * np.array([3, 1, 5, 4, 2, 6])
    assert wilcoxon_p(differences) == pytest.approx(enumerated(ranks), abs=1e-12)
    assert wilcoxon_p(np.zeros(4)) == 1.0
    assert wilcoxon_p(np.array([0.0, 1.0, 2.0])) == pytest.approx(smallest_p(2))  # a zero tells nothing


def test_a12_by_hand_and_the_window_test_by_enumeration() -> None:
    one = only(measured([1, 2, 3], [0, 0, 1], ["wave"] * 2), measured([2, 2, 4], [0, 0, 1], ["wave"] * 2))
    assert one.a12 == pytest.approx((0 + 1 + 2) / 9)  # 1 beats none; 2 ties with two; 3 beats two
    values = rng(4).normal(size=8)
    first, second = measured(values[:4], [0, 0, 1, 1], ["wave"] * 2), measured(values[4:], [0, 0, 1, 1], ["wave"] * 2)
    wins = [
        abs(sum(values[i] > values[j] for i in chosen for j in set(range(8)) - set(chosen)) - 8)
        for chosen in combinations(range(8), 4)
    ]
    assert only(first, second).mann_whitney_p == pytest.approx(np.mean(np.array(wins) >= wins[0]))


def made_pair(n_trials: int, shift: float, actions: Sequence[str] = ("wave",), seed: int = 0) -> list[Measured]:
    generator = rng(seed)
    lengths = generator.integers(20, 60, n_trials)
    trial = np.repeat(np.arange(n_trials), lengths)
    of = [actions[i % len(actions)] for i in range(n_trials)]
    base = generator.gamma(2.0, size=n_trials)[trial] + generator.gamma(1.0, size=len(trial))
    return [measured(base + shift + 0.01 * generator.normal(size=len(trial)), trial, of), measured(base, trial, of)]


def test_differences_are_those_of_the_table() -> None:
    first, second = made_pair(7, 0.5, ("wave", "rocket"))
    result = compared(first, second)
    assert list(result) == ["wave", "rocket", POOLED]
    for a, b in zip(first.rows(), second.rows(), strict=True):
        assert result[a.action].difference == pytest.approx(a.mse_mean - b.mse_mean)
        assert (result[a.action].n_windows, result[a.action].n_trials) == (a.n_windows, a.n_trials)
    assert result[POOLED].difference == pytest.approx(first.mean - second.mean)
    assert result[POOLED].n_trials == 7
    for one in result.values():
        assert one.low <= one.difference <= one.high


def test_pairing_finds_what_windows_hide() -> None:
    """The trials differ by more than the models, which differ in every trial."""
    better = only(*made_pair(12, -0.05))
    assert better.sign_flip_p == pytest.approx(smallest_p(12)) and better.mann_whitney_p > 0.05
    assert better.high < 0


def test_windows_of_one_trial_are_no_evidence_for_trials() -> None:
    """No true difference, but trials that differ: the paper's test rejects far too often, the paired ones do not."""
    rejected = np.zeros(2)
    for seed in range(60):
        generator = rng(seed)
        trial = np.repeat(np.arange(8), 50)
        errors = [generator.normal(size=8)[trial] + 0.1 * generator.normal(size=400) for _ in range(2)]
        a, b = (measured(of, trial, ["wave"] * 8) for of in errors)
        window_p = significance.stats.mannwhitneyu(a.errors, b.errors).pvalue
        means = (a.errors - b.errors).reshape(8, 50).mean(1)
        rejected += np.array([window_p, sign_flip_p(means, rng())]) < 0.05
    assert rejected[0] > 30 and rejected[1] <= 8  # 5 % of 60 are 3


@pytest.mark.parametrize("sizes", [(12,), (4, 4, 4, 4)])
def test_the_interval_covers_the_truth_as_often_as_it_says(
    sizes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(significance, "N_RESAMPLES", 499)
    generator = rng(5)
    group = [f"action {i}" for i, size in enumerate(sizes) for _ in range(size)]
    n, covered, naive = len(group), 0, 0
    for _ in range(300):
        counts = generator.integers(50, 400, n)
        windows = [0.3 + generator.normal() + generator.normal(size=count) for count in counts]
        low, high = bootstrap_interval(np.array([of.sum() for of in windows]), counts, group, generator)
        covered += low <= 0.3 <= high
        pooled = np.concatenate(windows)
        naive += abs(pooled.mean() - 0.3) < 1.96 * pooled.std() / np.sqrt(len(pooled))
    assert 0.91 <= covered / 300 <= 0.99
    assert naive / 300 < 0.5  # what windows taken as independent would claim


def test_the_interval_resamples_whole_trials_within_their_action() -> None:
    sums, counts = np.array([10.0, 30.0]), np.array([10, 10])
    assert bootstrap_interval(sums, counts, ["wave"] * 2, rng()) == pytest.approx((1.0, 3.0))
    # Two actions far apart, each without spread: only resampling across them could widen the interval.
    apart = bootstrap_interval(np.array([10.0, 20.0, 500.0, 500.0]), np.array([10, 20, 10, 10]), list("aabb"), rng())
    assert apart == pytest.approx(((1.0 + 50.0) / 2,) * 2)
    assert np.isnan(bootstrap_interval(np.ones(3), np.ones(3, int), list("aab"), rng())).all()
    repeated = [bootstrap_interval(rng(1).normal(size=6), np.ones(6, int), ["a"] * 6, rng(2)) for _ in range(2)]
    assert repeated[0] == repeated[1]


def comparison(p: float, smallest: float = 1e-4, difference: float = -1.0) -> Comparison:
    return Comparison("a", "b", "wave", 12, 100, difference, -2.0, 0.0, 0.3, p, p, p, smallest)


def test_holm_by_hand() -> None:
    corrected = holm([comparison(p) for p in (0.01, 0.04, 0.03)])
    for test in ("mann_whitney", "sign_flip", "wilcoxon"):
        assert [getattr(one, f"{test}_p_holm") for one in corrected] == pytest.approx([0.03, 0.06, 0.06])
    assert [one.sign_flip_p_holm for one in holm([comparison(0.6), comparison(0.7)])] == [1.0, 1.0]
    # .005 x 4, .011 x 3, .03 x 2, and .04 x 1 is not let below the one before it; NaN is no test
    p = np.array([0.005, np.nan, 0.04, 0.011, 0.03])
    np.testing.assert_allclose(holm_p(p), [0.02, np.nan, 0.06, 0.033, 0.06])


def test_actions_and_their_pool_are_separate_families() -> None:
    pair = made_pair(12, -0.2, ("wave", "rocket"))
    one, two = (("a", pair[0]), ("b", pair[1])), (("b", pair[1]), ("a", pair[0]))
    result = compare([one, two])
    assert [c.action for c in result] == ["wave", "rocket", POOLED] * 2
    for c in result:
        family = 2 if c.action == POOLED else 4
        assert c.sign_flip_p_holm == pytest.approx(min(1.0, family * c.sign_flip_p))
        assert c.smallest_p_holm == pytest.approx(family * c.smallest_p)


def test_conclusions_say_what_can_be_said() -> None:
    assert only(*made_pair(3, -0.5)).conclusion == "too few trials"
    assert only(*made_pair(5, -0.5)).conclusion == "too few trials"  # p of 1/16 at best
    assert only(*made_pair(6, -0.5)).conclusion == "a is better"
    assert only(*made_pair(6, 0.5)).conclusion == "b is better"
    assert only(*made_pair(8, 0.0)).conclusion == "no difference shown"
    many = holm([comparison(0.03125, smallest=0.03125)] * 2)
    assert {one.conclusion for one in many} == {"too few for so many pairs"}


def test_a_prediction_that_is_no_number_shows() -> None:
    first, second = made_pair(6, -0.5)
    errors = first.errors.copy()
    errors[3] = np.nan
    good = compare([(("a", first), ("b", second))])
    broken = compare([(("c", measured(errors, first.trial, first.actions)), ("b", second))])
    assert {one.conclusion for one in broken} == {"a prediction is not a number"}
    assert all(np.isnan([one.sign_flip_p, one.mann_whitney_p_holm, one.low]).all() for one in broken)
    mixed = holm([good[0], broken[0]])
    assert mixed[0].sign_flip_p_holm == pytest.approx(good[0].sign_flip_p)  # a test that was not made does not count


def test_predictors_of_other_windows_are_not_compared() -> None:
    first, second = made_pair(6, 0.0)[0], made_pair(7, 0.0)[0]
    with pytest.raises(ValueError, match="not measured on the same windows"):
        compared(first, second)
