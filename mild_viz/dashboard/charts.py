"""The charts below the scene: static pictures of one rollout, one HTML snippet per lane.

Row n of the rollout lies at the same place in every lane, from 0 (first row) to 1000 (last) of the picture's width;
the time cursor is a line in every lane that one small style sheet moves (`cursor_html`). Colours are the theme's own
variables, so that a change of theme redraws nothing. Nothing is computed here: every curve is a field of the rollout.
"""

from __future__ import annotations

from functools import lru_cache
from html import escape

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.robot.control.rules import RULES, fired_rules
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import STATE_COLORS
from mild_viz.simulation.compare import Comparison
from mild_viz.trial import CONTACT_ACTIONS, PHASES

WIDTH, HEIGHT = 1000, 1000
"""Of a picture, in its own units: it is stretched to the lane."""
LANES = ("states", "rules", "alpha", "joints", "distance", "axis")
MAX_POINTS = 600
SEEK = " (click to go there)"
SEEK_EVENT = escape(
    "if (event.button === 0 && event.target.closest('.mv-plot, .mv-rows')) { "
    "document.querySelector('div:has(> div > .mv-timeline) .mantine-Slider-track')?.dispatchEvent("
    "new MouseEvent('mousedown', {clientX: event.clientX, clientY: event.clientY, bubbles: true})); "
    "event.preventDefault(); }"
)
"""What a lane does when it is pressed: the same as the frame bar at that place, so that it can be dragged too."""
RULE_COLORS = tuple(
    f"color-mix(in srgb, var(--mantine-color-{color}) {share}%, transparent)"
    for color, share in (("text", 14), ("orange-6", 55))
)
"""Rules of contact, and those of the safety filter."""
PHASE_COLORS = tuple(
    f"color-mix(in srgb, var(--mantine-color-text) {share}%, var(--mantine-color-body))" for share in (0, 30, 75, 15)
)
"""True phases: rest, reach, contact, return. Shades of the theme's ink: colours mean states."""


def state_color(state: int) -> str:
    """The colour of an HMM state, the same in the scene, the charts and the panel."""
    return STATE_COLORS[state % len(STATE_COLORS)]


def text_color(background: str) -> str:
    """Black or white, whichever reads better on `background` ('#rrggbb')."""
    red, green, blue = (int(background[i : i + 2], 16) for i in (1, 3, 5))
    return "#000" if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else "#fff"


def draw_lanes(rollout: Rollout, alpha_mode: str) -> dict[str, str]:
    """One snippet of HTML for each of `LANES`."""
    return {
        "states": _states(rollout),
        "rules": _rules(rollout),
        "alpha": _alpha(rollout.inference, alpha_mode),
        "joints": _joints(rollout),
        "distance": _distance(rollout),
        "axis": _axis(rollout.inference),
    }


def cursor_html(fraction: float) -> str:
    """The style that puts the time cursor of all lanes at a fraction (0 to 1) of the trial."""
    return f"<style>.mv-lane{{--mv-time:{100.0 * fraction:.2f}}}</style>"


def phase_names(action: str) -> dict[int, str]:
    """Names of the true phases; where the partners do not touch, the third one is no contact."""
    names: dict[int, str] = dict(enumerate(PHASES))
    if action not in CONTACT_ACTIONS:
        names[PHASES.index("contact")] = "waving"
    return names


def runs(values: Int[np.ndarray, " N"] | Bool[np.ndarray, " N"]) -> list[tuple[int, int, int]]:
    """Runs of equal values: (first row, last row + 1, value)."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values.astype(np.int64))) + 1])
    ends = np.append(starts[1:], len(values))
    return [(int(start), int(end), int(values[start])) for start, end in zip(starts, ends, strict=True)]


def _span(start: int, end: int, n_rows: int) -> tuple[float, float]:
    """Left edge and width, in percent, of rows start..end - 1: each row reaches half way to its neighbours."""
    last = max(n_rows - 1, 1)
    left, right = max(start - 0.5, 0.0) / last, min(end - 0.5, last) / last
    return 100.0 * left, 100.0 * (right - left)


def _line(values: Float[np.ndarray, " N"], low: float, high: float, css: str = "", color: str = "") -> str:
    """A polyline of one curve, broken where it is NaN; `low`..`high` fills the height."""
    rows = np.arange(len(values))
    step = -(-len(values) // MAX_POINTS)
    rows = np.unique(np.append(rows[::step], rows[-1]))
    x = rows * (WIDTH / max(len(values) - 1, 1))
    y = HEIGHT * (1.0 - (values[rows] - low) / max(high - low, 1e-9))
    style = f' class="{css}"' if css else f' style="stroke:{color}"'
    lines = []
    for start, end, valid in runs(np.isfinite(y)):
        if valid:
            pairs = np.stack([x[start:end], y[start:end]], axis=1).round().astype(int)
            # Python's own text of a list: SVG takes the numbers in any separation, and this is the quickest.
            points = str(pairs.ravel().tolist())[1:-1].replace(",", "")
            lines.append(f'<polyline{style} points="{points}"/>')
    return "".join(lines)


def _lane(name: str, note: str, plot: str, span: tuple[str, str] = ("", ""), css: str = "") -> str:
    note = f"<small>{note}</small>" if note else ""
    top, bottom = span
    return (
        f'<div class="mv-lane {css}" onmousedown="{SEEK_EVENT}"><div class="mv-name">{name}{note}</div>'
        f'<div class="mv-plot">{plot}<div class="mv-cursor"></div></div>'
        f'<div class="mv-range"><span>{top}</span><span>{bottom}</span></div></div>'
    )


def _svg(content: str) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none">{content}</svg>'


def _bands(mask: Bool[np.ndarray, " N"], css: str) -> str:
    """Shaded stretches of a chart, over its whole height."""
    bands = []
    for start, end, on in runs(mask):
        if on:
            left, width = _span(start, end, len(mask))
            bands.append(f'<rect class="{css}" x="{left * 10:.1f}" y="0" width="{width * 10:.1f}" height="{HEIGHT}"/>')
    return "".join(bands)


def _strip(
    values: Int[np.ndarray, " N"],
    css: str,
    colors: dict[int, str],
    names: dict[int, str],
    hints: dict[int, str] | None = None,
) -> str:
    """Coloured segments, each with its name where it fits, and its hint (or its name) under the mouse."""
    segments = []
    for start, end, value in runs(values):
        left, width = _span(start, end, len(values))
        color, name = colors[value], names[value]
        ink = text_color(color) if color.startswith("#") else "inherit"
        if color == PHASE_COLORS[PHASES.index("contact")]:
            ink = "var(--mantine-color-body)"
        shown = name if width > 0.75 * len(name) + 0.8 else ""
        hint = f"{(hints or names)[value]}{SEEK}".strip()
        segments.append(
            f'<div class="mv-segment" title="{hint}" style="left:{left:.2f}%;width:{width:.2f}%;'
            f'background:{color};color:{ink}">{shown}</div>'
        )
    return f'<div class="{css}">{"".join(segments)}</div>'


def _states(rollout: Rollout) -> str:
    inference = rollout.inference
    states = range(inference.n_states)
    colors, numbers = {s: state_color(s) for s in states}, {s: str(s) for s in states}
    strip = _strip(inference.active_state, "mv-strip", colors, numbers)
    contact_colors = {0: "transparent", 1: "var(--mantine-color-text)"}
    contact = _strip(rollout.contact.astype(np.int64), "mv-contact", contact_colors, {0: "", 1: ""})
    plot, note = strip + contact, ""
    if inference.phase is not None:
        phases = range(len(PHASES))
        names = phase_names(inference.action)
        plot += _strip(inference.phase, "mv-phase", {p: PHASE_COLORS[p] for p in phases}, {**names, 0: ""})
        note = "true phase"
    css = "mv-states mv-with-phase" if inference.phase is not None else "mv-states"
    return _lane("Active state", note, plot, css=css)


def _rules(rollout: Rollout) -> str:
    """Which rules fired when: those of contact above, those of the safety filter below; what they mean as hints."""
    strips = []
    for safety, css in ((False, "mv-strip"), (True, "mv-safety")):
        bits = sum(1 << number for number, rule in enumerate(RULES) if rule.safety == safety)
        values = rollout.fired & bits
        fired = {int(mask): fired_rules(int(mask)) for mask in np.unique(values)}
        colors = {mask: RULE_COLORS[safety] if mask else "transparent" for mask in fired}
        names = {mask: " · ".join(rule.name for rule in rules) for mask, rules in fired.items()}
        hints = {
            mask: "&#10;".join(f"{rule.name}: {escape(rule.text)}" for rule in rules) for mask, rules in fired.items()
        }
        strips.append(_strip(values, css, colors, names, hints))
    return _lane("Rules", "safety", "".join(strips), css="mv-fired")


@lru_cache(maxsize=8)  # a control-only rerun keeps the inference
def _alpha(inference: Inference, mode: str) -> str:
    alpha = np.exp(inference.log_alpha(mode))
    lines = "".join(_line(alpha[:, s], -0.03, 1.03, color=state_color(s)) for s in range(inference.n_states))
    plot = _svg(_grid(inference) + _bands(~inference.tracked, "mv-lost") + lines)
    return _lane("Forward variable", escape(mode), plot, ("1", "0"))


def _joints(rollout: Rollout) -> str:
    """One row per joint, each with its own range, so that truth, decoded and commanded can be told apart."""
    inference = rollout.inference
    degrees = [np.degrees(x) for x in (inference.joints_truth, inference.joints_decoded, rollout.joints_commanded)]
    n_joints = len(inference.joint_names)
    background = _grid(inference) + _bands(rollout.contact, "mv-touch") + _bands(~inference.tracked, "mv-lost")
    rows = []
    for j, name in enumerate(inference.joint_names):
        curves = [values[:, j] for values in degrees]
        known = np.concatenate([values[np.isfinite(values)] for values in curves])
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
        margin = max(0.08 * (high - low), 0.5)
        content = "".join(
            _line(values, low - margin, high + margin, css)
            for values, css in zip(curves, ("mv-truth", "mv-decoded", "mv-commanded"), strict=True)
        )
        plot = _svg(background + content)
        span = f"{low:.0f} to {high:.0f}°"
        rows.append(
            f'<div class="mv-row" style="height:{100 / n_joints:.3f}%"><div class="mv-name">{escape(name)}</div>'
            f'<div class="mv-plot">{plot}</div><div class="mv-range mv-one"><span>{span}</span></div></div>'
        )
    sample = '<svg viewBox="0 0 22 8"><line class="mv-{}" x1="0" x2="22" y1="4" y2="4"/></svg>'
    key = "".join(f'<span class="mv-key">{sample.format(css)}{css}</span>' for css in ("commanded", "decoded", "truth"))
    key += '<span class="mv-key"><i class="mv-patch"></i>contact states</span>'
    if not inference.tracked.all():
        key += '<span class="mv-key"><i class="mv-patch mv-gap"></i>tracking lost</span>'
    head = f'<div class="mv-head"><div class="mv-name">Joint angles</div>{key}</div>'
    cursor = '<div class="mv-over"><div class="mv-cursor"></div></div>'
    lane = f'<div class="mv-lane mv-joints" onmousedown="{SEEK_EVENT}">'
    return f'{lane}{head}<div class="mv-rows">{"".join(rows)}</div>{cursor}</div>'


def _distance(rollout: Rollout) -> str:
    """From the robot's hand to the human's wrist, broken where the wrist was not seen; and the stiffness, if it varies.

    The height of the lane is 100 % of stiffness.
    """
    tracked = rollout.inference.tracked
    centimetres = np.where(tracked, 100.0 * rollout.hand_distance, np.nan)
    known = centimetres[np.isfinite(centimetres)]
    high = float(known.max()) if len(known) else 1.0
    stiffness = rollout.stiffness.min(axis=1)
    varies = bool((stiffness < 1.0).any())
    plot = _svg(
        _grid(rollout.inference)
        + _bands(rollout.contact, "mv-touch")
        + _bands(~tracked, "mv-lost")
        + _line(centimetres, 0.0, 1.06 * high, "mv-commanded")
        + (_line(stiffness, 0.0, 1.06, "mv-stiffness") if varies else "")
    )
    return _lane("Robot hand to wrist", "dotted: stiffness" if varies else "", plot, (f"{high:.0f} cm", "0"))


def force_lane(rollout: Rollout, comparison: Comparison) -> str:
    """The largest force between the hands since the frame before, with full stiffness and with the schedule."""
    fixed, schedule = (comparison.motions[name] for name in ("fixed", "schedule"))
    high = max(float(fixed.force_peak.max()), float(schedule.force_peak.max()), 1.0)
    plot = _svg(
        _grid(rollout.inference)
        + _bands(schedule.gripped, "mv-touch")
        + _line(fixed.force_peak, 0.0, 1.06 * high, "mv-full")
        + _line(schedule.force_peak, 0.0, 1.06 * high, "mv-commanded")
    )
    return _lane("Hand force", "dashed: full stiffness", plot, (f"{high:.0f} N", "0"), "mv-force")


def tick_times(start: float, end: float) -> list[float]:
    """Round times between two [s] to mark on the axis: at most nine."""
    steps = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0]
    step = next((step for step in steps if (end - start) / step <= 8), max((end - start) / 8, 1e-9))
    first = int(np.ceil(start / step - 1e-9))
    return [i * step for i in range(first, int(np.floor(end / step + 1e-9)) + 1)]


def _ticks(inference: Inference) -> list[tuple[float, float]]:
    """The marks of the time axis: (time [s], fraction of the width)."""
    start, end = float(inference.time[0]), float(inference.time[-1])
    return [(t, (t - start) / max(end - start, 1e-9)) for t in tick_times(start, end)]


@lru_cache(maxsize=8)
def _grid(inference: Inference) -> str:
    lines = (f'<line x1="{WIDTH * f:.0f}" x2="{WIDTH * f:.0f}" y1="0" y2="{HEIGHT}"/>' for _, f in _ticks(inference))
    return f'<g class="mv-grid">{"".join(lines)}</g>'


@lru_cache(maxsize=8)
def _axis(inference: Inference) -> str:
    marks = "".join(f'<span style="left:{100 * f:.2f}%">{t:g}</span>' for t, f in _ticks(inference))
    return (
        '<div class="mv-lane mv-axis"><div class="mv-name"><small>time [s]</small></div>'
        f'<div class="mv-plot">{marks}</div><div class="mv-range"></div></div>'
    )
