"""When the partners of a recording touch, and which HMM states that makes contact states."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.trial import CONTACT_ACTIONS, PHASES, Trial

EXTENDED = 0.8
"""Hands count as extended from this share of the trial's own largest extension on."""

SMALLEST_EXTENSION = 0.35
"""Below this share of the arm's length in front of the shoulder, nobody reaches for the other's hand."""

TOGETHER = 0.5
"""Hands in contact move relative to one another by less than this [m/s]."""

CLOSE = 0.05
"""Where both are in one frame: hands in contact are this much above their smallest distance at most [m]."""

RELATIVE_SHARE = 0.5
"""A contact state has at least this part of the largest share of frames in contact that any state has."""


def contact_frames(trial: Trial) -> Bool[np.ndarray, " T"]:
    """Frames in which the partners' right hands touch; none where the action is without contact.

    By the recording's own phases where it has them. Else, where both persons are in one world frame: the
    wrists are within 5 cm of their smallest distance. Else, where each is in an own frame: both wrists are
    extended (in front of their shoulder by at least 80 % of the largest extension that both reach together in
    this trial) and move together (slower than 0.5 m/s relative to one another, as facing people see it).
    """
    none = np.zeros(trial.n_frames, dtype=bool)
    partner = trial.partner_arm
    if trial.action not in CONTACT_ACTIONS or partner is None:
        return none
    human = trial.human_arm
    seen = np.isfinite(human).all(axis=(1, 2)) & np.isfinite(partner).all(axis=(1, 2))
    if not seen.any():
        return none
    if trial.phase is not None:
        return seen & (trial.phase == PHASES.index("contact"))
    if trial.T_world_human is not None and trial.T_world_partner is not None:
        distance = _wrist_distance(trial.T_world_human, human, trial.T_world_partner, partner)
        return seen & (distance <= np.nanmin(distance) + CLOSE)
    extension = np.minimum(_extension(human), _extension(partner))
    largest = np.nanquantile(extension, 0.98)
    if largest < SMALLEST_EXTENSION:
        return none
    apart = partner[:, 2] - human[:, 2] * (-1.0, -1.0, 1.0)  # constant while facing people's wrists are together
    speed = np.linalg.norm(np.gradient(_smooth(apart), axis=0), axis=1) * trial.rate
    return seen & (extension >= EXTENDED * largest) & (speed < TOGETHER)


def nearest_wrists(trial: Trial) -> int | None:
    """The frame in which the partners' right wrists are nearest; None where they were not recorded in one world."""
    T_world_human, T_world_partner, partner = trial.T_world_human, trial.T_world_partner, trial.partner_arm
    if T_world_human is None or T_world_partner is None or partner is None:
        return None
    distance = _wrist_distance(T_world_human, trial.human_arm, T_world_partner, partner)
    return None if np.isnan(distance).all() else int(np.nanargmin(distance))


def _wrist_distance(
    T_world_human: Float[np.ndarray, "4 4"],
    human: Float[np.ndarray, "T 3 3"],
    T_world_partner: Float[np.ndarray, "4 4"],
    partner: Float[np.ndarray, "T 3 3"],
) -> Float[np.ndarray, " T"]:
    return np.linalg.norm(in_frame(T_world_human, human[:, 2]) - in_frame(T_world_partner, partner[:, 2]), axis=1)


def suggest_contact_states(
    active: Sequence[Int[np.ndarray, "_"]], touching: Sequence[Bool[np.ndarray, "_"]], n_states: int
) -> frozenset[int]:
    """HMM states in which the partners touch, from the segments of several trials.

    `active` holds the active state of every window, `touching` whether there is contact at the newest
    observation of that window (`contact_frames(trial)[4 : 4 + N]`). Chosen are the states whose share of
    frames with contact is at least half of the largest state's share: relative, because the rule for contact
    frames leaves out those in which the hands move fast or back.
    """
    states, contact = np.concatenate(active), np.concatenate(touching)
    visits = np.bincount(states, minlength=n_states)
    share = np.bincount(states, weights=contact, minlength=n_states) / np.maximum(visits, 1)
    return frozenset(int(state) for state in np.flatnonzero((share >= RELATIVE_SHARE * share.max()) & (share > 0.0)))


def arm_length(arm: Float[np.ndarray, "T 3 3"]) -> float:
    """Median length of a person's upper arm and forearm together [m]; NaN where it was never seen."""
    lengths = arm_lengths(arm)
    return float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else np.nan


def arm_lengths(arm: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """Length of upper arm and forearm together in every frame [m]."""
    return np.linalg.norm(np.diff(arm, axis=1), axis=2).sum(axis=1)


def in_frame(T_a_b: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Points given in frame b, seen in frame a."""
    # einsum sums every row alike, however many there are: one point alone gives the same bits.
    return np.einsum("ij,nj->ni", T_a_b[:3, :3], points) + T_a_b[:3, 3]


def upright(T_world_person: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation from the world (z up) to a frame that stands upright and has the person's heading."""
    heading = np.arctan2(T_world_person[1, 0], T_world_person[0, 0])
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _extension(arm: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """How far the wrist is in front of the shoulder, as a share of the arm's length."""
    return (arm[:, 2, 0] - arm[:, 0, 0]) / arm_length(arm)


def _smooth(track: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Mean over five frames, of those that were seen."""
    padded = np.pad(track, ((2, 2), (0, 0)), mode="edge")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # five unseen frames: their mean is NaN, as it should be
        return np.nanmean(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=2)
