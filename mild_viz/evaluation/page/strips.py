"""The forward variable of a trial as strips: runs of equal colour, to be drawn as rectangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mild_viz.evaluation.page.tables import state_color
from mild_viz.evaluation.passes import Pass
from mild_viz.evaluation.segmentation import entries
from mild_viz.robot.contact import contact_frames
from mild_viz.trial import CONTACT_ACTIONS, PHASES

PHASE_COLORS = ("#E8E8E8", "#B5B5B5", "#3D3D3D", "#8A8A8A")
"""Greys of the true phases: rest, reach, contact, return."""

CERTAINTY = (0.9, 0.6)
"""Below these probabilities of the active state a run is drawn paler, in two steps."""

OPACITY = (1.0, 0.65, 0.35)


@dataclass(frozen=True)
class Run:
    """Windows `start` to `start + length` alike."""

    start: int
    length: int
    color: str
    opacity: float
    title: str


@dataclass(frozen=True)
class Strip:
    name: str
    runs: Sequence[Run]


@dataclass(frozen=True)
class TrialStrips:
    """The strips of one trial, above one another; `share` is its length as a part of the longest one of its action."""

    name: str
    n_windows: int
    seconds: float
    share: float
    strips: Sequence[Strip]


def trial_strips(passes: Sequence[Pass]) -> list[TrialStrips]:
    """Strips of the trials of one action: human-only α, joint α, and what is known of the truth."""
    lengths = [len(one.active) / one.trial.rate for one in passes]
    return [
        TrialStrips(one.trial.name, len(one.active), length, length / max(lengths), _strips(one))
        for one, length in zip(passes, lengths, strict=True)
    ]


def truth_colors(passes: Sequence[Pass]) -> list[tuple[str, str]]:
    """Legend of the strips that show the truth."""
    if any(one.phase is not None for one in passes):
        return list(zip(PHASES, PHASE_COLORS, strict=True))
    if any(contact_frames(one.trial)[one.newest].any() for one in passes):
        return [("hands touch", PHASE_COLORS[2])]
    return []


def _strips(one: Pass) -> list[Strip]:
    strips = [Strip("human-only α", _alpha(one, one.log_alpha)), Strip("joint α", _alpha(one, one.log_alpha_joint))]
    if one.phase is not None:
        names = [(PHASES[phase], PHASE_COLORS[phase], 1.0) for phase in one.phase]
        strips.append(Strip("true phase", _runs(one.phase, names, one.trial.rate)))
    elif one.trial.action in CONTACT_ACTIONS and (touching := contact_frames(one.trial)[one.newest]).any():
        looks = [("hands touch" if touch else "apart", PHASE_COLORS[2 if touch else 0], 1.0) for touch in touching]
        strips.append(Strip("hands touch", _runs(touching.astype(int), looks, one.trial.rate)))
    return strips


def _alpha(one: Pass, log_alpha: np.ndarray) -> list[Run]:
    states, certain = log_alpha.argmax(1), np.exp(log_alpha.max(1))
    level = (certain[:, None] < np.array(CERTAINTY)).sum(1)
    looks = [
        (f"state {state}", state_color(int(state)), OPACITY[step]) for state, step in zip(states, level, strict=True)
    ]
    return _runs(states * len(OPACITY) + level, looks, one.trial.rate)


def _runs(keys: np.ndarray, looks: Sequence[tuple[str, str, float]], rate: float) -> list[Run]:
    starts = entries(keys)
    runs = []
    for start, end in zip(starts, [*starts[1:], len(keys)], strict=True):
        name, color, opacity = looks[start]
        unsure = "" if opacity == 1.0 else ", unsure"
        runs.append(
            Run(
                int(start),
                int(end - start),
                color,
                opacity,
                f"{name}{unsure}: {start / rate:.1f} to {end / rate:.1f} s",
            )
        )
    return runs
