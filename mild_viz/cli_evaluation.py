"""Commands of `mild-viz` that measure models, beside `cli.evaluate`."""

from __future__ import annotations

from pathlib import Path

from mild_viz.run_options import OptionalPath, check_output


def report(
    dataset: str = "demo",
    checkpoint: tuple[Path, ...] = (),
    out: OptionalPath = None,
) -> None:
    """Write one web page that tells everything about models on a dataset's test trials.

    It holds errors beside simple baselines and the paper's figures, error over time, the forward variable of every
    trial, latent trajectories, segmentation, calibration, distances in metres, warnings about the models' health, and
    the commands that make it again. It is one file that opens without a network.
    Example: mild-viz report --dataset nuisi --out nuisi.html

    Args:
        dataset: Recordings to evaluate on: demo, nuisi, yumi, handover. Example: --dataset nuisi
        checkpoint: Folders of trained models, one or several. Default: the shipped model of the dataset.
            Example: --checkpoint runs/a runs/b
        out: The page. Default: DATASET-report.html in this folder. Example: --out nuisi.html
    """
    out = out or Path(f"{dataset}-report.html")
    check_output(out, ".html")
    from mild_viz.evaluation.page import report as run

    run(checkpoint, dataset, out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; open it in a browser")
