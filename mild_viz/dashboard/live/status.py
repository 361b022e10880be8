"""The panel of live operation, as HTML: phase, state, latency, what came and went, what went wrong, the thresholds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from html import escape

import numpy as np

from mild_viz.dashboard.charts import state_color
from mild_viz.live.config import LiveConfig
from mild_viz.live.feed import Figures, Snapshot
from mild_viz.live.latency import Times
from mild_viz.live.onset import CALIBRATING, INTERACTING, RETURNING, WAITING
from mild_viz.robot.control.rules import RULES

PHASE_TEXTS = {
    CALIBRATING: "calibrating: let the hand rest",
    WAITING: "waiting: reach out to begin",
    INTERACTING: "interacting",
    RETURNING: "returning to rest",
}
PHASE_COLORS = {CALIBRATING: "#868e96", WAITING: "#1c7ed6", INTERACTING: "#2b8a3e", RETURNING: "#e67700"}

SPAN = 10.0
"""Seconds that the chart shows."""

TEXTS = {rule.name: rule.text for rule in RULES}

STATUS_CSS = """
.mv-phase-now { display: inline-block; padding: 3px 10px; border-radius: 4px; color: #fff; font-weight: 600; }
.mv-figures { border-collapse: collapse; width: 100%; font-size: 12px; font-variant-numeric: tabular-nums; }
.mv-figures td { padding: 1px 4px 1px 0; vertical-align: top; }
.mv-figures td:last-child { text-align: right; white-space: nowrap; }
.mv-status { padding: 0 12px 8px; font-size: 12px; line-height: 1.45; color: var(--mantine-color-text);
  overflow-wrap: anywhere; }
.mv-status h4 { margin: 6px 0 2px; font-size: 12px; }
.mv-rolling { width: 100%; height: 64px; display: block; border: 1px solid var(--mantine-color-default-border); }
.mv-rolling polyline { fill: none; stroke-width: 1.6; vector-effect: non-scaling-stroke; }
"""


class Rolling:
    """The forward variable of the last seconds, as lines."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, np.ndarray | None]] = deque()

    def add(self, now: Snapshot) -> None:
        """Take a snapshot over."""
        alpha = np.exp(now.log_alpha) if now.phase == INTERACTING and np.isfinite(now.log_alpha).all() else None
        self._points.append((now.time, alpha))
        while self._points[0][0] < now.time - SPAN:
            self._points.popleft()

    def html(self) -> str:
        """The chart; each state in its colour, as everywhere."""
        if not self._points:
            return ""
        end = self._points[-1][0]
        lines: list[list[tuple[float, np.ndarray]]] = [[]]
        for time, alpha in self._points:
            if alpha is None:
                if lines[-1]:
                    lines.append([])
            else:
                lines[-1].append((100.0 * (1.0 - (end - time) / SPAN), alpha))
        drawn = []
        for line in lines:
            for state in range(len(line[0][1]) if line else 0):
                points = " ".join(f"{x:.1f},{100.0 * (1.0 - alpha[state]):.0f}" for x, alpha in line)
                drawn.append(f'<polyline points="{points}" stroke="{state_color(state)}"/>')
        return (
            f'<div class="mv-status"><h4>Forward variable α, last {SPAN:g} s</h4>'
            f'<svg class="mv-rolling" viewBox="0 -4 100 108" preserveAspectRatio="none">{"".join(drawn)}</svg></div>'
        )


def now_html(now: Snapshot, config: LiveConfig) -> str:
    """What holds now."""
    color, text = PHASE_COLORS[now.phase], PHASE_TEXTS[now.phase]
    rows = []
    if now.phase == INTERACTING and np.isfinite(now.log_alpha).all():
        state = int(now.log_alpha.argmax())
        swatch = f'<span class="mv-swatch" style="background:{state_color(state)}"></span>'
        rows.append(("Active state", f"{swatch}{state}, {100 * math.exp(now.log_alpha[state]):.0f} %"))
    else:
        rows.append(("Active state", "–"))
    away = f"{100 * now.displacement:.1f} cm" if math.isfinite(now.displacement) else "–"
    rows += [
        ("Hand from its resting place", away),
        ("Contact", "yes" if now.contact else "no"),
        ("Stiffness", f"{100 * now.stiffness:.0f} %"),
        ("Interactions", str(now.interaction)),
        ("Last command answers", "a frame" if now.answers else "nothing: no frame came"),
    ]
    fired = "".join(f"<br><b>{escape(name)}</b>: {escape(TEXTS.get(name, 'a fault; the last command is held'))}"
                    for name in now.fired)  # fmt: skip
    note = f"<br>{escape(now.note)}" if now.note else ""
    return (
        f'<div class="mv-status"><span class="mv-phase-now" style="background:{color}">{text}</span>{note}'
        f"{table(rows)}<h4>Rules that fired</h4>{fired.removeprefix('<br>') or 'none'}</div>"
    )


def figures_html(figures: Figures, page_behind: int) -> str:
    """Latency, rates and counts."""
    seen, done, out = figures.input_counts or {}, figures.counts or {}, figures.output_counts or {}
    rows = [
        ("Computing, median / 99 %", times(figures.computing)),
        ("Frame to command, median / 99 %", times(figures.whole)),
        ("Frames in / commands out", f"{figures.rate_in:.0f} / {figures.rate_out:.0f} a second"),
    ]
    counts = [
        ("Frames received", seen.get("received", 0)),
        ("rejected as unusable", seen.get("rejected", 0)),
        ("late, repeated", f"{seen.get('reordered', 0)}, {seen.get('duplicated', 0)}"),
        ("of other senders", seen.get("foreign", 0)),
        ("left out for newer ones", seen.get("skipped", 0)),
        ("too old, without an arm", f"{done.get('stale', 0)}, {done.get('untracked', 0)}"),
        ("Commands sent", out.get("sent", 0)),
        ("dropped, failed", f"{out.get('dropped', 0)}, {out.get('failed', 0)}"),
        ("made without a frame", done.get("held", 0)),
        ("cut by the last check", figures.refused),
        ("Clock jumps, faults", f"{figures.clock_jumps}, {figures.faults}"),
        ("Frames this page left out", page_behind),
    ]
    if figures.recorded is not None:
        counts.append(("Turns recorded", figures.recorded))
    return f'<div class="mv-status"><h4>Latency</h4>{table(rows)}<h4>Counts</h4>{table(counts)}</div>'


def trouble_html(figures: Figures, silent: float) -> str:
    """What is wrong; empty where nothing is."""
    lines = list(figures.troubles)
    if silent > 1.0:
        lines.insert(0, f"No word from the control process for {silent:.0f} s: what is shown is old")
    for label, text in (
        ("Last fault", figures.last_fault),
        ("Last error of the input", (figures.input_counts or {}).get("last_error", "")),
        ("Last error of the output", (figures.output_counts or {}).get("last_error", "")),
    ):
        if text:
            lines.append(f"{label}: {text}")
    if not lines:
        return ""
    return f'<div class="mv-error" role="alert">{"<br>".join(escape(line) for line in lines)}</div>'


def config_html(config: LiveConfig) -> str:
    """Every threshold."""
    rows = [(name.replace("_", " "), f"{value:g}") for name, value in vars(config).items() if value is not None]
    return f'<div class="mv-status"><h4>Thresholds [s, m, m/s, Hz]</h4>{table(rows)}</div>'


def header_html(setup: Mapping[str, str]) -> str:
    """What runs."""
    return (
        f'<div class="mv-header"><b>Live · {escape(setup["action"])} · {escape(setup["variant"])}</b><br>'
        f"model {escape(setup['model'])}, controller {escape(setup['controller'])}<br>"
        f"from {escape(setup['input'])}<br>to {escape(setup['output'])}</div>"
    )


def times(value: Times) -> str:
    """Milliseconds."""
    if not math.isfinite(value.median):
        return "–"
    return f"{1e3 * value.median:.2f} / {1e3 * value.p99:.2f} ms"


def table(rows: Iterable[tuple[str, object]]) -> str:
    """Two columns. Names are ours; values may hold our own markup."""
    body = "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows)
    return f'<table class="mv-figures">{body}</table>'
