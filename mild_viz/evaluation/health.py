"""Health of a trained model, in words: states that do nothing, covariances that collapsed, an idle forward variable."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from mild_viz.evaluation.calibration import LEVELS, Calibration
from mild_viz.evaluation.segmentation import Segmentation
from mild_viz.latent.hmm import HMM
from mild_viz.trial import CONTACT_ACTIONS

DEAD_OCCUPANCY = 0.002
"""A state that is active less often than one window in 500 is dead: less than a frame in each of these trials of
200 to 400 frames."""

NEAR_FLOOR = 1.1
"""Training adds its floor to every variance. An eigenvalue within 10 % of it means that the data vary by less than
a tenth of the floor in that direction: what the state knows there is the floor."""

LARGEST_CONDITION = 1e4
"""Ratio of eigenvalues from which a covariance counts as collapsed: its standard deviations differ by a factor of
100, and a hundredth of a standard deviation of noise along the thin direction decides which state is active."""

IDLE_ENTROPY = 0.8
"""Mean entropy, as a share of log S, from which the forward variable says little: as if 4 of 6 states or more were
equally likely in every window."""

ONE_STATE = 0.95
"""Share of windows in one state from which the others carry no segmentation: an interaction of 5 s is then cut into
one part but for a quarter of a second."""

ALIGNED = 0.5
"""Agreement of human-only and joint active state below which more windows are cut differently than alike."""

COVERED = 0.5
"""Share of truths within the 90 % ellipsoid below which the covariance is no measure of what may happen: half of
the outcomes are then called nearly impossible."""


KINDS = {
    "dead state": f"States that are active in fewer than {DEAD_OCCUPANCY:.1%} of the training windows: the model works "
    "with fewer states than it has:",
    "collapsed covariance": "States whose covariance is flat in some direction: what they know there is the floor that "
    "training adds, and tiny deviations decide which state is active:",
    "idle forward variable": "The forward variable is not informative: it hardly tells states apart or changes:",
    "no contact state": "No contact state is set for an interaction in which the partners touch, so that mild-ik never "
    "adapts the hand:",
    "worse than a constant": "The prediction is no better than the mean partner window of the action. Its error "
    "as a multiple of that one's:",
    "misaligned encoder": "Human-only and joint forward variable disagree in most windows: the partner's encoder and "
    "the state model have drifted apart, or the human's motion does not show the partner's. Windows in the same state:",
    "overconfident": "The predictive covariance calls most of what happens nearly impossible: it is too small, or the "
    "partner's encoder and the state model have drifted apart. True latents within the 90 % ellipsoid:",
}
"""What each kind of warning means, and which figure follows, worst first."""


@dataclass(frozen=True)
class Warning:
    """Something that a person should know before reading the figures."""

    kind: str
    """One of `KINDS`."""
    model: str
    action: str
    detail: str
    """The figure that it rests on."""

    def __str__(self) -> str:
        return f"{self.model}, {self.action}: {self.kind}. {KINDS[self.kind]} {self.detail}"


def dead_states(model: str, used: Segmentation) -> list[Warning]:
    """States that are hardly ever active in these trials (those that the model was trained on)."""
    dead = [state for state, share in enumerate(used.occupancy) if share < DEAD_OCCUPANCY]
    return [Warning("dead state", model, used.action, _states(dead))] if dead else []


def collapsed_covariances(model: str, action: str, hmm: HMM, floor: float | None) -> list[Warning]:
    """States whose covariance is flat in some direction; `floor` is what training added to each variance, if known."""
    eigenvalues = np.linalg.eigvalsh(hmm.emission_covariances)
    condition = eigenvalues[:, -1] / eigenvalues[:, 0]
    at_floor = eigenvalues[:, 0] < NEAR_FLOOR * (floor or 0.0)
    warnings = []
    for found, why in (
        (at_floor, f"smallest eigenvalue {eigenvalues[:, 0].min():.2g}, floor {floor or 0.0:.2g}"),
        (~at_floor & (condition > LARGEST_CONDITION), f"eigenvalues differ by a factor of {condition.max():.2g}"),
    ):
        states = np.flatnonzero(found).tolist()
        if states:
            warnings.append(Warning("collapsed covariance", model, action, f"{_states(states)}: {why}"))
    return warnings


def idle_alpha(model: str, used: Segmentation) -> list[Warning]:
    """A forward variable that does not segment: undecided, in one state, or without any change."""
    share = max(used.occupancy)
    if used.entropy > IDLE_ENTROPY:
        detail = f"its mean entropy is {used.entropy:.0%} of the largest"
    elif used.changes == 0:
        detail = "the active state never changes"
    elif share > ONE_STATE:
        detail = f"state {used.occupancy.index(share)} is active in {share:.0%} of the windows"
    else:
        return []
    return [Warning("idle forward variable", model, used.action, detail)]


def misaligned(model: str, used: Segmentation) -> list[Warning]:
    """Human-only and joint forward variable that cut most windows differently."""
    if used.agreement >= ALIGNED:
        return []
    return [Warning("misaligned encoder", model, used.action, f"{used.agreement:.0%}")]


def overconfident(model: str, action: str, measured: Calibration) -> list[Warning]:
    """A predictive covariance that misses most of what happens."""
    inside = measured.coverage[LEVELS.index(0.9)]
    if inside >= COVERED:
        return []
    return [Warning("overconfident", model, action, f"{inside:.0%}")]


def without_contact_state(model: str, action: str, states: Collection[int]) -> list[Warning]:
    """An action in which the partners touch, for which the model knows no contact state."""
    if action not in CONTACT_ACTIONS or states:
        return []
    return [Warning("no contact state", model, action, "none set")]


def worse_than_constant(model: str, action: str, error: float, constant: float) -> list[Warning]:
    """A mean squared error that the mean of the training windows reaches too."""
    if error < constant:
        return []
    return [Warning("worse than a constant", model, action, f"{error / constant:.1f}")]


def _states(states: Sequence[int]) -> str:
    return f"state{'s' if len(states) > 1 else ''} {', '.join(map(str, states))}"
