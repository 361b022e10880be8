"""What a sweep found: one table of all finished cells, and their summary over seeds and folds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.table import Table

from mild_viz.files import write_atomically
from mild_viz.training.sweep_config import Cell

ERRORS = ("held_out_mse", "test_mse")


def cell_rows(cell: Cell, config: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row a variant and action, from the cell's config.json. Errors are rad^2, or m^2 x 100 between humans."""
    metrics, training = config["metrics"], config["training"]
    held_out = {(row["model"], row["action"]): row["mse_mean"] for row in metrics["held_out_rows"]}
    options = {key: str(value) if isinstance(value, tuple) else value for key, value in asdict(cell.options).items()}
    return [
        {
            "cell": cell.name,
            "dataset": cell.dataset,
            "stage": cell.stage,
            "together": "+".join(cell.variants),
            **options,
            "variant": row["model"],
            "action": row["action"],
            "held_out_mse": held_out.get((row["model"], row["action"]), float("nan")),
            "test_mse": row["mse_mean"],
            "test_mse_std": row["mse_std"],
            "test_windows": row["n_windows"],
            "seconds": training["seconds"],
        }
        for row in metrics["test"]
    ]


def write_results(rows: list[dict[str, Any]], file: Path) -> None:
    """Write results.csv whole."""
    write_atomically(file, lambda temporary: pd.DataFrame(rows).to_csv(temporary, index=False))


def summary(rows: list[dict[str, Any]]) -> Table:
    """Every setting that the sweep varied, its errors averaged over actions, then mean and median over seeds and folds.

    Best first within a dataset, by the median on held-out training trials. The test split, which is to decide nothing,
    stands in results.csv alone.
    """
    fixed = ("cell", "action", "seed", "fold", "seconds", "test_windows", "test_mse_std", *ERRORS)
    varied = [name for name in rows[0] if name not in fixed and len({row[name] for row in rows}) > 1]
    settings = ["dataset", "variant", *(name for name in varied if name not in ("dataset", "variant"))]
    groups: dict[tuple[Any, ...], dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        cells = groups.setdefault(tuple(row[name] for name in settings), {})
        cells.setdefault(row["cell"], []).append(row)
    figures = {
        key: [
            float(over_runs([np.mean([row["held_out_mse"] for row in of_cell]) for of_cell in cells.values()]))
            for over_runs in (np.mean, np.median)
        ]
        for key, cells in groups.items()
    }

    table = Table(title="mean squared error, averaged over actions; best first by the median on held-out trials")
    for name in settings:
        table.add_column(name)
    for name in ("runs", "held-out mean", "held-out median"):
        table.add_column(name, justify="right")
    before = None
    for key in sorted(figures, key=lambda key: (key[0], np.nan_to_num(figures[key][1], nan=np.inf))):
        if before not in (None, key[0]):
            table.add_section()
        before = key[0]
        table.add_row(*map(str, key), str(len(groups[key])), *(f"{value:.4f}" for value in figures[key]))
    return table
