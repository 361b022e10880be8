"""From checkpoints and a dataset to the page: measure, draw, fill the template, write the file."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mild_viz import paths
from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.health import KINDS
from mild_viz.evaluation.layout import comparison_table, runs_table
from mild_viz.evaluation.page import figures, strips, tables
from mild_viz.evaluation.page.measure import Group, measure_groups
from mild_viz.files import write_atomically
from mild_viz.trial import Dataset

HERE = Path(__file__).parent
"""Where the template and its style sheet lie: data of the package."""


@dataclass(frozen=True)
class Headline:
    """One of the figures that stand above everything else."""

    label: str
    value: str
    remark: str
    row: str
    """The name of its row in the table."""


def report(checkpoints: Sequence[Path], dataset: str, out: Path) -> None:
    """Write one self-contained HTML page on checkpoints (default: the shipped one) and a dataset's test trials.

    Raises:
        UserError: where a checkpoint or the dataset cannot be used, they do not fit, or the file cannot be written.
    """
    folders = list(dict.fromkeys(checkpoints)) or [paths.default_checkpoint(dataset)]
    models = [load_checkpoint(folder) for folder in folders]
    source = load_dataset(dataset)
    groups = measure_groups(models, source, lambda label: print(f"measured {label}", flush=True))
    text = render(groups, models, source, _commands(models, source, checkpoints, out), datetime.now(timezone.utc))
    write_atomically(out, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def render(
    groups: Sequence[Group],
    checkpoints: Sequence[Checkpoint],
    dataset: Dataset,
    commands: Sequence[tuple[str, str]],
    when: datetime,
) -> str:
    """The page's text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html.j2").render(
        dataset=dataset,
        checkpoints=checkpoints,
        when=f"{when:%Y-%m-%d %H:%M} UTC",
        program=f"mild_viz {version('mild-viz')}, Python {platform.python_version()}, NumPy {version('numpy')}",
        groups=[_group(group) for group in groups],
        state_colors=[tables.state_color(state) for state in range(max(model.n_states for model in checkpoints))],
        model_paths=[_shown(model.path) for model in checkpoints],
        commands=commands,
        data_changed=[model.name for model in checkpoints if _data_changed(model, dataset)],
    )


def _group(group: Group) -> dict[str, Any]:
    """What the template needs of one comparison."""
    from markupsafe import Markup

    best = group.best
    partner = "second human" if group.human_human else f"{best.checkpoint.for_robot().name}"
    return {
        "title": f"Human to {partner}",
        "human_human": group.human_human,
        "best": best.label,
        "headlines": _headlines(group),
        "verdict": _verdict(group),
        "warnings": _warnings(group),
        "notes": group.notes,
        "results": tables.results(group),
        "significance": _significance(group),
        "curves": Markup(figures.error_curves(group)),
        "curve_baselines": list(group.baselines),
        "strips": [(action, strips.trial_strips(best.passes[action])) for action in group.actions],
        "truth_colors": strips.truth_colors([one for some in best.passes.values() for one in some]),
        "latents": [(action, Markup(figures.latent_plots(best, action))) for action in group.actions],
        "latent_trials": figures.MOST_TRIALS,
        "largest": max(len(some) for some in best.passes.values()),
        "states": tables.states(group),
        "agreement": tables.agreement(group),
        "phases": tables.phase_tables(group),
        "calibration": tables.calibrations(group),
        "hands": tables.hands(group),
        "contacts": tables.contacts(group),
    }


def _significance(group: Group) -> dict[str, Any]:
    """Best and median over runs, differences over all actions, and of each action."""
    evaluation = group.evaluation
    unit = tables.unit(group)
    runs = [
        runs_table([one for one in evaluation.over_runs if one.source == source], unit)
        for source in dict.fromkeys(one.source for one in evaluation.over_runs)
    ]
    pooled, single = (comparison_table(evaluation.comparisons, unit, each_action=each) for each in (False, True))
    return {"runs": runs, "pooled": pooled, "single": single}


def _headlines(group: Group) -> list[Headline]:
    """The best of our models, of the baselines and of the paper, by the mean over actions."""
    labels = list(group.rows)
    models = [model.label for model in group.models]
    found = []
    for title, some in (
        ("best variant", models),
        ("best simple baseline", [label for label in labels if label in BASELINES]),
        ("best in the paper", [label for label in labels if label.startswith("paper ")]),
    ):
        if some:
            best = min(some, key=group.mean_error)
            found.append(Headline(title, f"{group.mean_error(best):.3f}", best.removeprefix("paper "), best))
    return found


def _verdict(group: Group) -> str:
    """In words, how the best variant stands."""
    own, words = group.mean_error(group.best.label), []
    for one in _headlines(group)[1:]:
        ratio = own / group.mean_error(one.row)
        words.append(f"{abs(ratio - 1):.0%} {'above' if ratio > 1 else 'below'} that of {one.remark}, the {one.label}")
    return f"The error of {group.best.label} is {', and '.join(words)}." if words else ""


def _warnings(group: Group) -> list[tuple[str, str, list[tuple[str, str]]]]:
    """Kind, what it means, and (model, actions with their figures) of all warnings, worst kind first."""
    result = []
    for kind, meaning in KINDS.items():
        found = []
        for model in group.models:
            details = [f"{one.action}: {one.detail}" for one in model.warnings if one.kind == kind]
            if details:
                found.append((model.label, "; ".join(details)))
        if found:
            result.append((kind, meaning, _merged(found)))
    return result


def _merged(found: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Models with the same text on one line."""
    texts: dict[str, list[str]] = {}
    for label, text in found:
        texts.setdefault(text, []).append(label)
    return [(", ".join(labels), text) for text, labels in texts.items()]


def _shown(path: Path) -> str:
    """A path as it reads from the working folder, if it lies below: a reader elsewhere has no use for the rest."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _data_changed(checkpoint: Checkpoint, dataset: Dataset) -> bool:
    """Whether a model was trained on other recordings of the same name."""
    known = checkpoint.dataset == dataset.name and checkpoint.dataset_checksum
    return bool(known) and checkpoint.dataset_checksum != dataset.checksum


def _commands(
    models: Sequence[Checkpoint], dataset: Dataset, checkpoints: Sequence[Path], out: Path
) -> list[tuple[str, str]]:
    """What to type to get the same, in order, and what each does."""
    commands = []
    if dataset.name != "demo":
        commands.append((f"mild-viz data fetch {dataset.name}", "the recordings"))
    for model in models:
        command = model.training.get("command")
        if isinstance(command, str) and command:
            commands.append((command, f"the model {model.name}"))
    given = ["--checkpoint", *map(str, checkpoints)] if checkpoints else []
    for model in models:
        evaluated = ["--checkpoint", str(model.path)] if checkpoints else []
        commands.append(
            (shlex.join(["mild-viz", "evaluate", "--dataset", dataset.name, *evaluated]), f"the errors of {model.name}")
        )
    page = ["mild-viz", "report", "--dataset", dataset.name, *given, "--out", str(out)]
    commands.append((shlex.join(page), "this page"))
    return commands
