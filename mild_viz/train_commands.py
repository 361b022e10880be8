"""The commands that train: `mild-viz train` and `mild-viz sweep`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from mild_viz.errors import UserError
from mild_viz.run_options import OptionalInt, OptionalPath, OptionalText, VariantName, leave

if TYPE_CHECKING:
    from mild_viz.checkpoint import Checkpoint


def train(
    out: OptionalPath = None,
    dataset: str = "demo",
    stage: Literal["hhi", "hri"] = "hri",
    variant: tuple[VariantName, ...] = ("v1", "v2.1", "v2.2", "v3.1", "v3.2"),
    seeds: int = 4,
    epochs: OptionalInt = None,
    seed: int = 0,
    resume: bool = False,
    config: OptionalPath = None,
) -> None:
    """Train a model: Algorithms 1 and 2 of the paper.

    Stage hhi trains the shared human VAE and one HMM for every interaction on human-human trials; stage hri does
    that, and then trains the robot's VAEs on the frozen human side, all variants and seeds together. The best seed
    is chosen on training trials that are held out, never on the test set.
    Example: mild-viz train --dataset nuisi --out runs/nuisi --variant v3.1 v3.2 --seeds 8

    Args:
        out: Folder to write the model to; the state of an unfinished run lies beside it. Default: runs/DATASET-STAGE.
            Example: --out runs/mine
        dataset: Recordings of two humans to train on: demo, nuisi, handover. Example: --dataset nuisi
        stage: How far to go: hhi (human-human) or hri (human-human, then human-robot). Example: --stage hhi
        variant: Variants to train, one or several. Example: --variant v3.1 v3.2
        seeds: Number of runs from different random starts to choose from; all train together. Example: --seeds 8
        epochs: Passes over the training trials in each stage. Default: as in the shipped models. Example: --epochs 50
        seed: Start of the random numbers; the same seed gives the same model. Example: --seed 1
        resume: Go on from the state in --out, where an earlier run was interrupted.
        config: TOML file that gives all of these instead, and every other setting of the training (docs/sweeps.md
            has the keys); only --out and --resume go with it. Example: --config configs/train-example.toml
    """
    if config is not None:
        given = {"dataset": dataset, "stage": stage, "variant": variant, "seeds": seeds, "epochs": epochs, "seed": seed}
        _train_from(config, given, out, resume)
        return
    from mild_viz.training.run import train as run

    out = out or Path("runs") / f"{dataset}-{stage}"
    made = run(
        dataset=dataset, stage=stage, variants=variant, seeds=seeds, epochs=epochs, out=out, resume=resume, seed=seed
    )
    _say_what_next(made)


def _train_from(config: Path, options: dict[str, Any], out: Path | None, resume: bool) -> None:
    defaults = inspect.signature(train).parameters
    twice = [f"--{name}" for name, value in options.items() if value != defaults[name].default]
    if twice:
        raise UserError(f"{config} gives every option: leave out {', '.join(twice)}, or write it there")
    from mild_viz.training.config import train_from_config

    _say_what_next(train_from_config(config, out, resume))


def _say_what_next(made: Checkpoint) -> None:
    chosen, n_seeds = made.training["chosen"], made.training["options"]["seeds"]
    print(f"{made.path}: seed {chosen} of {n_seeds} had the lowest error on held-out training trials")
    print(f"next: mild-viz evaluate --checkpoint {made.path} --dataset {made.dataset}")


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
