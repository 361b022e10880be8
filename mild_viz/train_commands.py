"""The commands that train: `mild-viz train`, `train-baseline` and `sweep`."""

from __future__ import annotations

import inspect
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import tyro

from mild_viz.errors import UserError
from mild_viz.run_options import OptionalInt, OptionalPath, OptionalText, VariantName, leave

if TYPE_CHECKING:
    from mild_viz.checkpoint import Checkpoint
    from mild_viz.evaluation.buetepage import Buetepage


def train(
    out: OptionalPath = None,
    dataset: str = "demo",
    stage: Literal["hhi", "hri"] = "hri",
    variant: tuple[VariantName, ...] = get_args(VariantName),
    seeds: int = 4,
    epochs: OptionalInt = None,
    seed: int = 0,
    state_model: Literal["hmm", "hsmm"] = "hmm",
    device: Literal["cpu", "cuda"] = "cpu",
    init: OptionalPath = None,
    resume: bool = False,
    config: OptionalPath = None,
    tensorboard: OptionalPath = None,
) -> None:
    """Train a model: Algorithms 1 and 2 of the paper, and v4.

    Stage hhi trains the shared human VAE and one HMM for every interaction on human-human trials; stage hri does
    that, and then trains the robot's VAEs on the frozen human side, all variants and seeds together. v4 trains beside
    them, with human, HMM and robot in one loop. Recordings with a robot and no second human (yumi) begin with human
    and robot. The best seed is chosen on training trials that are held out, never on the test set.
    Example: mild-viz train --dataset nuisi --out runs/nuisi --variant v3.1 v4 --seeds 8

    Args:
        out: Folder to write the model to; the state of an unfinished run lies beside it. Default: runs/DATASET-STAGE.
            Example: --out runs/mine
        dataset: Recordings to train on: demo, nuisi, yumi, handover, handover-hands, bimanual, buetepage. The robot
            is the dataset's: a Pepper,
            for yumi the YuMi that was recorded, for handover a Panda. Example: --dataset nuisi
        stage: How far to go: hhi (human-human) or hri (human-robot). Example: --stage hhi
        variant: Variants to train, one or several. Example: --variant v3.1 v3.2
        seeds: Number of runs from different random starts to choose from; all train together. Example: --seeds 8
        epochs: Passes over the training trials in each stage. Default: as in the shipped models. Example: --epochs 50
        seed: Start of the random numbers; the same seed gives the same model. Example: --seed 1
        state_model: Kind of state model: hmm, or hsmm with Gaussian durations of states. Example: --state-model hsmm
        device: Where the networks train; cuda needs a GPU that torch can use. Example: --device cuda
        init: Folder of a model to go on from (fine-tuning), on these or other recordings. Default: random weights.
            Example: --init checkpoints/demo
        resume: Go on from the state in --out, where an earlier run was interrupted.
        config: TOML file that gives all of these instead, and every other setting of the training (docs/sweeps.md
            has the keys); only --out, --resume and --tensorboard go with it. Example: --config configs/demo.toml
        tensorboard: Folder for a log of losses and held-out errors that TensorBoard shows. Default: no log.
            Example: --tensorboard runs/log
    """
    if config is not None:
        given = {
            "dataset": dataset, "stage": stage, "variant": variant, "seeds": seeds, "epochs": epochs, "seed": seed,
            "state_model": state_model, "device": device, "init": init,
        }  # fmt: skip
        _train_from(config, given, out, resume, tensorboard)
        return
    from mild_viz.training.options import TrainingOptions
    from mild_viz.training.run import train as run

    options = TrainingOptions(seed=seed, seeds=seeds, state_model=state_model, device=device)
    if epochs is not None:
        options = replace(options, human_epochs=epochs, robot_epochs=epochs, joint_epochs=epochs)
    out = out or Path("runs") / f"{dataset}-{stage}"
    words = ["mild-viz", "train", "--dataset", dataset, "--stage", stage, "--variant", *variant, "--seeds", str(seeds)]
    words += ["--epochs", str(epochs)] if epochs is not None else []
    words += ["--seed", str(seed)] if seed else []
    words += ["--state-model", state_model] if state_model != "hmm" else []
    words += ["--device", device] if device != "cpu" else []
    words += ["--init", str(init)] if init is not None else []
    made = run(
        dataset=dataset, stage=stage, variants=variant, options=options, out=out, resume=resume, init=init,
        tensorboard=tensorboard, command=shlex.join([*words, "--out", str(out)]),
    )  # fmt: skip
    _say_what_next(made)


def _train_from(
    config: Path, options: dict[str, Any], out: Path | None, resume: bool, tensorboard: Path | None
) -> None:
    defaults = inspect.signature(train).parameters
    twice = [f"--{name.replace('_', '-')}" for name, value in options.items() if value != defaults[name].default]
    if twice:
        raise UserError(f"{config} gives every option: leave out {', '.join(twice)}, or write it there")
    from mild_viz.training.config import train_from_config

    _say_what_next(train_from_config(config, out, resume, tensorboard))


def _say_what_next(made: Checkpoint | Buetepage) -> None:
    chosen, n_seeds = made.training["chosen"], made.training["options"]["seeds"]
    scored = any(made.metrics.get("held_out", ()))
    why = "had the lowest error on held-out training trials" if scored else "is kept: no held-out trial to choose by"
    print(f"{made.path}: seed {chosen} of {n_seeds} {why}")
    print(f"next: mild-viz evaluate --checkpoint {made.path} --dataset {made.dataset}")


def train_baseline(
    out: OptionalPath = None,
    dataset: str = "demo",
    human_human: bool = False,
    seeds: int = 4,
    epochs: OptionalInt = None,
    seed: int = 0,
) -> None:
    """Train the recurrent baseline that the paper compares with: Bütepage et al. (2020), our implementation.

    Its four stages are the human's variational autoencoder, the human's recurrent dynamics, and both of the robot,
    which is the recorded one, else the one that the second human is retargeted to. It keeps no state: an interrupted
    run begins anew. It is measured by evaluate like any model;
    the best seed is chosen on training trials that are held out, never on the test set.
    Example: mild-viz train-baseline --dataset nuisi --out runs/nuisi-buetepage

    Args:
        out: Folder to write the model to. Default: runs/DATASET-buetepage, or runs/DATASET-buetepage-human.
            Example: --out runs/mine
        dataset: Recordings to train on: demo, nuisi, yumi, handover, buetepage. Example: --dataset yumi
        human_human: Predict the second human's arm instead of a robot.
        seeds: Number of runs from different random starts to choose from; all train together. Example: --seeds 8
        epochs: Passes over the training trials in each stage. Default: 400, as the authors. Example: --epochs 50
        seed: Start of the random numbers; the same seed gives the same model. Example: --seed 1
    """
    from mild_viz.training.buetepage.run import train_buetepage

    out = out or Path("runs") / f"{dataset}-buetepage{'-human' if human_human else ''}"
    made = train_buetepage(dataset, seeds, epochs, out, seed, human_human)
    _say_what_next(made)


def sweep(config: tyro.conf.Positional[Path], jobs: OptionalInt = None, scheduler: OptionalText = None) -> None:
    """Train many models: every combination of the datasets, variants, seeds and settings of a config.

    It can be killed at any point; the same command again redoes only what is unfinished. A run that fails is reported
    with its traceback, and does not stop the rest. docs/sweeps.md describes the config and the use of a cluster.
    Example: mild-viz sweep configs/sweep-example.toml --jobs 4

    Args:
        config: TOML file that says what to train.
        jobs: Processes of this machine to train with. Default: one a core. Example: --jobs 4
        scheduler: Address of a Dask scheduler whose workers train instead. Default: train on this machine.
            Example: --scheduler tcp://login1:8786
    """
    from mild_viz.training.sweep import sweep as run

    leave(run(config, jobs, scheduler))
