"""The page's figures: error over time, latent trajectories. Drawn by Matplotlib as SVG, without its global state."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mild_viz.evaluation.page.measure import Group, Result
from mild_viz.evaluation.page.tables import state_color
from mild_viz.evaluation.passes import Pass
from mild_viz.evaluation.segmentation import entries

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # texts stay texts: small, and in the page's own font
    "svg.hashsalt": "mild_viz",  # the same figure is the same file
    "text.parse_math": False,  # a checkpoint's name may hold a dollar sign
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a8f98",
    "axes.labelcolor": "#4a4f57",
    "xtick.color": "#4a4f57",
    "ytick.color": "#4a4f57",
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "axes.linewidth": 0.7,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
}

LINES = {"constant": ("#8C8C8C", (0, (4, 2))), "ridge": ("#D55E00", (0, (5, 1.5, 1, 1.5)))}
"""Colour and dashes of the baselines' curves: they differ in both, for readers who see no colour."""

MODEL_COLOR = "#0072B2"

MOST_TRIALS = 12
"""Trajectories that a latent plot shows at most; more hide one another."""

BAND = (0.1, 0.9)
"""Quantiles of the trials between which a curve's band lies; of two or three trials that is nearly their range."""

SMOOTHING = 0.3
"""Curves are means over this much time [s]."""


def error_curves(group: Group) -> str:
    """Error over time of every action: the best variant beside baselines; median and `BAND` of trials."""
    with _style():
        figure, axes = _grid(len(group.actions), 2.3)
        for ax, action in zip(axes, group.actions, strict=True):
            rate = group.best.passes[action][0].trial.rate
            for name, (color, dashes) in LINES.items():
                _curve(ax, group.baselines[name][action], rate, color, dashes, name)
            _curve(ax, [one.errors for one in group.best.passes[action]], rate, MODEL_COLOR, "-", group.best.label)
            ax.set_title(action)
            ax.set_yscale("log")  # errors of one trial span three orders of magnitude
            ax.yaxis.set_major_formatter(lambda value, position: f"{value:g}")
            ax.yaxis.grid(True, color="#e6e8eb", linewidth=0.6)
            ax.set_xlim(left=0.0)
            ax.set_xlabel("time [s]")
            ax.set_ylabel("error [m² × 100]" if group.human_human else "error [rad²]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], loc="outside upper right", ncols=3, frameon=False)
        return _svg(figure)


def latent_plots(model: Result, action: str) -> str:
    """Human and partner latents of an action's test trials in the plane of their largest variance, with the states.

    Lines have the colour of the active state; the recorded partner, encoded, is drawn in grey. An ellipse holds the
    state's mean and two standard deviations, as that plane shows them.
    """
    passes = model.passes[action]
    keep = np.unique(np.linspace(0, len(passes) - 1, min(MOST_TRIALS, len(passes))).round().astype(int))
    shown = [passes[index] for index in keep]
    size = shown[0].human_mean.shape[1]
    partner = "second human" if shown[0].human_human else "robot"
    with _style():
        figure, (left, right) = _grid(2, 3.3)
        _latent(left, f"{action}: human", shown, [one.human_mean for one in shown], [], slice(0, size))
        means, truths = [one.partner_mean for one in shown], [one.partner_truth for one in shown]
        _latent(right, f"{action}: {partner}, predicted", shown, means, truths, slice(size, 2 * size))
        return _svg(figure)


def principal_plane(
    points: Float[np.ndarray, "N D"],
) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, "2 D"], Float[np.ndarray, "2"]]:
    """Mean, two orthonormal directions of largest variance, and their shares of the variance (PCA)."""
    mean = points.mean(0)
    _, singular, directions = np.linalg.svd(points - mean, full_matrices=False)
    share = singular**2 / max(float((singular**2).sum()), 1e-300)
    return mean, directions[:2], share[:2]


def _latent(
    ax: Axes,
    title: str,
    passes: Sequence[Pass],
    tracks: Sequence[Float[np.ndarray, "_ D"]],
    truths: Sequence[Float[np.ndarray, "_ D"]],
    dimensions: slice,
) -> None:
    from matplotlib.patches import Ellipse
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.5, foreground="white")]
    hmm = passes[0].hmm.marginal(dimensions)
    finite = np.concatenate([track[np.isfinite(track).all(1)] for track in (*tracks, *truths)])
    mean, plane, share = principal_plane(finite)
    for truth in truths:
        x, y = ((truth - mean) @ plane.T).T
        ax.plot(x, y, color="#c2c6cc", linewidth=0.8, zorder=1)
    for one, track in zip(passes, tracks, strict=True):
        x, y = ((track - mean) @ plane.T).T
        starts = entries(one.active)
        for start, end in zip(starts, [*starts[1:], len(x)], strict=True):
            run = slice(start, end + 1)  # to the first point of the next run: the line has no gaps
            ax.plot(x[run], y[run], color=state_color(int(one.active[start])), linewidth=0.9, alpha=0.8, zorder=2)
    for state in range(hmm.n_states):
        center = plane @ (hmm.emission_means[state] - mean)
        values, vectors = np.linalg.eigh(plane @ hmm.emission_covariances[state] @ plane.T)
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        width, height = 4.0 * np.sqrt(values[::-1].clip(0.0))
        color = state_color(state)
        ax.add_patch(Ellipse(tuple(center), width, height, angle=angle, facecolor=color, alpha=0.16, zorder=3))
        ax.add_patch(Ellipse(tuple(center), width, height, angle=angle, fill=False, edgecolor=color, lw=1.2, zorder=3))
        ax.text(
            center[0],
            center[1],
            str(state),
            ha="center",
            va="center",
            fontsize=9,
            fontweight="bold",
            zorder=4,
            path_effects=halo,
        )
    ax.autoscale_view()
    ax.set_title(title)
    ax.set_xlabel(f"1st component ({share[0]:.0%} of variance)")
    ax.set_ylabel(f"2nd ({share[1]:.0%})")
    ax.set_aspect("equal", adjustable="datalim")


def _curve(ax: Axes, errors: Sequence[Float[np.ndarray, " _"]], rate: float, color: str, dashes, label: str) -> None:
    """Median and band over the trials that last so long."""
    longest = max(len(trial) for trial in errors)
    table = np.full((len(errors), longest), np.nan)
    for row, trial in zip(table, errors, strict=True):
        row[: len(trial)] = _moving_mean(trial, max(1, round(SMOOTHING * rate)))
    seen = np.isfinite(table).any(0)
    time = np.flatnonzero(seen) / rate
    table = table[:, seen]
    if label != "constant":  # its band hides the others
        low, high = np.nanquantile(table, BAND, axis=0)
        ax.fill_between(time, low, high, color=color, alpha=0.13, linewidth=0)
    ax.plot(time, np.nanmedian(table, 0), color=color, linestyle=dashes, linewidth=1.4, label=label)


def _moving_mean(values: Float[np.ndarray, " N"], width: int) -> Float[np.ndarray, " N"]:
    """Centred, over those that are known."""
    kernel, known = np.ones(width), np.isfinite(values)
    total = np.convolve(np.where(known, values, 0.0), kernel, "same")[: len(values)]
    count = np.convolve(known.astype(float), kernel, "same")[: len(values)]
    return np.where(known & (count > 0), total / np.maximum(count, 1.0), np.nan)


def _style():
    from matplotlib import rc_context

    return rc_context(STYLE)


def _grid(n: int, height: float) -> tuple[Figure, Sequence[Axes]]:
    from matplotlib.figure import Figure

    columns = min(n, 2)
    rows = -(-n // columns)
    figure = Figure(figsize=(9.6, height * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for extra in axes[n:]:
        extra.remove()
    return figure, list(axes[:n])


def _svg(figure: Figure) -> str:
    """An <svg> element to stand in a page: no prolog, no names of elements, two decimals."""
    buffer = io.StringIO()
    figure.savefig(
        buffer, format="svg", transparent=True, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
    )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<(g|text) id="[\w.]+"', r"<\1", text)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)  # a page knows them by itself
    text = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d\d)\d+", r"\1", tag[0]), text)
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', "", text, count=1)
    return re.sub(r"\n\s*", "\n", text).strip()
