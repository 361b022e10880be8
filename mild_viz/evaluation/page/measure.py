"""Everything that the page shows, measured once: one `Measured` a variant, one `Comparison` a kind of partner."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation import health
from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.calibration import Calibration, calibration
from mild_viz.evaluation.distances import ContactDistance, HandError, contact_distance, hand_error
from mild_viz.evaluation.metrics import Row, evaluation_rows, examples_of, model_rows, window_errors
from mild_viz.evaluation.passes import Pass, run_passes, variants_of
from mild_viz.evaluation.segmentation import PhaseFit, Segmentation, phase_fit, segmentation
from mild_viz.pairs import stack_windows
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.trial import Dataset

SEED = 0
"""Of the samples that the energy scores are taken on."""

CURVES = ("constant", "ridge")
"""Baselines whose error is drawn over time, beside the best model's."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One variant of one checkpoint on the test trials. Mappings are by action."""

    label: str
    """The variant, with the checkpoint's name where there are several."""
    checkpoint: Checkpoint
    variant: str
    passes: Mapping[str, Sequence[Pass]]
    segmentation: Mapping[str, Segmentation]
    phases: Mapping[str, PhaseFit | None]
    calibration: Mapping[str, Calibration | None]
    hands: Mapping[str, HandError | None]
    contact: Mapping[str, ContactDistance | None]
    warnings: Sequence[health.Warning]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Checkpoints that predict the same partner, and can stand in one table."""

    human_human: bool
    actions: tuple[str, ...]
    rows: Sequence[Row]
    models: Sequence[Measured]
    baselines: Mapping[str, Mapping[str, Sequence[np.ndarray]]]
    """Of each of `CURVES`, per action: the errors of every test trial's windows; NaN where incomplete."""
    notes: Sequence[str]
    """What could not be measured, and why."""

    @property
    def best(self) -> Measured:
        """The variant with the smallest mean error over actions."""
        return min(self.models, key=lambda model: self.mean_error(model.label))

    def mean_error(self, label: str) -> float:
        """Mean over actions of a row's error."""
        return float(np.mean([row.mse_mean for row in self.rows if row.model == label]))


def compare(
    checkpoints: Sequence[Checkpoint], dataset: Dataset, advance: Callable[[str], object] = lambda label: None
) -> list[Comparison]:
    """Measure all variants of all checkpoints; one comparison for each kind of partner that they predict.

    `advance` is called with each model's label when it is measured.

    Raises:
        UserError: where the dataset does not fit a checkpoint.
    """
    groups: dict[tuple[str, ...] | None, list[Checkpoint]] = {}
    for checkpoint in checkpoints:
        groups.setdefault(checkpoint.robot.joint_names if checkpoint.robot else None, []).append(checkpoint)
    return [
        _comparison(list(zip(_checkpoint_labels(group), group, strict=True)), dataset, advance)
        for group in groups.values()
    ]


def _checkpoint_labels(checkpoints: Sequence[Checkpoint]) -> list[str]:
    """What stands before a variant: nothing for one checkpoint, names where they differ, else folders."""
    if len(checkpoints) == 1:
        return [""]
    names = [checkpoint.name for checkpoint in checkpoints]
    distinct = names if len(set(names)) == len(names) else [str(checkpoint.path) for checkpoint in checkpoints]
    return [f"{name} " for name in distinct]


def _comparison(
    group: Sequence[tuple[str, Checkpoint]], dataset: Dataset, advance: Callable[[str], object]
) -> Comparison:
    first = group[0][1]
    human_human = first.robot is None
    rows: dict[tuple[str, str], Row] = {}
    for prefix, checkpoint in group:
        # Baselines and the paper's rows are the same for all of a group.
        own = evaluation_rows(checkpoint, dataset) if checkpoint is first else model_rows(checkpoint, dataset.test)
        for row in own:
            model = f"{prefix}{row.model}" if row.model in variants_of(checkpoint) else row.model
            rows[model, row.action] = Row(**{**row.as_dict(), "model": model})
    models, notes = [], []
    for prefix, checkpoint in group:
        robot = None
        if checkpoint.robot is not None:
            try:
                robot = load_robot(checkpoint.robot.name, checkpoint.robot.joint_names, checkpoint.robot.end_effector)
            except UserError as error:
                notes.append(f"{checkpoint.name}: no distances in metres, since the {error}")
        for variant in variants_of(checkpoint):
            label = f"{prefix}{variant}"
            models.append(_measure(label, checkpoint, variant, dataset, robot, rows))
            advance(label)
    actions = tuple(dict.fromkeys(trial.action for trial in dataset.test))
    # Models first, in the order given, as in the table of `mild-viz evaluate`.
    labels = {model.label: None for model in models} | {row.model: None for row in rows.values()}
    ordered = [rows[label, action] for label in labels for action in actions if (label, action) in rows]
    return Comparison(human_human, actions, ordered, models, _baseline_errors(first, dataset), notes)


def _measure(
    label: str,
    checkpoint: Checkpoint,
    variant: str,
    dataset: Dataset,
    robot: RobotModel | None,
    rows: Mapping[tuple[str, str], Row],
) -> Measured:
    passes = _by_action(run_passes(checkpoint, variant, dataset.test))
    training = _by_action(run_passes(checkpoint, variant, dataset.train)) if dataset.train else {}
    rng = np.random.default_rng(SEED)
    measured = {action: calibration(some, rng) for action, some in passes.items()}
    used = {action: segmentation(some) for action, some in passes.items()}
    floor = dict(checkpoint.training.get("options") or {}).get("covariance_floor")
    warnings: list[health.Warning] = []
    for action, one in measured.items():
        if checkpoint.dataset == dataset.name and action in training:
            warnings += health.dead_states(label, segmentation(training[action]))
        warnings += health.collapsed_covariances(label, action, passes[action][0].hmm, floor)
        warnings += health.idle_alpha(label, used[action])
        warnings += health.misaligned(label, used[action])
        warnings += health.overconfident(label, action, one) if one else []
        if checkpoint.robot is not None:
            contact_states = checkpoint.contact_states.get(action, frozenset())
            warnings += health.without_contact_state(label, action, contact_states)
        error, constant = rows[label, action].mse_mean, rows["constant", action].mse_mean
        warnings += health.worse_than_constant(label, action, error, constant)
    can_measure = checkpoint.robot is None or robot is not None
    return Measured(
        label=label,
        checkpoint=checkpoint,
        variant=variant,
        passes=passes,
        segmentation=used,
        phases={action: phase_fit(training.get(action, []), some) for action, some in passes.items()},
        calibration=measured,
        hands={action: hand_error(some, robot) if can_measure else None for action, some in passes.items()},
        contact={
            action: contact_distance(checkpoint, robot, variant, [one.trial for one in some]) if robot else None
            for action, some in passes.items()
        },
        warnings=warnings,
    )


def _by_action(passes: Sequence[Pass]) -> dict[str, list[Pass]]:
    result: dict[str, list[Pass]] = {}
    for one in passes:
        result.setdefault(one.trial.action, []).append(one)
    return result


def _baseline_errors(checkpoint: Checkpoint, dataset: Dataset) -> dict[str, dict[str, list[np.ndarray]]]:
    joints = checkpoint.robot.joint_names if checkpoint.robot else None
    train, test = stack_windows(dataset.train, joints), stack_windows(dataset.test, joints)
    result: dict[str, dict[str, list[np.ndarray]]] = {}
    for name in CURVES:
        errors = np.full(len(test.step), np.nan)
        for action in dict.fromkeys(test.actions):
            of_action = np.array([of == action for of in test.actions])[test.trial] & test.complete
            shown = examples_of(test, action)
            predicted = BASELINES[name](examples_of(train, action))(shown)
            errors[of_action] = window_errors(predicted, shown.partner, checkpoint.robot is None)
        result[name] = {}
        for trial, action in enumerate(test.actions):
            result[name].setdefault(action, []).append(errors[test.rows(trial)])
    return result
