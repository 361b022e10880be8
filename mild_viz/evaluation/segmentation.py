"""How a model cuts a trial into states: use of the states, agreement of both forward variables, true phases.

The active state is the argmax of the forward variable (Eq. hmm-h). Where nothing else is said, that of the human
alone, which is what a robot has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mild_viz.errors import UserError
from mild_viz.evaluation.passes import Pass
from mild_viz.trial import PHASES

REST, CONTACT = PHASES.index("rest"), PHASES.index("contact")

BOUNDARIES = ("rest → reach", "reach → contact", "contact → return", "return → rest")
"""Phase changes whose time is measured: the first and the last moment of movement, and of contact."""

LONGEST_DELAY = 1.0
"""Entries into a state that are further apart than this are different events, not one that is seen late [s]:
phases of these interactions last about a second."""


@dataclass(frozen=True)
class Segmentation:
    """Use of S states on the trials of one action, and agreement of human-only and joint forward variable."""

    action: str
    n_trials: int
    n_windows: int
    occupancy: tuple[float, ...]
    """Share of windows in which each state is active."""
    duration: tuple[float, ...]
    """Mean length of a visit to each state [s]; 0 where never visited."""
    changes: float
    """Changes of the active state in a trial, on average."""
    back_transitions: float
    """Of them, those into a state that had been left before; a trial that ends as it begins has one."""
    entropy: float
    """Mean entropy of the forward variable as a share of log S: 0 is certain, 1 says nothing."""
    agreement: float
    """Share of windows in which human-only and joint forward variable have the same active state."""
    delay: float | None
    """Median over changes of the joint active state of the human-only one's delay [s], late is positive; None where
    none has a counterpart."""
    delay_frames: float | None
    """The same in frames."""
    matched: float
    """Share of the joint active state's changes that have a counterpart: the human-only one enters that state too,
    within `LONGEST_DELAY`."""


@dataclass(frozen=True)
class BoundaryError:
    """How late a phase change is seen, over trials."""

    name: str
    delay: float | None
    """Median [s], late is positive; None where it is never found."""
    absolute: float | None
    """Median of the absolute delay [s]."""
    n_found: int
    n_true: int


@dataclass(frozen=True)
class PhaseFit:
    """The active state beside the true phases, on the trials of one action."""

    action: str
    nmi: float
    nmi_joint: float
    """Normalised mutual information of state and phase, for both forward variables."""
    phase_of_state: tuple[int, ...]
    """Phase (index into `PHASES`) that each state stands for, learnt on training trials."""
    boundaries: tuple[BoundaryError, ...]
    """In the order of `BOUNDARIES`, by the human-only active state."""


def entries(active: Int[np.ndarray, " N"]) -> Int[np.ndarray, " V"]:
    """First index of every visit to a state."""
    return np.flatnonzero(np.diff(active, prepend=-1))


def back_transitions(active: Int[np.ndarray, " N"]) -> int:
    """Changes into a state that had been left before."""
    visited = active[entries(active)]
    return len(visited) - len(np.unique(visited))


def change_delays(
    reference: Int[np.ndarray, " N"], other: Int[np.ndarray, " N"], longest: float
) -> Float[np.ndarray, " C"]:
    """For every change of the reference state, how much later the other one enters the same state [frames].

    Of several such entries the nearest counts. NaN where there is none within `longest` frames.
    """
    begins = entries(other)
    delays = []
    for change in entries(reference)[1:]:
        same = begins[other[begins] == reference[change]]
        delays.append(same[np.abs(same - change).argmin()] - change if len(same) else np.nan)
    result = np.array(delays, dtype=np.float64)
    result[np.abs(result) > longest] = np.nan
    return result


def normalised_mutual_information(first: Int[np.ndarray, " N"], second: Int[np.ndarray, " N"]) -> float:
    """2 I(first; second) / (H(first) + H(second)): 1 for the same partition, 0 for independent ones.

    Two partitions of one part each are the same (1).
    """
    table = np.zeros((int(first.max()) + 1, int(second.max()) + 1))
    np.add.at(table, (first, second), 1.0 / len(first))
    entropies = _entropy(table.sum(1)) + _entropy(table.sum(0))
    if entropies == 0.0:
        return 1.0
    # Rounding leaves independent partitions some 1e-16 below zero.
    return max(0.0, float(2.0 * (entropies - _entropy(table.ravel())) / entropies))


def phase_of_states(
    active: Int[np.ndarray, " N"], phase: Int[np.ndarray, " N"], n_states: int
) -> Int[np.ndarray, " S"]:
    """Many-to-one mapping: each state stands for the phase that most of its windows are in; rest if it has none."""
    table = np.zeros((n_states, len(PHASES)))
    np.add.at(table, (active, phase), 1.0)
    return table.argmax(1)


def boundary_times(phase: Int[np.ndarray, " N"]) -> Float[np.ndarray, "4"]:
    """Index of each of `BOUNDARIES`; NaN where it does not occur.

    Movement is whatever is not rest. It and contact begin at their first index and end after their last one: a
    moment of contact that is seen too early counts as an early boundary, and one that is seen once more after the
    end as a late one.
    """
    moving, touching = np.flatnonzero(phase != REST), np.flatnonzero(phase == CONTACT)
    times = np.full(4, np.nan)
    if len(moving):
        times[[0, 3]] = moving[0], moving[-1] + 1
    if len(touching):
        times[[1, 2]] = touching[0], touching[-1] + 1
    times[(times <= 0) | (times >= len(phase))] = np.nan  # it lies outside of what was recorded
    return times


def segmentation(passes: Sequence[Pass]) -> Segmentation:
    """Use of the states and agreement, over trials of one action.

    Raises:
        UserError: unless there is a trial, and all are of one action.
    """
    action = _action(passes)
    n_states = passes[0].log_alpha.shape[1]
    steps, visits, seconds = np.zeros(n_states), np.zeros(n_states), np.zeros(n_states)
    for one in passes:
        counts = np.bincount(one.active, minlength=n_states)
        steps += counts
        seconds += counts / one.trial.rate
        visits += np.bincount(one.active[entries(one.active)], minlength=n_states)
    probability = np.exp(np.concatenate([one.log_alpha for one in passes]))
    delays = [change_delays(one.active_joint, one.active, LONGEST_DELAY * one.trial.rate) for one in passes]
    matched = np.isfinite(np.concatenate(delays))
    n_windows = int(steps.sum())
    return Segmentation(
        action=action,
        n_trials=len(passes),
        n_windows=n_windows,
        occupancy=tuple((steps / n_windows).tolist()),
        duration=tuple((seconds / np.maximum(visits, 1)).tolist()),
        changes=float(np.mean([len(entries(one.active)) - 1 for one in passes])),
        back_transitions=float(np.mean([back_transitions(one.active) for one in passes])),
        entropy=float(np.mean([_entropy(row) for row in probability])) / np.log(n_states) if n_states > 1 else 0.0,
        agreement=float(np.mean(np.concatenate([one.active == one.active_joint for one in passes]))),
        delay=_median([delay / one.trial.rate for one, delay in zip(passes, delays, strict=True)]),
        delay_frames=_median(delays),
        matched=float(matched.mean()) if len(matched) else 1.0,
    )


def phase_fit(train: Sequence[Pass], test: Sequence[Pass]) -> PhaseFit | None:
    """The active state beside the true phases of the test trials; None where phases are not known.

    Which phase a state stands for is learnt on the training trials alone. All trials are of one action.
    """
    action = _action([*train, *test])
    known = [(one.active, one.phase) for one in train if one.phase is not None]
    shown = [(one, one.phase) for one in test if one.phase is not None]
    if not known or not shown:
        return None
    n_states = test[0].log_alpha.shape[1]
    mapping = phase_of_states(
        np.concatenate([active for active, _ in known]), np.concatenate([phase for _, phase in known]), n_states
    )
    phases = np.concatenate([phase for _, phase in shown])
    true = np.array([boundary_times(phase) for _, phase in shown])
    found = np.array([boundary_times(mapping[one.active]) for one, _ in shown])
    delays = (found - true) / np.array([[one.trial.rate] for one, _ in shown])
    return PhaseFit(
        action=action,
        nmi=normalised_mutual_information(np.concatenate([one.active for one, _ in shown]), phases),
        nmi_joint=normalised_mutual_information(np.concatenate([one.active_joint for one, _ in shown]), phases),
        phase_of_state=tuple(mapping.tolist()),
        boundaries=tuple(
            BoundaryError(
                name=name,
                delay=_median([delays[:, index]]),
                absolute=_median([np.abs(delays[:, index])]),
                n_found=int(np.isfinite(delays[:, index]).sum()),
                n_true=int(np.isfinite(true[:, index]).sum()),
            )
            for index, name in enumerate(BOUNDARIES)
        ),
    )


def _action(passes: Sequence[Pass]) -> str:
    actions = {one.trial.action for one in passes}
    if len(actions) != 1:
        raise UserError(f"trials of one action are needed, got those of: {', '.join(sorted(actions)) or 'none'}")
    return actions.pop()


def _entropy(probabilities: Float[np.ndarray, " K"]) -> float:
    """[nat]"""
    positive = probabilities[probabilities > 0.0]
    return float(-(positive * np.log(positive)).sum()) + 0.0


def _median(parts: Sequence[Float[np.ndarray, " _"]]) -> float | None:
    """Of all finite numbers; None where there is none."""
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None
