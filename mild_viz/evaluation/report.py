"""The evaluation as a person reads it, and as JSON: what `mild-viz evaluate` does."""

from __future__ import annotations

import json as json_format
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from mild_viz.data.load import load_dataset
from mild_viz.evaluation.buetepage import load_model
from mild_viz.evaluation.metrics import Row, evaluation_rows
from mild_viz.files import write_atomically


def evaluate(checkpoint: Path, dataset: str, json: Path | None = None) -> list[Row]:
    """Measure every variant of a checkpoint on a dataset's test split, beside baselines and the paper's rows.

    Prints the table; with `json`, also writes {"rows": [...]} there, atomically.
    """
    model = load_model(checkpoint)
    source = load_dataset(dataset)
    rows = evaluation_rows(model, source)
    unit = "rad^2" if model.robot is not None else "m^2 x 100 (the paper's 'cm')"
    title = f"{model.name} on {source.name} (test split): mean squared error in {unit}, mean ± std over windows"
    Console(width=None if Console().is_terminal else 160).print(make_table(rows, title))
    if model.dataset == source.name and model.dataset_checksum and model.dataset_checksum != source.checksum:
        print(f"note: the recordings of '{source.name}' have changed since this model was trained")
    if model.dataset != source.name:
        print(f"note: this model was trained on '{model.dataset}', not on '{source.name}'")
    if json is not None:
        write_json(rows, json)
    return rows


def make_table(rows: Sequence[Row], title: str) -> Table:
    """Models down, actions across; the last column is the mean over actions."""
    table = Table(title=title)
    table.add_column("model")
    actions = list(dict.fromkeys(row.action for row in rows))
    counts = {row.action: f"{row.n_windows} windows, {row.n_trials} trials" for row in rows if row.n_windows}
    for action in actions:
        table.add_column(f"{action}\n{counts.get(action, '')}", justify="right")
    table.add_column("mean", justify="right")
    kind = ""
    for model in dict.fromkeys(row.model for row in rows):
        cells = {row.action: row for row in rows if row.model == model}
        group = "paper" if model.startswith("paper") else "model" if model.startswith("v") else "baseline"
        if kind and group != kind:
            table.add_section()
        kind = group
        figures = [f"{cells[a].mse_mean:.4f} ± {cells[a].mse_std:.4f}" if a in cells else "" for a in actions]
        table.add_row(model, *figures, f"{np.mean([row.mse_mean for row in cells.values()]):.4f}")
    return table


def write_json(rows: Sequence[Row], path: Path) -> None:
    """Write {"rows": [...]} to a file, atomically."""
    text = json_format.dumps({"rows": [row.as_dict() for row in rows]}, indent=2) + "\n"
    write_atomically(path, lambda temporary: temporary.write_text(text))
