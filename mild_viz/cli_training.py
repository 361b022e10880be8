"""Commands of `mild-viz` that train models, beside `cli.train`."""

from __future__ import annotations

from pathlib import Path

from mild_viz.run_options import OptionalInt, OptionalPath


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
    which is the recorded one, else Pepper by retargeting the second human. It is measured by evaluate like any model;
    the best seed is chosen on training trials that are held out, never on the test set.
    Example: mild-viz train-baseline --dataset nuisi --out runs/nuisi-buetepage

    Args:
        out: Folder to write the model to. Default: runs/DATASET-buetepage, or runs/DATASET-buetepage-human.
            Example: --out runs/mine
        dataset: Recordings to train on: demo, nuisi, yumi, handover. Example: --dataset yumi
        human_human: Predict the second human's arm instead of a robot.
        seeds: Number of runs from different random starts to choose from; all train together. Example: --seeds 8
        epochs: Passes over the training trials in each stage. Default: 400, as the authors. Example: --epochs 50
        seed: Start of the random numbers; the same seed gives the same model. Example: --seed 1
    """
    from mild_viz.training.buetepage.run import train_buetepage

    out = out or Path("runs") / f"{dataset}-buetepage{'-human' if human_human else ''}"
    made = train_buetepage(dataset, seeds, epochs, out, seed, human_human)
    print(f"{out}: seed {made.training['chosen']} of {seeds} had the lowest error on held-out training trials")
    print(f"next: mild-viz evaluate --checkpoint {out} --dataset {dataset}")
