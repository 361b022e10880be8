"""One training run from recordings to a checkpoint folder: what `mild-viz train` does."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mild_viz.checkpoint import Checkpoint, RobotInterface, check_checkpoint_target, save_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import Row, model_rows
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows, stack_windows
from mild_viz.pipeline import NEWEST, infer
from mild_viz.robot.contact import contact_frames, suggest_contact_states
from mild_viz.robot.model import load_robot
from mild_viz.robot.placement import estimate_placement
from mild_viz.robot.robots import ROBOTS
from mild_viz.settings import VARIANTS, Placement, choose
from mild_viz.training.human_stage import complete_rows, train_human_stage
from mild_viz.training.options import TrainingOptions
from mild_viz.training.robot_stage import train_robot_stage
from mild_viz.training.state import RunState
from mild_viz.training.transition import learn_transition_states
from mild_viz.trial import Dataset, Trial

ROBOT = "pepper"
"""The robot that models are trained for: the one whose joints can be retargeted from a second human."""


def hold_out(trials: Sequence[Trial], n_held: int) -> tuple[list[Trial], list[Trial]]:
    """Split training trials into those to fit and the last `n_held` of every action, to choose a seed by.

    An action with fewer than three trials keeps all of them.
    """
    held: set[int] = set()
    for action in dict.fromkeys(trial.action for trial in trials):
        of_action = [i for i, trial in enumerate(trials) if trial.action == action]
        if n_held and len(of_action) >= n_held + 2:
            held.update(of_action[-n_held:])
    fit = [trial for i, trial in enumerate(trials) if i not in held]
    return fit, [trials[i] for i in sorted(held)]


def mean_error(rows: Sequence[Row], variant: str) -> float:
    """A variant's error, averaged over actions."""
    return float(np.mean([row.mse_mean for row in rows if row.model == variant]))


def choose_seed(candidates: Sequence[Checkpoint], held: Sequence[Trial]) -> tuple[int, list[dict[str, float]]]:
    """The candidate with the lowest error on held-out trials, and every candidate's errors by variant.

    Averaged over the variants with conditional training: they are what a robot runs, and v1's error, an order
    larger, would decide alone.
    """
    if not held:
        return 0, []
    scores = []
    for candidate in candidates:
        rows = model_rows(candidate, held)
        scores.append({model: mean_error(rows, model) for model in dict.fromkeys(row.model for row in rows)})
    deciding = [name for name in scores[0] if VARIANTS[name].conditional_training != "none"] or list(scores[0])
    means = np.array([np.mean([score[name] for name in deciding]) for score in scores])
    if np.isnan(means).all():
        raise UserError("every seed diverged: no prediction on the held-out trials is a number; try another --seed")
    return int(np.nanargmin(means)), scores


def train(
    dataset: str,
    stage: str = "hri",
    variants: Sequence[str] = tuple(VARIANTS),
    seeds: int = 4,
    epochs: int | None = None,
    out: Path = Path("runs/model"),
    resume: bool | None = False,
    seed: int = 0,
    state_model: str = "hmm",
    options: TrainingOptions | None = None,
    command: str | None = None,
    quiet: bool = False,
) -> Checkpoint:
    """Train a model and write its folder; the stages' state lives beside it until the folder is written.

    `options` stands for `seeds`, `epochs` and `seed` where a config gives them all, and `command` is then what is
    recorded as having made the model. `resume` None: go on if there is something to go on with. `quiet`: no progress
    bars, no word on Ctrl-C.

    Raises:
        UserError: on an unknown dataset, stage, variant or state model, a dataset without a second human, a run that
            cannot be resumed, or a folder that holds something else.
    """
    choose("stage", stage, ("hhi", "hri"))
    variants = tuple(dict.fromkeys(choose("variant", name, list(VARIANTS)) for name in variants))
    if not variants:
        raise UserError(f"no variant is given; valid: {', '.join(VARIANTS)}")
    if options is None:
        options = TrainingOptions(seeds=seeds, seed=seed)
        if epochs is not None:
            options = replace(options, human_epochs=epochs, robot_epochs=epochs)
    if command is None:
        words = ["mild-viz", "train", "--dataset", dataset, "--stage", stage, "--variant", *variants]
        words += ["--seeds", str(seeds), *(["--epochs", str(epochs)] if epochs is not None else [])]
        words += ["--seed", str(seed)] if seed else []
        command = shlex.join([*words, "--out", str(out)])
    check_checkpoint_target(out)
    source = load_dataset(dataset)
    fit, held = hold_out(source.train, options.held_out)
    human_data = training_windows(fit, None)
    robot_data = training_windows(fit, ROBOTS[ROBOT].joint_names) if stage == "hri" else None
    description = {"dataset": dataset, "checksum": source.checksum, "stage": stage, "variants": list(variants)}
    started = time.monotonic()
    try:
        with RunState(out, description, options, resume) as state:
            candidates = _train_stages(source, human_data, robot_data, variants, options, state, out, quiet)
            made = {"command": command, "run": description, "seconds": round(time.monotonic() - started, 1)}
            saved = _save_best(candidates, source, fit, held, options, made, out)
            state.finish()
            return saved
    except KeyboardInterrupt:
        if not quiet:
            print(f"interrupted; what is done is kept. Go on with:\n  {command} --resume", file=sys.stderr)
        raise


def _save_best(
    candidates: Sequence[Checkpoint],
    source: Dataset,
    fit: Sequence[Trial],
    held: Sequence[Trial],
    options: TrainingOptions,
    made: Mapping[str, Any],
    out: Path,
) -> Checkpoint:
    """Choose among the candidates on held-out trials, measure the one chosen, and write its folder."""
    best, scores = choose_seed(candidates, held)
    chosen = candidates[best]
    training = {
        **made,
        "seed": options.seed,
        "chosen": best,
        "fitted_trials": len(source.train) - len(held),
        "held_out_trials": [trial.name for trial in held],
        "options": asdict(options),
    }
    # The test split is read here for the first time, for the record only.
    test = model_rows(chosen, [trial for trial in source.test if trial.action in chosen.actions])
    held_out = model_rows(chosen, held) if held else []
    metrics = {
        "held_out": scores,
        "held_out_rows": [row.as_dict() for row in held_out],
        "test": [row.as_dict() for row in test],
    }
    chosen = replace(chosen, training=training, metrics=metrics)
    if chosen.robot is not None:
        contact = contact_states(chosen, fit)
        # the HMMs were fitted to the human VAE's latents of both people
        fitted = InteractionModel(chosen.human_vae, chosen.hmms, chosen.human_vae)
        chosen = replace(
            chosen,
            contact_states=contact,
            transition_states=learn_transition_states(fitted, contact, human_data),
            placement=contact_placement(source.train),
        )
    return save_checkpoint(chosen, out, _readme(chosen, source, scores, best))


def training_windows(trials: Sequence[Trial], joint_names: Sequence[str] | None) -> Windows:
    """The training windows; an error says which action has none that is complete, before anything is trained."""
    data = stack_windows(trials, joint_names)
    whole = set(complete_rows(data).trial.tolist())
    for action in dict.fromkeys(data.actions):
        if not any(of == action and trial in whole for trial, of in enumerate(data.actions)):
            raise UserError(f"action '{action}' has no complete window in the training trials; check the recordings")
    return data


def contact_placement(trials: Sequence[Trial]) -> Placement | None:
    """Where the human stands by the contact in the training trials; None where they show none."""
    touching = [trial for trial in trials if contact_frames(trial).any()]
    return estimate_placement(load_robot(ROBOT).chain, touching)[0] if touching else None


def contact_states(checkpoint: Checkpoint, trials: Sequence[Trial]) -> dict[str, frozenset[int]]:
    """Per action, the states in which the partners of the training trials touch: a start for a person's choice."""
    result = {}
    for action in checkpoint.actions:
        of_action = [trial for trial in trials if trial.action == action]
        active = [infer(checkpoint, trial, checkpoint.variants[0]).active_state for trial in of_action]
        touching = [
            contact_frames(trial)[NEWEST : NEWEST + len(states)]
            for trial, states in zip(of_action, active, strict=True)
        ]
        result[action] = suggest_contact_states(active, touching, checkpoint.n_states)
    return result


def _train_stages(
    source: Dataset,
    human_data: Windows,
    robot_data: Windows | None,
    variants: Sequence[str],
    options: TrainingOptions,
    state: RunState,
    out: Path,
    quiet: bool,
) -> list[Checkpoint]:
    """Both stages (only the first without robot data) with a progress bar each. Returns one candidate a seed."""
    # One thread: two are slower than one for networks of this size.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    columns = (
        TextColumn("{task.description:>6}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[values]}"),
    )  # fmt: skip
    try:
        with Progress(*columns, console=Console(stderr=True), disable=quiet) as bars:
            tasks = {
                "human": bars.add_task("human", total=options.human_epochs, values=""),
                "robot": bars.add_task("robot", total=options.robot_epochs, values="", visible=robot_data is not None),
            }

            def progress(name: str, epoch: int, _: int, values: dict[str, float]) -> None:
                text = "  ".join(f"{key} {value:.3f}" for key, value in values.items())
                bars.update(tasks[name], completed=epoch, values=text)

            humans = train_human_stage(human_data, options, progress, state)
            robots: list[dict[str, VAE]] = [{} for _ in humans]
            if robot_data is not None:
                robots = train_robot_stage(robot_data, humans, variants, options, progress, state)
    finally:
        torch.set_num_threads(threads)
    interface = RobotInterface(ROBOT, ROBOTS[ROBOT].joint_names, ROBOTS[ROBOT].end_effector)
    return [
        Checkpoint(
            path=out,
            name=out.name,
            dataset=source.name,
            dataset_checksum=source.checksum,
            human_vae=human.vae,
            hmms=human.hmms,
            robot_vaes=robots[index],
            robot=interface if robot_data is not None else None,
            hidden=options.hidden,
        )
        for index, human in enumerate(humans)
    ]


def _readme(checkpoint: Checkpoint, source: Dataset, scores: Sequence[dict[str, float]], best: int) -> str:
    """What a person reads in the checkpoint's folder."""
    lines = [
        f"# {checkpoint.name}",
        "",
        f"Trained on {source.title}, by:",
        "",
        f"    {checkpoint.training['command']}",
        "",
        f"Dataset `{source.name}`, SHA-256 `{source.checksum}`. {checkpoint.training['fitted_trials']} trials fitted; "
        f"the best of {len(scores) or 1} seeds was chosen on {len(checkpoint.training['held_out_trials'])} held-out "
        "training trials. Test split, read once after that:",
        "",
        f"    mild-viz evaluate --checkpoint {checkpoint.path} --dataset {source.name}",
        "",
        "| model | " + " | ".join(checkpoint.actions) + " | mean |",
        "|---|" + "---|" * (len(checkpoint.actions) + 1),
    ]
    rows = checkpoint.metrics["test"]
    for model in dict.fromkeys(row["model"] for row in rows):
        values = [row["mse_mean"] for row in rows if row["model"] == model]
        lines.append(f"| {model} | " + " | ".join(f"{value:.4f}" for value in [*values, float(np.mean(values))]) + " |")
    if scores:
        lines += ["", "Held-out error of every seed (mean over actions; chosen: " + str(best) + "):", ""]
        lines += [f"- seed {i}: " + ", ".join(f"{k} {v:.4f}" for k, v in s.items()) for i, s in enumerate(scores)]
    return "\n".join(lines) + "\n"
