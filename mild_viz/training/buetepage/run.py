"""One training run of the baseline, from recordings to a folder: what `mild-viz train-baseline` does."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from mild_viz.checkpoint import RobotInterface, check_checkpoint_target
from mild_viz.errors import UserError
from mild_viz.evaluation.buetepage import BUETEPAGE, Buetepage, save_buetepage
from mild_viz.evaluation.metrics import model_rows
from mild_viz.latent.vae import VAE
from mild_viz.pairs import check_points
from mild_viz.training.buetepage.options import BuetepageOptions
from mild_viz.training.buetepage.stages import (
    make_examples,
    train_human_dynamics,
    train_robot_dynamics,
    train_vae,
)
from mild_viz.training.options import TrainingOptions
from mild_viz.training.outcome import mean_error
from mild_viz.training.progress import Progress, shown
from mild_viz.training.recordings import training_windows
from mild_viz.training.run import plan_run
from mild_viz.trial import ARM_POINTS, Dataset, Trial

HUMAN_STAGES = ("human VAE", "human dynamics")
STAGES = (*HUMAN_STAGES, "robot VAE", "robot dynamics")


def train_buetepage(
    dataset: str,
    seeds: int = 4,
    epochs: int | None = None,
    out: Path = Path("runs/buetepage"),
    seed: int = 0,
    human_human: bool = False,
) -> Buetepage:
    """Train the baseline and write its folder.

    Raises:
        UserError: on an unknown dataset, one without the partner that is asked for, a number out of range, or a
            folder that holds something else.
    """
    options = BuetepageOptions(seeds=seeds, seed=seed)
    if epochs is not None:
        options = replace(options, epochs=epochs)
    check_checkpoint_target(out)
    plan = plan_run(dataset, "hhi" if human_human else "hri", ("v1",), TrainingOptions(seeds=seeds, seed=seed))
    check_points(ARM_POINTS, "of the baseline", plan.source.train)
    source, fit, held, robot = plan.source, plan.fit, plan.held, None if human_human else plan.robot
    actions = tuple(action for action in source.actions if any(trial.action == action for trial in fit))
    started = time.monotonic()
    names = HUMAN_STAGES if human_human else STAGES
    with one_thread(), shown(dict.fromkeys(names, options.epochs), False, None) as progress:
        trained = train_models(fit, actions, robot, options, progress)
    candidates = [
        Buetepage(out, out.name, source.name, source.checksum, actions, robot, vae, tensors, rate=plan.rate)
        for vae, tensors in trained
    ]
    scores = [mean_error(model_rows(candidate, held), BUETEPAGE) for candidate in candidates] if held else []
    if scores and np.isnan(scores).all():
        raise UserError("every seed diverged: no prediction on the held-out trials is a number; try another --seed")
    best = int(np.nanargmin(scores)) if scores else 0
    command = ["mild-viz", "train-baseline", "--dataset", dataset, *(["--human-human"] if human_human else [])]
    command += ["--seeds", str(seeds), *(["--epochs", str(epochs)] if epochs is not None else [])]
    command += [*(["--seed", str(seed)] if seed else []), "--out", str(out)]
    training = {
        "command": shlex.join(command),
        "seed": seed,
        "chosen": best,
        "seconds": round(time.monotonic() - started, 1),
        "fitted_trials": len(fit),
        "held_out_trials": [trial.name for trial in held],
        "options": asdict(options),
    }
    # The test split is read here for the first time, for the record only.
    test = [trial for trial in source.test if trial.action in actions]
    tests = [[row.as_dict() for row in model_rows(candidate, test)] for candidate in candidates]
    metrics = {"held_out": scores, "test": tests[best], "test_seeds": tests}
    chosen = replace(candidates[best], training=training, metrics=metrics)
    return save_buetepage(chosen, out, _readme(chosen, source))


def train_models(
    trials: Sequence[Trial],
    actions: Sequence[str],
    robot: RobotInterface | None,
    options: BuetepageOptions,
    progress: Progress,
) -> list[tuple[VAE, dict[str, np.ndarray]]]:
    """All four stages on trials; without a robot the first two, and the partner is the second human.

    Returns the partner's VAE and the weights of the dynamics of every seed, as `Buetepage` holds them.
    """
    rng = torch.Generator().manual_seed(options.seed)
    windows = training_windows(trials, robot.joint_names if robot else None)
    data = make_examples(trials, windows, actions)
    human_vae = train_vae("human VAE", data.next_window.flatten(0, 1), options, progress, rng)
    human = train_human_dynamics(data, human_vae, options, progress, rng)
    seeds = range(options.seeds)
    if robot is None:
        # The second human's layers (models from `seeds` on) read the first one's d.
        return [(human_vae.export(s), human.export(s) | human.head.export(options.seeds + s)) for s in seeds]
    robot_vae = train_vae("robot VAE", data.partner_window, options, progress, rng)
    rest = data.partner_window[data.rows[:, 0], : len(robot.joint_names)].mean(0)
    dynamics = train_robot_dynamics(data, human, robot_vae, rest, options, progress, rng)
    pose = {"rest": rest.numpy().astype(np.float64)}
    return [(robot_vae.export(s), human.export(s) | dynamics.export(s) | pose) for s in seeds]


@contextmanager
def one_thread() -> Iterator[None]:
    """Two threads are slower than one for networks of this size."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _readme(model: Buetepage, source: Dataset) -> str:
    """What a person reads in the model's folder."""
    rows, scores = model.metrics["test"], model.metrics["held_out"]
    actions = [row["action"] for row in rows]
    partner = f"{model.robot.name}'s joints" if model.robot else "the second human's windows"
    values = [row["mse_mean"] for row in rows]
    lines = [
        f"# {model.name}",
        "",
        f"Our implementation of the baseline of Bütepage et al. (2020). It predicts {partner}.",
        "",
        f"Trained on {source.title}, by:",
        "",
        f"    {model.training['command']}",
        "",
        f"Dataset `{source.name}`, SHA-256 `{source.checksum}`. {model.training['fitted_trials']} trials fitted; "
        f"the best of {model.training['options']['seeds']} seeds was chosen on "
        f"{len(model.training['held_out_trials'])} held-out training trials. Test split, read once after that:",
        "",
        "| model | " + " | ".join(actions) + " | mean |",
        "|---|" + "---|" * (len(actions) + 1),
        f"| {BUETEPAGE} | " + " | ".join(f"{value:.4f}" for value in [*values, float(np.mean(values))]) + " |",
    ]
    if scores:
        lines += ["", f"Held-out error of every seed (mean over actions; chosen: {model.training['chosen']}):", ""]
        lines += [f"- seed {index}: {score:.4f}" for index, score in enumerate(scores)]
    return "\n".join(lines) + "\n"
