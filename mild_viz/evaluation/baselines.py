"""Simple predictors to stand beside a model: fitted on the training split, per action, from the same windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree


@dataclass(frozen=True, eq=False)
class Examples:
    """Windows of one action: human window, elapsed step and the partner window that follows it."""

    human: Float[np.ndarray, "R X"]
    partner: Float[np.ndarray, "R Y"]
    step: Int[np.ndarray, " R"]
    trial: Int[np.ndarray, " R"]

    def where(self, keep: np.ndarray) -> Examples:
        return Examples(self.human[keep], self.partner[keep], self.step[keep], self.trial[keep])


T = TypeVar("T")
Predictor = Callable[[Examples], Float[np.ndarray, "R Y"]]


def fit_constant(train: Examples) -> Predictor:
    """The mean partner window of the action, always."""
    mean = train.partner.mean(0)
    return lambda test: np.broadcast_to(mean, (len(test.human), len(mean)))


def fit_time_indexed(train: Examples) -> Predictor:
    """The mean partner window at the same elapsed step; past the longest training trial, its last one."""
    n_steps = int(train.step.max()) + 1
    sums = np.zeros((n_steps, train.partner.shape[1]))
    np.add.at(sums, train.step, train.partner)
    counts = np.bincount(train.step, minlength=n_steps)
    last_known = np.maximum.accumulate(np.where(counts > 0, np.arange(n_steps), 0))
    means = (sums / np.maximum(counts, 1)[:, None])[last_known]
    return lambda test: means[np.minimum(test.step, n_steps - 1)]


def fit_ridge(train: Examples, strength: float) -> Predictor:
    """Linear regression with an L2 penalty of `strength` per row, on standardised human windows."""
    offset, scale = train.human.mean(0), np.maximum(train.human.std(0), 1e-9)
    mean = train.partner.mean(0)
    x = (train.human - offset) / scale
    gram = x.T @ x + strength * len(x) * np.eye(x.shape[1])
    coefficients = np.linalg.solve(gram, x.T @ (train.partner - mean))
    return lambda test: (test.human - offset) / scale @ coefficients + mean


def fit_nearest(train: Examples, neighbours: int) -> Predictor:
    """The mean partner window of the nearest human windows (k-nearest neighbours, Euclidean)."""
    tree = KDTree(train.human)
    k = min(neighbours, len(train.human))

    def predict(test: Examples) -> np.ndarray:
        _, indices = tree.query(test.human, k=k)
        return train.partner[np.asarray(indices).reshape(len(test.human), -1)].mean(1)

    return predict


def leave_one_trial_out(train: Examples, fit: Callable[[Examples], Predictor]) -> float:
    """Mean squared error over training trials, each predicted from the others."""
    total = 0.0
    trials = np.unique(train.trial)
    for trial in trials:
        held = train.where(train.trial == trial)
        rest = train.where(train.trial != trial)
        total += float(((fit(rest)(held) - held.partner) ** 2).mean())
    return total / len(trials)


def _chosen(train: Examples, fit: Callable[[Examples, T], Predictor], values: Sequence[T]) -> Predictor:
    """`fit` with the value that leave-one-trial-out likes best on the training trials."""
    if len(np.unique(train.trial)) < 2:
        return fit(train, values[len(values) // 2])
    scores = [leave_one_trial_out(train, lambda rest, value=value: fit(rest, value)) for value in values]
    return fit(train, values[int(np.argmin(scores))])


RIDGE_STRENGTHS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
NEIGHBOURS = (1, 5, 20, 60, 120)

BASELINES: dict[str, Callable[[Examples], Predictor]] = {
    "constant": fit_constant,
    "time-indexed": fit_time_indexed,
    "ridge": lambda train: _chosen(train, fit_ridge, RIDGE_STRENGTHS),
    "knn": lambda train: _chosen(train, lambda rest, k: fit_nearest(rest, k), NEIGHBOURS),
}
"""Name -> fit on training examples of one action. Strength and k are chosen on training trials only."""
