"""Best and median of a variant over several runs: checkpoints, or the seeds that a checkpoint's record names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mild_viz.checkpoint import CONFIG, Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation.buetepage import Buetepage
from mild_viz.evaluation.metrics import Measured

CHECKPOINTS = "checkpoints"
MEAN = "mean"
"""Stands for the action in a mean over actions."""


@dataclass(frozen=True)
class OverRuns:
    """The best run of a model, or the median over its runs."""

    dataset: str
    model: str
    statistic: str
    """'best': the run with the lowest mean over actions; 'median': of every column for itself."""
    run: str | None
    """Which run is the best one."""
    n_runs: int
    source: str
    """Where the runs come from."""
    errors: Mapping[str, float]
    """Mean squared error by action, and of `MEAN`: the mean over actions."""

    @property
    def recorded(self) -> bool:
        """Whether the figures come from a checkpoint's record, and were not measured now."""
        return self.source != CHECKPOINTS

    def as_dicts(self) -> list[dict[str, Any]]:
        """One flat record an action, the mean over actions last."""
        common = {
            "dataset": self.dataset, "model": self.model, "statistic": self.statistic, "run": self.run,
            "n_runs": self.n_runs, "source": self.source,
        }  # fmt: skip
        return [{**common, "action": action, "mse_mean": error} for action, error in self.errors.items()]


def best_and_median(
    dataset: str, model: str, runs: Mapping[str, Mapping[str, float]], source: str
) -> tuple[OverRuns, OverRuns]:
    """Over runs (name -> action -> error), of which one that diverged counts as infinitely bad."""
    actions = tuple(next(iter(runs.values())))
    errors = np.array([[of[action] for action in actions] for of in runs.values()])
    errors = np.column_stack([errors, errors.mean(1)])
    errors[np.isnan(errors)] = np.inf
    best = int(errors[:, -1].argmin())
    columns = (*actions, MEAN)

    def summary(statistic: str, run: str | None, values: np.ndarray) -> OverRuns:
        return OverRuns(
            dataset, model, statistic, run, len(runs), source, dict(zip(columns, values.tolist(), strict=True))
        )

    return summary("best", list(runs)[best], errors[best]), summary("median", None, np.median(errors, axis=0))


def over_checkpoints(measured: Sequence[Measured]) -> list[OverRuns]:
    """Best and median of every model that several checkpoints hold."""
    result = []
    for model in dict.fromkeys(one.model for one in measured):
        runs = {
            str(one.checkpoint): {row.action: row.mse_mean for row in one.rows()}
            for one in measured
            if one.model == model
        }
        if len(runs) > 1:
            result += best_and_median(measured[0].dataset, model, runs, CHECKPOINTS)
    return result


def over_recorded_seeds(name: str, checkpoint: Checkpoint | Buetepage, dataset: str) -> list[OverRuns]:
    """Best and median over the seeds of a training run, as its checkpoint's metrics["test_seeds"] records them.

    That is a list over seeds of rows as metrics["test"] has them. Empty where it is absent or of another dataset.

    Raises:
        UserError: if the record is not of that form.
    """
    seeds: dict[str, dict[str, dict[str, float]]] = {}
    try:
        for seed, rows in enumerate(checkpoint.metrics.get("test_seeds", [])):
            for row in rows:
                if row["dataset"] == dataset:
                    seeds.setdefault(row["model"], {}).setdefault(f"seed {seed}", {})[row["action"]] = float(
                        row["mse_mean"]
                    )
        return [
            summary
            for model, runs in seeds.items()
            if len(runs) > 1
            for summary in best_and_median(dataset, model, runs, f"record of {name}")
        ]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{checkpoint.path / CONFIG}: metrics.test_seeds is not a list over seeds of lists of rows "
            f"with dataset, model, action and mse_mean ({type(error).__name__}: {error})"
        ) from None
