"""The tables of an evaluation: which figures stand where, how they are rounded, what is said below them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.metrics import Row
from mild_viz.evaluation.runs import MEAN, OverRuns
from mild_viz.evaluation.significance import LEVEL, N_RESAMPLES, POOLED, SEED, Comparison
from mild_viz.evaluation.tables import TextTable


def error_table(rows: Sequence[Row], caption: str) -> TextTable:
    """Models down, actions across; the last column is the mean over actions. Our lowest figures are bold."""
    actions = list(dict.fromkeys(row.action for row in rows))
    counts = {row.action: f"\n{row.n_windows} windows, {row.n_trials} trials" for row in rows if row.n_windows}
    several = any(row.checkpoint for row in rows)
    lines: dict[tuple[str, str | None], dict[str, Row]] = {}
    for row in rows:
        lines.setdefault((row.model, row.checkpoint), {})[row.action] = row
    digits = _digits([row.mse_mean for row in rows])
    first = 2 if several else 1
    sections: dict[str, list[tuple[str, ...]]] = {"variant": [], "baseline": [], "paper": []}
    values = []
    for (model, checkpoint), cells in lines.items():
        kind = "paper" if model.startswith("paper") else "baseline" if model in BASELINES else "variant"
        means = [cells[action].mse_mean if action in cells else np.nan for action in actions]
        texts = [
            f"{cells[action].mse_mean:.{digits}f} ± {cells[action].mse_std:.{digits}f}" if action in cells else ""
            for action in actions
        ]
        names = (model, checkpoint or "") if several else (model,)
        sections[kind].append((*names, *texts, f"{np.mean(means):.{digits}f}"))
        if kind != "paper":
            values.append([*means, np.mean(means)])
    return TextTable(
        caption,
        ("model", *(["checkpoint"] if several else []), *(action + counts.get(action, "") for action in actions), MEAN),
        tuple(tuple(section) for section in sections.values() if section),
        frozenset(range(first)),
        frozenset((row, first + column) for row, column in _lowest(np.array(values), digits)),
    )


def runs_table(summaries: Sequence[OverRuns], unit: str) -> TextTable:
    """Best and median of every model over its runs."""
    columns = tuple(summaries[0].errors)
    digits = _digits([value for one in summaries for value in one.errors.values()])
    source, n_runs = summaries[0].source, sorted({one.n_runs for one in summaries})
    caption = (
        f"Best and median over {' or '.join(map(str, n_runs))} {'seeds' if summaries[0].recorded else 'checkpoints'}"
        f": mean squared error in {unit}"
    )
    notes = ["Best: the run with the lowest mean on this test split, an optimistic choice. Median: column by column."]
    if summaries[0].recorded:
        notes.append(f"From the {source}, written when it was trained: not measured now.")
    rows = tuple(
        (
            one.model,
            f"best ({one.run})" if one.run else one.statistic,
            *(f"{one.errors[column]:.{digits}f}" for column in columns),
        )
        for one in summaries
    )
    return TextTable(caption, ("model", "over runs", *columns), (rows,), frozenset({0, 1}), notes=tuple(notes))


def comparison_table(comparisons: Sequence[Comparison], unit: str, each_action: bool) -> TextTable:
    """Pairs of predictors and the tests between them; in sections by pair if single actions are shown."""
    shown = [one for one in comparisons if each_action or one.action == POOLED]
    sections: dict[tuple[str, str], list[tuple[str, ...]]] = {}
    digits = _digits([abs(one.difference) for one in comparisons])
    for one in shown:
        section = sections.setdefault((one.first, one.second), [])
        tests = (
            (one.mann_whitney_p, one.mann_whitney_p_holm),
            (one.sign_flip_p, one.sign_flip_p_holm),
            (one.wilcoxon_p, one.wilcoxon_p_holm),
        )
        section.append(
            (
                "" if section else f"{one.first} − {one.second}",
                *([one.action] if each_action else []),
                f"{one.n_trials} ({_p(one.smallest_p)})",
                f"{one.difference:+.{digits}f}",
                "" if np.isnan(one.low) else f"[{one.low:+.{digits}f}, {one.high:+.{digits}f}]",
                _bare(f"{one.a12:.2f}"),
                *(f"{_p(p)} ({_p(corrected)})" for p, corrected in tests),
                one.conclusion,
            )
        )
    header = (
        "first − second", *(["action"] if each_action else []), "trials\n(smallest p)", f"difference\n[{unit}]",
        "95 % interval\nover trials", "A12", "Mann-Whitney U\nover windows\np (Holm)",
        "sign-flip\nover trials\np (Holm)", "Wilcoxon\nover trials\np (Holm)", "conclusion",
    )  # fmt: skip
    rows = list(sections.values())
    grouped = rows if each_action else [[row for section in rows for row in section]]
    words = {0, 1, len(header) - 1} if each_action else {0, len(header) - 1}
    return TextTable(
        "Differences between predictors" + ("" if each_action else ", over all actions"),
        header,
        tuple(tuple(section) for section in grouped),
        frozenset(words),
        notes=tuple(_notes(shown)),
    )


def _notes(shown: Sequence[Comparison]) -> list[str]:
    """What must be known to read the comparisons, and in words where there are too few trials."""
    n_pooled = sum(one.action == POOLED for one in shown)
    n_single = len(shown) - n_pooled
    families = f"{n_pooled} over all actions" + (f", and apart from them {n_single} of single actions" * bool(n_single))
    notes = [
        "Difference: mean error of the first minus the second, below 0 where the first is better; over all actions, "
        f"every action counts equally. Interval: whole trials resampled within their action ({N_RESAMPLES} times, "
        f"seed {SEED}), expanded percentiles, not corrected for the number of comparisons; from two or three "
        "trials it covers far less than 95 %.",
        "Smallest p: what the tests over trials can give at best with so many trials.",
        "A12: chance that a window of the first has the larger error (.5: neither; below .29 or above .71: large).",
        "Mann-Whitney U is the paper's window-level test. Windows of a trial overlap and are not independent, "
        "so its p is too small; it is given for comparison with the paper, and nothing is concluded from it.",
        "Sign-flip and Wilcoxon's signed-rank test are paired and two-sided, on the mean errors of the trials. "
        f"Holm's correction: {families}. The conclusion follows the corrected sign-flip test at {LEVEL}.",
    ]
    few = sorted({one.n_trials for one in shown if one.smallest_p > LEVEL})
    if few:
        limits = ", ".join(f"{n} trial{'s' * (n > 1)} give no p below {2 / 2**n:.2g}" for n in few)
        notes.append(
            f"Too few to conclude anything: {limits}, however large the difference. Six trials at least are needed."
        )
    many = [one for one in shown if one.smallest_p <= LEVEL < one.smallest_p_holm]
    if many:
        notes.append(
            f"Too many comparisons for so few trials: after Holm's correction no p below "
            f"{min(one.smallest_p_holm for one in many):.2g} is possible. Compare fewer predictors."
        )
    return notes


def _p(value: float) -> str:
    return "<.001" if value < 0.001 else _bare(f"{value:.3f}")


def _bare(number: str) -> str:
    """A number that cannot exceed 1, without its leading zero."""
    return number.removeprefix("0") if number.startswith("0.") else number


def _digits(values: Sequence[float]) -> int:
    """Decimals: three as in the paper, four where a figure would keep less than two significant ones."""
    positive = [value for value in values if value > 0]
    return 3 if not positive or min(positive) >= 0.00995 else 4


def _lowest(values: np.ndarray, digits: int) -> list[tuple[int, int]]:
    """Rows and columns of the lowest value of every column, as printed: ties are all lowest."""
    rounded = np.round(np.where(np.isnan(values), np.inf, values), digits)
    return [(int(row), int(column)) for row, column in np.argwhere(rounded == rounded.min(0))]
