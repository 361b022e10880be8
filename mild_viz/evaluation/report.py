"""What `mild-viz evaluate` does: measure checkpoints, and show it in the terminal and in files."""

from __future__ import annotations

import json as json_format
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.buetepage import load_model
from mild_viz.evaluation.layout import comparison_table, error_table, runs_table
from mild_viz.evaluation.metrics import (
    Measured,
    Model,
    Row,
    joint_names,
    measure_baselines,
    measure_model,
    published_rows,
)
from mild_viz.evaluation.runs import MEAN, OverRuns, over_checkpoints, over_recorded_seeds
from mild_viz.evaluation.significance import Comparison, compare
from mild_viz.evaluation.tables import TextTable, print_tables, to_latex, to_markdown
from mild_viz.files import write_atomically
from mild_viz.pairs import check_points, check_rate, stack_windows
from mild_viz.settings import choose
from mild_viz.trial import Dataset

REFERENCE = "knn-time"
"""What every variant is compared with unless pairs are asked for: fixed beforehand, not chosen on the test split."""


@dataclass(frozen=True)
class Evaluation:
    """Checkpoints on a dataset's test split, beside baselines and the paper's figures."""

    dataset: Dataset
    checkpoints: Mapping[str, Model]
    """By a name that tells them apart."""
    measured: tuple[Measured, ...]
    published: tuple[Row, ...]
    over_runs: tuple[OverRuns, ...]
    comparisons: tuple[Comparison, ...]

    @property
    def rows(self) -> list[Row]:
        """The whole table: variants, baselines, the paper's rows."""
        return [row for measured in self.measured for row in measured.rows()] + list(self.published)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader should know of where the models come from."""
        notes = []
        for name, model in self.checkpoints.items():
            if model.dataset != self.dataset.name:
                notes.append(f"note: {name} was trained on '{model.dataset}', not on '{self.dataset.name}'")
            elif model.dataset_checksum and model.dataset_checksum != self.dataset.checksum:
                notes.append(f"note: the recordings of '{model.dataset}' have changed since {name} was trained")
        return tuple(notes)

    def tables(self, each_action: bool = True) -> list[TextTable]:
        """Errors; best and median where there are several runs; comparisons, of single actions too or not."""
        human_human = next(iter(self.checkpoints.values())).robot is None
        unit = "m² × 100 (the paper's 'cm')" if human_human else "rad²"
        names = list(self.checkpoints)
        who = names[0] if len(names) == 1 else f"{len(names)} checkpoints"
        caption = f"{who} on {self.dataset.name} (test split): mean squared error in {unit}, mean ± std over windows"
        tables = [replace(error_table(self.rows, caption), notes=self.notes)]
        for source in dict.fromkeys(one.source for one in self.over_runs):
            tables.append(runs_table([one for one in self.over_runs if one.source == source], unit))
        if self.comparisons:
            tables.append(comparison_table(self.comparisons, unit.split(" (")[0], each_action))
        return tables

    def as_json(self) -> dict[str, Any]:
        """Everything, with every digit."""
        return {
            "dataset": {"name": self.dataset.name, "checksum": self.dataset.checksum},
            "checkpoints": {name: str(model.path) for name, model in self.checkpoints.items()},
            "rows": [row.as_dict() for row in self.rows],
            "over_runs": [record for one in self.over_runs for record in one.as_dicts()],
            "comparisons": [comparison.as_dict() for comparison in self.comparisons],
        }

    def as_frame(self) -> pd.DataFrame:
        """The table in long form: rows, their means over actions, best and median over runs."""
        rows = [row.as_dict() for row in self.rows]
        for measured in self.measured:
            mean = {"dataset": measured.dataset, "model": measured.model, "checkpoint": measured.checkpoint}
            rows.append({**mean, "action": MEAN, "mse_mean": measured.mean})
        frame = pd.DataFrame([*rows, *(record for one in self.over_runs for record in one.as_dicts())])
        columns = ["dataset", "model", "checkpoint", "action", "mse_mean", "mse_std", "n_windows", "n_trials"]
        columns += ["statistic", "run", "n_runs", "source"]
        return frame.reindex(columns=columns).astype(dict.fromkeys(("n_windows", "n_trials", "n_runs"), "Int64"))


def measure(checkpoints: Mapping[str, Model], dataset: Dataset, pairs: Sequence[str] = ()) -> Evaluation:
    """Measure named checkpoints on a dataset's test split, and compare predictors.

    Args:
        checkpoints: Models to measure, by a name that tells them apart; all predict the same joints.
        dataset: Trials; the baselines are fitted on its training split.
        pairs: Predictors that are compared, each with each: a variant (with several checkpoints: their errors'
            average, window by window), VARIANT@CHECKPOINT, or a baseline. Empty: every variant with `REFERENCE`.

    Raises:
        UserError: if a model predicts other joints or was trained at another rate than the dataset has, or
            another model does, or a name in `pairs` is unknown.
    """
    models = list(checkpoints.items())
    joints = joint_names(models[0][1])
    for name, model in models:
        check_rate(model.rate, name, dataset.test)
        check_points(model.points, name, dataset.test)
        if joint_names(model) != joints:
            said = [", ".join(joint_names(m) or ["the second human's arm"]) for m in (models[0][1], model)]
            raise UserError(
                f"checkpoint {models[0][0]} predicts {said[0]}; {name} predicts {said[1]}: their errors cannot "
                "stand in one table; evaluate them one by one"
            )
    chosen = choose_pairs(pairs, checkpoints)
    recorded = [one for name, model in models for one in over_recorded_seeds(name, model, dataset.name)]
    train, test = stack_windows(dataset.train, joints), stack_windows(dataset.test, joints)
    variants = [
        replace(measured, checkpoint=name if len(models) > 1 else None)
        for name, model in models
        for measured in measure_model(dataset.name, model, test)
    ]
    baselines = measure_baselines(dataset.name, train, test, joints is None)
    named = {measured.model: measured for measured in baselines}
    for variant in dict.fromkeys(one.model for one in variants):
        named[variant] = average([one for one in variants if one.model == variant])
    named |= {f"{one.model}@{one.checkpoint}": one for one in variants if one.checkpoint}
    return Evaluation(
        dataset,
        checkpoints,
        measured=(*variants, *baselines),
        published=tuple(published_rows(dataset.name, joints is None)),
        over_runs=(*over_checkpoints(variants), *recorded),
        comparisons=tuple(compare([((a, named[a]), (b, named[b])) for a, b in chosen])),
    )


def choose_pairs(names: Sequence[str], checkpoints: Mapping[str, Model]) -> list[tuple[str, str]]:
    """The pairs that `measure` compares; an error lists the names that may be given."""
    held = [(variant, name) for name, model in checkpoints.items() for variant in model.variants]
    variants = list(dict.fromkeys(variant for variant, _ in held))
    if not names:
        return [(variant, REFERENCE) for variant in variants]
    valid = [*variants, *(f"{variant}@{name}" for variant, name in held if len(checkpoints) > 1), *BASELINES]
    pairs = list(combinations(dict.fromkeys(choose("--compare", name, valid) for name in names), 2))
    if not pairs:
        raise UserError(f"--compare needs two different names or more; valid: {', '.join(valid)}")
    return pairs


def average(runs: Sequence[Measured]) -> Measured:
    """The mean error of several runs of a model in every window: what to expect of a run."""
    errors = np.mean([run.errors for run in runs], axis=0)
    return replace(runs[0], errors=errors, checkpoint=None)


def evaluate(
    checkpoints: Sequence[Path],
    dataset: str,
    pairs: Sequence[str] = (),
    json: Path | None = None,
    csv: Path | None = None,
    latex: Path | None = None,
    markdown: Path | None = None,
) -> Evaluation:
    """Measure checkpoints as `measure` does, print the tables, and write those files that are given, atomically."""
    models = load_named(checkpoints)
    result = measure(models, load_dataset(dataset), pairs)
    print_tables(result.tables(each_action=bool(pairs)))
    tables = result.tables()
    if json is not None:
        _write(json, json_format.dumps(_finite(result.as_json()), indent=2, allow_nan=False) + "\n")
    if csv is not None:
        _write(csv, result.as_frame().to_csv(index=False))
    if markdown is not None:
        _write(markdown, "\n".join(to_markdown(table) for table in tables))
    if latex is not None:
        floats = (to_latex(table, f"tab:{dataset}-{i}") for i, table in enumerate(tables, 1))
        _write(latex, "% needs \\usepackage{booktabs}\n" + "\n".join(floats))
    return result


def load_named(paths: Sequence[Path]) -> dict[str, Model]:
    """Load checkpoints, each once, by the folder's name, or by the whole path where two have the same name."""
    paths = list({path.resolve(): path for path in paths}.values())
    names = [path.resolve().name for path in paths]
    return {
        name if names.count(name) == 1 else str(path): load_model(path) for name, path in zip(names, paths, strict=True)
    }


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
