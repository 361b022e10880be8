"""Health of a trained model, in words: states that do nothing, covariances that collapsed, an idle forward variable."""

from __future__ import annotations

from collections.abc import Sequence
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


@dataclass(frozen=True)
class Warning:
    """Something that a person should know before reading the figures."""

    kind: str
    """dead state, collapsed covariance, idle forward variable, misaligned encoder, overconfident, no contact state."""
    where: str
    """Model and action."""
    text: str


def dead_states(where: str, used: Segmentation) -> list[Warning]:
    """States that are hardly ever active in these trials (those that the model was trained on)."""
    dead = [state for state, share in enumerate(used.occupancy) if share < DEAD_OCCUPANCY]
    if not dead:
        return []
    states = f"state {dead[0]} is" if len(dead) == 1 else f"states {', '.join(map(str, dead))} are"
    text = (
        f"{states} active in fewer than {DEAD_OCCUPANCY:.1%} of {used.n_windows} training windows: dead. "
        "The model works with fewer states than it has"
    )
    return [Warning("dead state", where, text)]


def collapsed_covariances(where: str, hmm: HMM, floor: float | None) -> list[Warning]:
    """States whose covariance is flat in some direction; `floor` is what training added to each variance, if known."""
    eigenvalues = np.linalg.eigvalsh(hmm.emission_covariances)
    smallest, condition = eigenvalues[:, 0], eigenvalues[:, -1] / eigenvalues[:, 0]
    warnings = []
    for state in range(hmm.n_states):
        if floor is not None and smallest[state] < NEAR_FLOOR * floor:
            text = (
                f"state {state} has collapsed: the smallest eigenvalue of its covariance, {smallest[state]:.2g}, is "
                f"nothing but the floor of {floor:.2g} that training adds"
            )
        elif condition[state] > LARGEST_CONDITION:
            text = (
                f"state {state} has collapsed: the eigenvalues of its covariance differ by a factor of "
                f"{condition[state]:.2g}"
            )
        else:
            continue
        warnings.append(Warning("collapsed covariance", where, text))
    return warnings


def idle_alpha(where: str, used: Segmentation) -> list[Warning]:
    """A forward variable that does not segment: undecided, in one state, or without any change."""
    share = max(used.occupancy)
    if used.entropy > IDLE_ENTROPY:
        text = f"the forward variable is not informative: its mean entropy is {used.entropy:.0%} of the largest"
    elif used.changes == 0:
        text = "the forward variable is not informative: the active state never changes"
    elif share > ONE_STATE:
        text = (
            f"the forward variable is not informative: state {used.occupancy.index(share)} is active in "
            f"{share:.0%} of the windows"
        )
    else:
        return []
    return [Warning("idle forward variable", where, text)]


def misaligned(where: str, used: Segmentation) -> list[Warning]:
    """Human-only and joint forward variable that cut most windows differently."""
    if used.agreement >= ALIGNED:
        return []
    text = (
        f"human-only and joint forward variable agree in only {used.agreement:.0%} of the windows: the partner's "
        "encoder and the state model have drifted apart, or the human's motion does not show the partner's"
    )
    return [Warning("misaligned encoder", where, text)]


def overconfident(where: str, measured: Calibration) -> list[Warning]:
    """A predictive covariance that misses most of what happens."""
    inside = measured.coverage[LEVELS.index(0.9)]
    if inside >= COVERED:
        return []
    text = f"the predictive covariance is too small: its 90 % ellipsoid holds {inside:.0%} of the true latents"
    return [Warning("overconfident", where, text)]


def without_contact_state(where: str, action: str, states: Sequence[int]) -> list[Warning]:
    """An action in which the partners touch, for which the model knows no contact state."""
    if action not in CONTACT_ACTIONS or states:
        return []
    return [Warning("no contact state", where, "no contact state is set, so that mild-ik never adapts the hand")]
