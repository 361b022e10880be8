"""Simple predictors to stand beside a model: fitted on the training split, per action, from the same windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int


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


def _squared_distances(test: Examples, train: Examples) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (test rows, train rows) between human windows, and between elapsed steps.

    The latter are scaled so that the steps of `train` spread as widely as its human windows do.
    """
    centre = train.human.mean(0)
    a, b = test.human - centre, train.human - centre
    human = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    scale = train.human.var(0).sum() / max(train.step.var(), 1e-9)
    return human, scale * (test.step[:, None] - train.step.astype(float)) ** 2


def _nearest(distances: Float[np.ndarray, "R N"], k: int) -> Int[np.ndarray, "R K"]:
    """Indices of the k smallest distances of every row, in ascending order."""
    k = min(k, distances.shape[1])
    smallest = np.argpartition(distances, k - 1, axis=1)[:, :k]
    order = np.take_along_axis(distances, smallest, axis=1).argsort(axis=1)
    return np.take_along_axis(smallest, order, axis=1)


def fit_nearest(train: Examples, neighbours: int, time_weight: float = 0.0) -> Predictor:
    """The mean partner window of the nearest human windows (k-nearest neighbours, Euclidean).

    With a `time_weight`, the elapsed step is one more coordinate: at 1 it counts as much as the whole window.
    """

    def predict(test: Examples) -> np.ndarray:
        predicted = np.empty((len(test.human), train.partner.shape[1]))
        for rows in np.array_split(np.arange(len(predicted)), len(predicted) // 256 + 1):  # bounds the memory
            human, time = _squared_distances(test.where(rows), train)
            nearest = _nearest(human + time_weight**2 * time, neighbours)
            predicted[rows] = train.partner[nearest].mean(1)
        return predicted

    return predict


def _fit_chosen_nearest(train: Examples, time_weights: Sequence[float]) -> Predictor:
    """`fit_nearest` with the k and time weight that leave-one-trial-out likes best on the training trials.

    Equal to trying every pair with `leave_one_trial_out`, but neighbours are searched once for all k.
    """
    trials = np.unique(train.trial)
    if len(trials) < 2:
        return fit_nearest(train, NEIGHBOURS[len(NEIGHBOURS) // 2], time_weights[len(time_weights) // 2])
    errors = np.zeros((len(time_weights), len(NEIGHBOURS)))
    for trial in trials:
        held, rest = train.where(train.trial == trial), train.where(train.trial != trial)
        human, time = _squared_distances(held, rest)
        for row, weight in zip(errors, time_weights, strict=True):
            sums = rest.partner[_nearest(human + weight**2 * time, NEIGHBOURS[-1])].cumsum(1)
            for column, k in enumerate(min(k, sums.shape[1]) for k in NEIGHBOURS):
                row[column] += ((sums[:, k - 1] / k - held.partner) ** 2).mean()
    weight, k = divmod(int(errors.argmin()), len(NEIGHBOURS))
    return fit_nearest(train, NEIGHBOURS[k], time_weights[weight])


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
TIME_WEIGHTS = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)

BASELINES: dict[str, Callable[[Examples], Predictor]] = {
    "constant": fit_constant,
    "time-indexed": fit_time_indexed,
    "ridge": lambda train: _chosen(train, fit_ridge, RIDGE_STRENGTHS),
    "knn": lambda train: _fit_chosen_nearest(train, (0.0,)),
    "knn-time": lambda train: _fit_chosen_nearest(train, TIME_WEIGHTS),
}
"""Name -> fit on training examples of one action. Strength, k and time weight are chosen on training trials only."""
