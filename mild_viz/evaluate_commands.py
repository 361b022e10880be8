"""Commands of `mild-viz` that measure models."""

from __future__ import annotations

from pathlib import Path

from mild_viz import paths
from mild_viz.run_options import OptionalNames, OptionalPath, OptionalPaths, check_output


def evaluate(
    checkpoint: OptionalPaths = None,
    dataset: str = "demo",
    compare: OptionalNames = None,
    json: OptionalPath = None,
    csv: OptionalPath = None,
    markdown: OptionalPath = None,
    latex: OptionalPath = None,
) -> None:
    """Measure models on the test trials, beside simple baselines and the paper's figures.

    For every variant and action: mean squared error of the predicted robot windows [rad^2], its standard deviation
    over windows, the number of windows and trials; beside them a constant mean, a time-indexed mean, ridge regression
    and nearest neighbours fitted on the training trials. Then the differences between predictors, with tests over
    trials beside the paper's test over windows. Example: mild-viz evaluate --dataset nuisi --json nuisi.json

    Args:
        checkpoint: Folders of trained models, one or several; what several hold is summed up by best and median.
            Default: the shipped model of the dataset. Example: --checkpoint runs/a runs/b
        dataset: Recordings to evaluate on: demo, nuisi, yumi, handover, handover-hands, bimanual, buetepage.
            Example: --dataset nuisi
        compare: Predictors to compare, each with each. Default: every variant with knn-time, over all actions.
            A variant that several checkpoints hold stands for the average of their errors; VARIANT@CHECKPOINT is one
            of them. Example: --compare v3.1 v1 ridge
        json: File for all figures, as lists of records. Default: print only. Example: --json results.json
        csv: File for the errors, as a table in long form. Default: print only. Example: --csv results.csv
        markdown: File for the tables as Markdown. Default: print only. Example: --markdown results.md
        latex: File for the tables as LaTeX (booktabs). Default: print only. Example: --latex results.tex
    """
    for path, suffix in ((json, ".json"), (csv, ".csv"), (markdown, ".md"), (latex, ".tex")):
        if path is not None:
            check_output(path, suffix)
    from mild_viz.evaluation.report import evaluate as run

    run(checkpoint or [paths.default_checkpoint(dataset)], dataset, compare or (), json, csv, latex, markdown)


def report(
    dataset: str = "demo",
    checkpoint: OptionalPaths = None,
    out: OptionalPath = None,
) -> None:
    """Write one web page that tells everything about models on a dataset's test trials.

    It holds errors beside simple baselines and the paper's figures, error over time, the forward variable of every
    trial, latent trajectories, segmentation, calibration, distances in metres, warnings about the models' health, and
    the commands that make it again. It is one file that opens without a network.
    Example: mild-viz report --dataset nuisi --out nuisi.html

    Args:
        dataset: Recordings to evaluate on: demo, nuisi, yumi, handover, handover-hands, bimanual, buetepage.
            Example: --dataset nuisi
        checkpoint: Folders of trained models, one or several. Default: the shipped model of the dataset.
            Example: --checkpoint runs/a runs/b
        out: The page. Default: DATASET-report.html in this folder. Example: --out nuisi.html
    """
    out = out or Path(f"{dataset}-report.html")
    check_output(out, ".html")
    from mild_viz.evaluation.page import report as run

    run(checkpoint or (), dataset, out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; open it in a browser")
