"""The page's tables: what is measured, as texts in cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.calibration import LEVELS, Calibration
from mild_viz.evaluation.distances import COMPARED
from mild_viz.evaluation.page.measure import Group, Result
from mild_viz.evaluation.segmentation import BOUNDARIES
from mild_viz.settings import STATE_COLORS
from mild_viz.trial import PHASES

NONE = "–"
"""A cell without a value."""


@dataclass(frozen=True)
class Cell:
    """A text and small lines below it; `best` marks the winner of a column, `share` (0 to 1) draws a bar below it."""

    text: str
    note: str = ""
    best: bool = False
    share: float | None = None
    color: str = ""


@dataclass(frozen=True)
class Line:
    """A row; a line without cells is a heading across the table."""

    name: str
    cells: Sequence[Cell] = ()
    kind: str = ""
    """"paper" for figures that are not ours."""


@dataclass(frozen=True)
class Table:
    caption: str
    head: Sequence[str]
    lines: Sequence[Line]
    small: Sequence[str] = field(default_factory=tuple)
    """Under each column's name, in small print."""


Value = TypeVar("Value")


def results(group: Group) -> Table:
    """Mean squared error of all rows, grouped; the smallest of each column is marked, the paper's aside."""
    by_label = group.rows
    models = [model.label for model in group.models]
    ours = [label for label in by_label if label in models or label in BASELINES]
    paper = [label for label in by_label if label not in ours]
    best = {a: min(by_label[m][a].mse_mean for m in ours if a in by_label[m]) for a in group.actions}
    means = {label: group.mean_error(label) for label in by_label}
    best_mean = min(means[label] for label in ours)
    lines = []
    for title, labels in (
        ("Models", models),
        ("Simple baselines, fitted on the training trials", [label for label in ours if label not in models]),
        ("As published in the paper", paper),
    ):
        if not labels:
            continue
        lines.append(Line(title))
        for label in labels:
            cells = []
            for action in group.actions:
                row = by_label[label].get(action)
                text = NONE if row is None else f"{_error(row.mse_mean)} ± {_error(row.mse_std)}"
                cells.append(Cell(text, best=label in ours and row is not None and row.mse_mean == best[action]))
            mean = means[label]
            marked = label in ours and mean == best_mean
            cells.append(
                Cell(
                    _error(mean),
                    best=marked,
                    share=min(1.0, mean / means["constant"]),
                    color="#0072B2" if label in models else "",
                )
            )
            lines.append(Line(label.removeprefix("paper "), cells, "paper" if label in paper else ""))
    counts = {a: f"{row.n_windows} windows, {row.n_trials} trials" for a, row in by_label["constant"].items()}
    caption = f"Mean squared error of the predicted windows [{unit(group)}], mean ± standard deviation over windows"
    return Table(caption, [*group.actions, "mean"], lines, [*(counts.get(a, "") for a in group.actions), "of actions"])


def unit(group: Group) -> str:
    """Of a squared error. Between humans it is what the paper calls cm."""
    return "m² × 100" if group.human_human else "rad²"


def states(group: Group) -> list[Table]:
    """Occupancy and duration of every state; one table for all variants that cut the trials alike."""
    tables = []
    for names, model in _alike(group.models):
        n_states = max(len(used.occupancy) for used in model.segmentation.values())
        lines = []
        for state in range(n_states):
            cells = []
            for action in group.actions:
                used = model.segmentation[action]
                share, seconds = used.occupancy[state], used.duration[state]
                cells.append(Cell(f"{share:.0%}", f"{seconds:.2f} s", share=share, color=state_color(state)))
            lines.append(Line(f"state {state}", cells))
        lines.append(Line("Per trial"))
        used = [model.segmentation[action] for action in group.actions]
        lines.append(Line("changes of state", [Cell(f"{one.changes:.1f}") for one in used]))
        lines.append(Line("back-transitions", [Cell(f"{one.back_transitions:.1f}") for one in used]))
        lines.append(Line("entropy of α", [Cell(f"{one.entropy:.3f}") for one in used]))
        tables.append(Table(f"Share of time and mean length of a visit, {names}", group.actions, lines))
    return tables


def agreement(group: Group) -> Table:
    """Human-only beside joint forward variable."""
    lines = []
    for model in group.models:
        cells = []
        for action in group.actions:
            used = model.segmentation[action]
            delay = f"{used.matched:.0%} matched"
            if used.delay is not None and used.delay_frames is not None:
                delay = f"{_signed(used.delay_frames, 1)} frames ({_signed(used.delay, 2)} s)\n{delay}"
            cells.append(Cell(f"{used.agreement:.0%}", delay, share=used.agreement))
        lines.append(Line(model.label, cells))
    caption = "Windows with the same active state, and median delay of the human-only change of state"
    return Table(caption, group.actions, lines)


def phase_tables(group: Group) -> list[Table]:
    """Mutual information of states and true phases, and errors of the boundaries; none where phases are unknown."""
    tables = []
    for names, model in _alike(group.models):
        fits = {action: fit for action, fit in model.phases.items() if fit is not None}
        if not fits:
            continue
        lines = [Line("Normalised mutual information", [])]
        lines.append(Line("human-only α", [Cell(f"{fit.nmi:.2f}", share=fit.nmi) for fit in fits.values()]))
        for other in group.models:
            if _cut(other) == _cut(model):
                own = [other.phases[action] for action in fits]
                cells = [
                    Cell(NONE) if fit is None else Cell(f"{fit.nmi_joint:.2f}", share=fit.nmi_joint) for fit in own
                ]
                lines.append(Line(f"joint α, {other.label}", cells))
        lines.append(Line("Delay of the boundary, median over trials"))
        for index, name in enumerate(BOUNDARIES):
            cells = []
            for fit in fits.values():
                one = fit.boundaries[index]
                found = f"{one.n_found} of {one.n_true} found"
                if one.delay is None or one.absolute is None:
                    cells.append(Cell(NONE, found))
                else:
                    cells.append(Cell(f"{_signed(one.delay, 2)} s", f"absolute {one.absolute:.2f} s\n{found}"))
            lines.append(Line(name, cells))
        lines.append(Line("Phase that a state stands for"))
        mappings = []
        for fit in fits.values():
            parts = []
            for phase, name in enumerate(PHASES):
                owned = [str(state) for state, of in enumerate(fit.phase_of_state) if of == phase]
                parts.append(f"{name} {', '.join(owned) or NONE}")
            mappings.append(Cell("", "\n".join(parts)))
        lines.append(Line("states", mappings))
        tables.append(Table(f"Active state beside the true phases, {names}", list(fits), lines))
    return tables


def calibrations(group: Group) -> list[Table]:
    """Coverage and energy scores, pooled over actions by windows, and then of each action."""
    unit = "m" if group.human_human else "rad"
    what = "positions" if group.human_human else "joints"
    head = [
        *(f"{level:.0%} ellipsoid" for level in LEVELS), "energy score", "mean alone",
        *(f"{level:.0%} interval" for level in LEVELS), "energy score", "mean alone",
    ]  # fmt: skip
    small = [*["latent"] * 4, *[what] * 2, *[f"{what} [{unit}]"] * 2]
    result = []
    for title, actions in (("All actions", [None]), ("Each action", group.actions)):
        lines = []
        for action in actions:
            if action is not None:
                lines.append(Line(action))
            for model in group.models:
                some = [one for name, one in model.calibration.items() if one is not None and action in (None, name)]
                lines.append(Line(model.label, _calibration_cells(some)))
        caption = f"{title}: coverage by the predictive covariance; energy score beside the distance of the mean alone"
        result.append(Table(caption, head, lines, small))
    return result


def _calibration_cells(some: Sequence[Calibration]) -> list[Cell]:
    if not some:
        return [Cell(NONE)] * (2 * len(LEVELS) + 4)
    weights = [one.n_windows for one in some]

    def pooled(value: Callable[[Calibration], float]) -> float:
        return float(np.average([value(one) for one in some], weights=weights))

    def shares(value: Callable[[Calibration], Sequence[float]]) -> list[Cell]:
        found = [pooled(lambda one, index=index: value(one)[index]) for index in range(len(LEVELS))]
        return [Cell(f"{share:.0%}", share=share) for share in found]

    return [
        *shares(lambda one: one.coverage),
        *(Cell(f"{pooled(value):.2f}") for value in (lambda one: one.energy, lambda one: one.energy_point)),
        *shares(lambda one: one.decoded_coverage),
        *(Cell(f"{pooled(value):.3f}") for value in (lambda one: one.decoded_energy, lambda one: one.decoded_point)),
    ]


def hands(group: Group) -> Table | None:
    """Error of the predicted hand in metres; None where it could not be measured."""
    if not any(one for model in group.models for one in model.hands.values()):
        return None
    best = {
        action: min((m.hands[action].mean for m in group.models if m.hands[action]), default=None)  # pyright: ignore[reportOptionalMemberAccess]
        for action in group.actions
    }
    lines = []
    for model in group.models:
        cells = []
        for action in group.actions:
            one = model.hands[action]
            if one is None:
                cells.append(Cell(NONE))
            else:
                text, note = f"{one.mean:.3f} ± {one.std:.3f}", f"90 % below {one.worst:.3f}"
                cells.append(Cell(text, note, best=len(group.models) > 1 and one.mean == best[action]))
        lines.append(Line(model.label, cells))
    what = "the second human's wrist" if group.human_human else "the robot's hand by forward kinematics"
    return Table(f"Distance of {what}, predicted to true [m], mean ± standard deviation", group.actions, lines)


def contacts(group: Group) -> Table | None:
    """Distance of the hands in contact for each controller; None without contact or robot."""
    actions = [a for a in group.actions if any(model.contact[a] for model in group.models)]
    if not actions:
        return None
    lines = []
    for model in group.models:
        found = [model.contact[action] for action in actions]
        cells = [
            Cell(NONE if one is None else " → ".join(f"{one.controllers[c]:.3f}" for c in COMPARED)) for one in found
        ]
        lines.append(Line(model.label, cells))
    found = [group.models[0].contact[action] for action in actions]
    cells = [Cell(NONE if one is None or one.truth is None else f"{one.truth:.3f}") for one in found]
    lines.append(Line("the true motion itself", cells, "paper"))
    counts = [NONE if one is None else f"{one.n_frames} frames" for one in found]
    return Table(
        f"Distance of the robot's hand from the human's while the recorded partners touch [m]: {' → '.join(COMPARED)}",
        actions,
        lines,
        counts,
    )


def state_color(state: int) -> str:
    """Colour of a state on strips, in tables and in plots."""
    return STATE_COLORS[state % len(STATE_COLORS)]


def _cut(model: Result) -> Mapping[str, tuple]:
    """What decides whether two variants cut the trials alike by the human-only forward variable."""
    return {a: (used.occupancy, used.duration, used.back_transitions) for a, used in model.segmentation.items()}


def _alike(models: Sequence[Result]) -> list[tuple[str, Result]]:
    """Variants that cut the trials alike, by their names, and one of them."""
    groups: list[list[Result]] = []
    for model in models:
        same = next((group for group in groups if _cut(group[0]) == _cut(model)), None)
        if same is None:
            groups.append([model])
        else:
            same.append(model)
    return [(", ".join(model.label for model in group), group[0]) for group in groups]


def _signed(value: float, digits: int) -> str:
    """With a sign, and a true minus; nothing before a zero."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text if text.strip("+−0.") else text[1:]


def _error(value: float) -> str:
    """Three decimals: more say nothing with a handful of trials."""
    return f"{value:.3f}"
