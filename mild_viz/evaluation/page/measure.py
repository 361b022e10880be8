"""Everything that the page shows, measured once: a `Result` for each variant, a `Group` for each kind of partner."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation import health
from mild_viz.evaluation.calibration import Calibration, calibration
from mild_viz.evaluation.distances import ContactDistance, HandError, contact_distance, hand_error
from mild_viz.evaluation.metrics import Row, joint_names
from mild_viz.evaluation.passes import Pass, run_passes
from mild_viz.evaluation.report import Evaluation, measure
from mild_viz.evaluation.segmentation import PhaseFit, Segmentation, phase_fit, segmentation
from mild_viz.pairs import stack_windows
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.settings import VARIANTS
from mild_viz.trial import Dataset

SEED = 0
"""Of the samples that the energy scores are taken on."""

CURVES = ("constant", "ridge")
"""Baselines whose error is drawn over time, beside the best variant's."""


@dataclass(frozen=True, eq=False)
class Result:
    """One variant of one checkpoint on the test trials. Mappings are by action."""

    label: str
    """The variant, and of several checkpoints which one."""
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
class Group:
    """Checkpoints that predict the same partner, and can stand in one table."""

    evaluation: Evaluation
    rows: Mapping[str, Mapping[str, Row]]
    """By label and action: variants, baselines, the paper's."""
    models: Sequence[Result]
    baselines: Mapping[str, Mapping[str, Sequence[np.ndarray]]]
    """Of each of `CURVES`, per action: the errors of every test trial's windows; NaN where incomplete."""
    notes: Sequence[str]
    """What could not be measured, and why."""

    @property
    def actions(self) -> tuple[str, ...]:
        """Those of the test trials."""
        return tuple(self.models[0].passes)

    @property
    def human_human(self) -> bool:
        return self.models[0].checkpoint.robot is None

    @property
    def best(self) -> Result:
        """The variant with the smallest mean error over actions."""
        return min(self.models, key=lambda model: self.mean_error(model.label))

    def mean_error(self, label: str) -> float:
        """Mean over actions of a row's error."""
        return float(np.mean([row.mse_mean for row in self.rows[label].values()]))


def measure_groups(
    checkpoints: Sequence[Checkpoint], dataset: Dataset, advance: Callable[[str], object] = lambda label: None
) -> list[Group]:
    """Measure all variants of all checkpoints; one group for each kind of partner that they predict.

    `advance` is called with each variant's label when it is measured.

    Raises:
        UserError: where the dataset does not fit a checkpoint.
    """
    groups: dict[tuple[str, ...] | None, list[Checkpoint]] = {}
    for checkpoint in checkpoints:
        if missing := [action for action in dataset.actions if action not in checkpoint.actions]:
            raise UserError(
                f"checkpoint {checkpoint.name} does not know {', '.join(missing)} of {dataset.name}; "
                f"it knows: {', '.join(checkpoint.actions)}"
            )
        groups.setdefault(joint_names(checkpoint), []).append(checkpoint)
    return [_measure_group(group, dataset, advance) for group in groups.values()]


def _measure_group(group: Sequence[Checkpoint], dataset: Dataset, advance: Callable[[str], object]) -> Group:
    names = [checkpoint.name for checkpoint in group]
    if len(set(names)) < len(names):
        names = [str(checkpoint.path) for checkpoint in group]
    evaluation = measure(dict(zip(names, group, strict=True)), dataset)
    rows: dict[str, dict[str, Row]] = {}
    for row in evaluation.rows:
        rows.setdefault(_label(row.model, row.checkpoint), {})[row.action] = row
    models, notes = [], []
    for name, checkpoint in zip(names, group, strict=True):
        robot = None
        if checkpoint.robot is not None:
            try:
                robot = load_robot(checkpoint.robot.name, checkpoint.robot.joint_names, checkpoint.robot.end_effector)
            except UserError as error:
                notes.append(f"{checkpoint.name}: no distances in metres. {error}")
        for variant in checkpoint.variants:
            label = _label(variant, name if len(names) > 1 else None)
            models.append(_measure_variant(label, checkpoint, variant, dataset, robot, rows))
            advance(label)
    return Group(evaluation, rows, models, _baseline_errors(evaluation, joint_names(group[0])), notes)


def _label(model: str, checkpoint: str | None) -> str:
    return model if checkpoint is None else f"{model}@{checkpoint}"


def _measure_variant(
    label: str,
    checkpoint: Checkpoint,
    variant: str,
    dataset: Dataset,
    robot: RobotModel | None,
    rows: Mapping[str, Mapping[str, Row]],
) -> Result:
    passes = _by_action(run_passes(checkpoint, variant, dataset.test))
    training = _by_action(run_passes(checkpoint, variant, dataset.train))
    rng = np.random.default_rng(SEED)
    measured = {action: calibration(some, rng) for action, some in passes.items()}
    used = {action: segmentation(some) for action, some in passes.items()}
    own = variant in VARIANTS and VARIANTS[variant].own_models
    floor = dict(checkpoint.training.get("options") or {}).get("joint_floor" if own else "covariance_floor")
    warnings: list[health.Warning] = []
    for action, one in measured.items():
        if checkpoint.dataset == dataset.name and action in training:
            warnings += health.dead_states(label, segmentation(training[action]))
        warnings += health.collapsed_covariances(label, action, passes[action][0].hmm, floor)
        warnings += health.idle_alpha(label, used[action])
        warnings += health.misaligned(label, used[action])
        warnings += health.overconfident(label, action, one) if one else []
        if checkpoint.robot is not None:
            warnings += health.without_contact_state(label, action, checkpoint.contact_states_of(variant, action))
        error, constant = rows[label][action].mse_mean, rows["constant"][action].mse_mean
        warnings += health.worse_than_constant(label, action, error, constant)
    can_measure = checkpoint.robot is None or robot is not None
    return Result(
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


def _baseline_errors(evaluation: Evaluation, joints: tuple[str, ...] | None) -> dict[str, dict[str, list[np.ndarray]]]:
    """Put the errors of complete windows back to where in time they belong."""
    test = stack_windows(evaluation.dataset.test, joints)
    result: dict[str, dict[str, list[np.ndarray]]] = {}
    for measured in evaluation.measured:
        if measured.model in CURVES:
            errors = np.full(len(test.step), np.nan)
            errors[test.complete] = measured.errors
            for trial, action in enumerate(test.actions):
                result.setdefault(measured.model, {}).setdefault(action, []).append(errors[test.rows(trial)])
    return result
