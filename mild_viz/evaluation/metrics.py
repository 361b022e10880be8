"""Prediction error by the paper's conventions (design.md, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz import pairs
from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation import buetepage
from mild_viz.evaluation.baselines import BASELINES, Examples
from mild_viz.evaluation.buetepage import Buetepage
from mild_viz.evaluation.paper import paper_rows
from mild_viz.pairs import Windows, stack_windows
from mild_viz.prediction import predict
from mild_viz.trial import Trial


@dataclass(frozen=True)
class Row:
    """One line of the table: a model's error on one action, pooled over all test windows."""

    dataset: str
    model: str
    action: str
    mse_mean: float
    mse_std: float
    n_windows: int | None
    """None for the paper's rows: it does not print them."""
    n_trials: int | None
    checkpoint: str | None = None
    """Which of several checkpoints holds the model; None where one was measured."""

    def as_dict(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if key != "checkpoint" or value is not None}


@dataclass(frozen=True, eq=False)
class Measured:
    """What a predictor did on test windows: rows, tests and files derive from this.

    Only windows with a gap are left out, so those that were measured on the same trials have the same windows,
    row by row. A prediction that is not a number shows as such.
    """

    dataset: str
    model: str
    errors: Float[np.ndarray, " R"]
    """Error of every window, as `window_errors` gives it."""
    trial: Int[np.ndarray, " R"]
    """Trial of every window, an index into `actions`."""
    actions: tuple[str, ...]
    """Action of every trial."""
    checkpoint: str | None = None

    def of_action(self, action: str) -> Bool[np.ndarray, " R"]:
        """Which windows belong to trials of this action."""
        return np.array([of == action for of in self.actions])[self.trial]

    @property
    def mean(self) -> float:
        """Mean over actions of their mean errors."""
        return float(np.mean([row.mse_mean for row in self.rows()]))

    def rows(self) -> list[Row]:
        """One line of the table an action."""
        rows = []
        for action in dict.fromkeys(self.actions):
            errors, n = self.errors[self.of_action(action)], sum(of == action for of in self.actions)
            mean, std = float(errors.mean()), float(errors.std())
            rows.append(Row(self.dataset, self.model, action, mean, std, len(errors), n, self.checkpoint))
        return rows


def window_errors(
    predicted: Float[np.ndarray, "R Y"], truth: Float[np.ndarray, "R Y"], human_human: bool
) -> Float[np.ndarray, " R"]:
    """Error of every window (`pairs.window_errors`): rad^2; or, between humans, m^2 x 100, what the paper calls cm."""
    return (100.0 if human_human else 1.0) * pairs.window_errors(predicted, truth, human_human)


Model = Checkpoint | Buetepage
"""What can be measured: a MILD checkpoint, or a baseline that is trained."""


def predict_windows(checkpoint: Model, variant: str, data: Windows) -> Float[np.ndarray, "R Y"]:
    """Partner windows that a model predicts from the human's, conditioned on the human-only forward variable."""
    if isinstance(checkpoint, Buetepage):
        return buetepage.predict_windows(checkpoint, data)
    predicted = np.empty_like(data.partner)
    for trial, action in enumerate(data.actions):
        rows = data.rows(trial)
        predicted[rows] = predict(checkpoint, variant, action, data.human[rows]).decoded
    return predicted


def _measured(dataset: str, model: str, data: Windows, predicted: np.ndarray, human_human: bool) -> Measured:
    complete = data.complete
    errors = window_errors(predicted[complete], data.partner[complete], human_human)
    return Measured(dataset, model, errors, data.trial[complete], data.actions)


def _examples(data: Windows, keep: Bool[np.ndarray, " R"]) -> Examples:
    return Examples(data.human[keep], data.partner[keep], data.step[keep], data.trial[keep])


def _complete(data: Windows, action: str) -> Bool[np.ndarray, " R"]:
    """The complete windows of an action; an error where there is none to fit or to measure."""
    keep = np.array([of == action for of in data.actions])[data.trial] & data.complete
    if not keep.any():
        raise UserError(f"no complete window of action '{action}' to fit or to measure; check the recordings")
    return keep


def measure_baselines(dataset: str, train: Windows, test: Windows, human_human: bool) -> list[Measured]:
    """The simple predictors, fitted on the training windows, on the test windows."""
    actions = tuple(dict.fromkeys(test.actions))
    fitted, measured = [_complete(train, action) for action in actions], [_complete(test, action) for action in actions]
    results = []
    for name, fit in BASELINES.items():
        predicted = np.full_like(test.partner, np.nan)
        for known, asked in zip(fitted, measured, strict=True):
            predicted[asked] = fit(_examples(train, known))(_examples(test, asked))
        results.append(_measured(dataset, name, test, predicted, human_human))
    return results


def measure_model(dataset: str, checkpoint: Model, data: Windows) -> list[Measured]:
    """Every variant of a checkpoint on windows of one dataset."""
    for action in dict.fromkeys(data.actions):
        _complete(data, action)
    return [
        _measured(dataset, variant, data, predict_windows(checkpoint, variant, data), checkpoint.robot is None)
        for variant in checkpoint.variants
    ]


def model_rows(checkpoint: Model, trials: Sequence[Trial]) -> list[Row]:
    """Every variant of a checkpoint on the given trials of one dataset."""
    data = stack_windows(trials, joint_names(checkpoint))
    return [row for measured in measure_model(trials[0].dataset, checkpoint, data) for row in measured.rows()]


def joint_names(checkpoint: Model) -> tuple[str, ...] | None:
    """The joints that a model predicts; None where it predicts the second human."""
    return checkpoint.robot.joint_names if checkpoint.robot else None


def published_rows(dataset: str, human_human: bool) -> list[Row]:
    """The paper's own figures for a dataset, as lines of the table."""
    return [
        Row(dataset, model, action, mean, std, None, None)
        for model, action, mean, std in paper_rows(dataset, human_human)
    ]
