"""Prediction error by the paper's conventions (design.md, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation.baselines import BASELINES, Examples
from mild_viz.evaluation.paper import paper_rows
from mild_viz.pairs import Windows, stack_windows
from mild_viz.prediction import predict
from mild_viz.settings import WINDOW
from mild_viz.trial import Dataset, Trial


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

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def window_errors(
    predicted: Float[np.ndarray, "R Y"], truth: Float[np.ndarray, "R Y"], human_human: bool
) -> Float[np.ndarray, " R"]:
    """Error of every window: rad^2 averaged over joints and frames; or, between humans, m^2 x 100.

    Between humans the squared error is summed over xyz and averaged over 3 positions and 3 velocities of
    5 frames, times 100: what the paper calls cm.
    """
    squared = (predicted - truth) ** 2
    if human_human:
        return 100.0 * squared.reshape(len(squared), WINDOW * 6, 3).sum(2).mean(1)
    return squared.mean(1)


def predict_windows(checkpoint: Checkpoint, variant: str, data: Windows) -> Float[np.ndarray, "R Y"]:
    """Partner windows that a model predicts from the human's, conditioned on the human-only forward variable."""
    predicted = np.empty_like(data.partner)
    for trial, action in enumerate(data.actions):
        rows = data.rows(trial)
        predicted[rows] = predict(checkpoint, variant, action, data.human[rows]).decoded
    return predicted


def _summaries(dataset: str, model: str, data: Windows, predicted: np.ndarray, human_human: bool) -> list[Row]:
    errors = window_errors(predicted, data.partner, human_human)
    complete = data.complete
    rows = []
    for action in dict.fromkeys(data.actions):
        trials = [trial for trial, of in enumerate(data.actions) if of == action]
        # Only windows with a gap are left out: a prediction that is not a number must show.
        pooled = np.concatenate([errors[data.rows(trial)][complete[data.rows(trial)]] for trial in trials])
        if not len(pooled):
            raise UserError(f"{dataset}: no complete window of action '{action}' to measure; check the recordings")
        rows.append(Row(dataset, model, action, float(pooled.mean()), float(pooled.std()), len(pooled), len(trials)))
    return rows


def _examples(data: Windows, action: str) -> Examples:
    of_action = np.array([of == action for of in data.actions])[data.trial]
    keep = of_action & data.complete
    if not keep.any():
        raise UserError(f"no complete window of action '{action}' to fit or to measure; check the recordings")
    return Examples(data.human[keep], data.partner[keep], data.step[keep], data.trial[keep])


def baseline_rows(dataset: str, train: Windows, test: Windows, human_human: bool) -> list[Row]:
    """The simple predictors, fitted on the training windows and measured on the test windows."""
    rows = []
    for name, fit in BASELINES.items():
        for action in dict.fromkeys(test.actions):
            predictor = fit(_examples(train, action))
            examples = _examples(test, action)
            errors = window_errors(predictor(examples), examples.partner, human_human)
            n_trials = sum(of == action for of in test.actions)
            rows.append(Row(dataset, name, action, float(errors.mean()), float(errors.std()), len(errors), n_trials))
    return rows


def model_rows(checkpoint: Checkpoint, trials: Sequence[Trial]) -> list[Row]:
    """Every variant of a checkpoint on the given trials of one dataset."""
    human_human = checkpoint.robot is None
    data = stack_windows(trials, checkpoint.robot.joint_names if checkpoint.robot else None)
    rows = []
    for variant in checkpoint.variants:
        predicted = predict_windows(checkpoint, variant, data)
        rows += _summaries(trials[0].dataset, variant, data, predicted, human_human)
    return rows


def evaluation_rows(checkpoint: Checkpoint, dataset: Dataset) -> list[Row]:
    """The whole table of one checkpoint on a dataset's test split: variants, baselines, the paper's rows."""
    human_human = checkpoint.robot is None
    joints = checkpoint.robot.joint_names if checkpoint.robot else None
    train, test = stack_windows(dataset.train, joints), stack_windows(dataset.test, joints)
    return [
        *model_rows(checkpoint, dataset.test),
        *baseline_rows(dataset.name, train, test, human_human),
        *(
            Row(dataset.name, model, action, mean, std, None, None)
            for model, action, mean, std in paper_rows(dataset.name, human_human)
        ),
    ]
