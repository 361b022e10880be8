"""From the candidates of a run to the checkpoint that is kept: choice of the seed, contact, figures, README."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from mild_viz.checkpoint import Checkpoint, save_checkpoint
from mild_viz.data.windows import fill_gaps, human_windows, max_gap
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import Row, model_rows
from mild_viz.latent.interaction import InteractionModel
from mild_viz.pairs import stack_windows
from mild_viz.pipeline import NEWEST
from mild_viz.prediction import predict
from mild_viz.robot.contact import contact_frames, suggest_contact_states
from mild_viz.robot.model import load_robot
from mild_viz.robot.placement import estimate_meeting, estimate_placement
from mild_viz.robot.workspace import measure_workspace
from mild_viz.settings import VARIANTS, WINDOW
from mild_viz.training.transition import learn_transition_states
from mild_viz.trial import HAND_POINTS, Trial

if TYPE_CHECKING:
    from mild_viz.training.run import Plan


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one seed of a run leaves."""

    checkpoint: Checkpoint
    fitted: InteractionModel
    """The human stage's own two VAEs: what the shared HMMs were fitted to."""


@dataclass(frozen=True)
class Made:
    """How a model was made, for its record."""

    command: str
    run: Mapping[str, Any]
    seconds: float


def mean_error(rows: Sequence[Row], variant: str) -> float:
    """A variant's error, averaged over actions."""
    return float(np.mean([row.mse_mean for row in rows if row.model == variant]))


def mean_errors(rows: Sequence[Row]) -> dict[str, float]:
    """Every variant's error, averaged over actions."""
    return {model: mean_error(rows, model) for model in dict.fromkeys(row.model for row in rows)}


def choose_seed(scores: Sequence[Mapping[str, float]]) -> int:
    """The candidate with the lowest error on held-out trials; the first where nothing was held out.

    Averaged over the variants with conditional training: they are what a robot runs, and v1's error, an order
    larger, would decide alone.
    """
    if not scores or not scores[0]:
        return 0
    deciding = [name for name in scores[0] if VARIANTS[name].conditional_training != "none"] or list(scores[0])
    means = np.array([np.mean([score[name] for name in deciding]) for score in scores])
    if np.isnan(means).all():
        raise UserError("every seed diverged: no prediction on the held-out trials is a number; try another --seed")
    return int(np.nanargmin(means))


def save_best(candidates: Sequence[Candidate], plan: Plan, made: Made, out: Path) -> Checkpoint:
    """Choose among the candidates on held-out trials, measure, learn what contact is, and write the folder."""
    held = [_held_out_rows(candidate.checkpoint, plan) for candidate in candidates] if plan.held else []
    scores = [mean_errors(rows) for rows in held]
    best = choose_seed(scores)
    chosen = candidates[best].checkpoint
    training = {
        **asdict(made),
        "seed": plan.options.seed,
        "chosen": best,
        "fitted_trials": len(plan.fit),
        "held_out_trials": [trial.name for trial in plan.held],
        "options": asdict(plan.options),
    }
    # The test split is read here for the first time, for the record only.
    test = [model_rows(candidate.checkpoint, _known(plan.source.test, chosen)) for candidate in candidates]
    metrics = {
        "held_out": scores,
        "held_out_rows": [row.as_dict() for row in held[best]] if held else [],
        "test": [row.as_dict() for row in test[best]],
        "test_seeds": [[row.as_dict() for row in rows] for rows in test],
    }
    chosen = replace(chosen, training=training, metrics=metrics)
    chosen = _with_contact(chosen, candidates[best].fitted, plan)
    return save_checkpoint(chosen, out, readme(chosen, plan.source.title, out))


def _known(trials: Sequence[Trial], checkpoint: Checkpoint) -> list[Trial]:
    return [trial for trial in trials if trial.action in checkpoint.actions]


def _held_out_rows(checkpoint: Checkpoint, plan: Plan) -> list[Row]:
    """Errors on held-out trials, of the variants that have not seen them."""
    rows = model_rows(checkpoint, plan.held)
    return [row for row in rows if plan.options.joint_held_out or not VARIANTS[row.model].own_models]


def _with_contact(checkpoint: Checkpoint, fitted: InteractionModel, plan: Plan) -> Checkpoint:
    """The model with its contact states, transition states and placement, learnt from the training trials."""
    shared = plan.shared_variants
    states = {} if not shared else contact_states(checkpoint, shared[0], plan.fit)
    partner = None if fitted.robot_vae is fitted.human_vae else plan.joints
    learnt = {} if not states else learn_transition_states(fitted, states, stack_windows(plan.fit, partner))
    own_states, own_models = {}, {}
    for variant, models in checkpoint.own_models.items():
        own_states[variant] = contact_states(checkpoint, variant, plan.fit)
        own = learn_transition_states(models[0], own_states[variant], stack_windows(plan.fit, plan.joints))
        own_models[variant] = (replace(models[0], transition_states=own), *models[1:])
    checkpoint = replace(
        checkpoint,
        contact_states=states,
        transition_states=learnt,
        own_models=own_models,
        own_contact_states=own_states,
    )
    if checkpoint.points == HAND_POINTS:
        checkpoint = replace(checkpoint, workspace=measure_workspace(plan.source.train))
    touching = [trial for trial in plan.source.train if contact_frames(trial).any()]
    if not touching:
        return checkpoint
    if checkpoint.robot is None:
        return replace(checkpoint, meeting=estimate_meeting(touching))
    return replace(checkpoint, placement=estimate_placement(load_robot(checkpoint.robot.name).chain, touching)[0])


def contact_states(checkpoint: Checkpoint, variant: str, trials: Sequence[Trial]) -> dict[str, frozenset[int]]:
    """Per action, the states in which the partners of the training trials touch: a start for a person's choice."""
    result = {}
    for action in checkpoint.actions:
        of_action = [trial for trial in trials if trial.action == action]
        active = [_active_states(checkpoint, variant, trial) for trial in of_action]
        touching = [
            contact_frames(trial)[NEWEST : NEWEST + len(states)]
            for trial, states in zip(of_action, active, strict=True)
        ]
        result[action] = suggest_contact_states(active, touching, checkpoint.n_states)
    return result


def _active_states(checkpoint: Checkpoint, variant: str, trial: Trial) -> Int[np.ndarray, " N"]:
    """The active state of every window, as `pipeline.infer` gives it for any robot."""
    windows = human_windows(fill_gaps(trial.human_points, max_gap(trial.rate)))[:-WINDOW]
    return predict(checkpoint, variant, trial.action, windows).log_alpha.argmax(1)


def readme(checkpoint: Checkpoint, title: str, path: Path) -> str:
    """What a person reads in the checkpoint's folder."""
    training, metrics = checkpoint.training, checkpoint.metrics
    held, scores = training["held_out_trials"], metrics["held_out"]
    unit = "rad²" if checkpoint.robot is not None else "m² × 100, the paper's 'cm'"
    fitted = f"{training['fitted_trials']} trials fitted"
    if any(scores):
        fitted += (
            f"; of {len(scores)} seeds, seed {training['chosen']} was chosen on {len(held)} held-out training trials"
        )
    lines = [
        f"# {checkpoint.name}",
        "",
        f"Trained on {title}, by:",
        "",
        f"    {training['command']}",
        "",
        f"Dataset `{checkpoint.dataset}`, SHA-256 `{checkpoint.dataset_checksum}`. {fitted}.",
    ]
    if checkpoint.own_models and not training["options"]["joint_held_out"]:
        lines += ["v4 is fitted to the held-out trials, too, and not chosen among the seeds."]
    lines += [
        "",
        f"Test split, read once after that: mean squared error [{unit}] of the model kept, and over the seeds:",
    ]
    lines += ["", f"    mild-viz evaluate --checkpoint {path} --dataset {checkpoint.dataset}", ""]
    lines += ["| model | " + " | ".join(checkpoint.actions) + " | mean | median of seeds | best of seeds |"]
    lines += ["|---|" + "---|" * (len(checkpoint.actions) + 3)]
    for model in dict.fromkeys(row["model"] for row in metrics["test"]):
        kept = [row["mse_mean"] for row in metrics["test"] if row["model"] == model]
        means = [np.mean([row["mse_mean"] for row in rows if row["model"] == model]) for rows in metrics["test_seeds"]]
        values = [*kept, np.mean(kept), np.median(means), np.min(means)]
        lines.append(f"| {model} | " + " | ".join(f"{value:.4f}" for value in values) + " |")
    if scores:
        lines += ["", "Held-out error of every seed (mean over actions):", ""]
        lines += [f"- seed {i}: " + ", ".join(f"{k} {v:.4f}" for k, v in s.items()) for i, s in enumerate(scores)]
    return "\n".join(lines) + "\n"
