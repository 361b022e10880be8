"""Where the human stands, seen from the robot: from the recording, estimated, or chosen.

The robot takes the partner's place, but its arm has another length (Pepper's is about 0.65 of a person's). So the
human is put such that contact lies at the same fraction of reach from the robot's shoulder as it lay from
the partner's, and as well as one place allows in the same direction: at s_r + k (w_p - s_p), with
k = reach of the robot / length of the partner's arm. This settles the height too, as if the robot stood on
a pedestal (as the paper's did).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import arm_length, contact_frames, in_frame, upright
from mild_viz.robot.retarget_arm import hand_place, scaled_wrist
from mild_viz.robot.workspace import HandMap
from mild_viz.settings import MAX_PLACEMENT, Placement
from mild_viz.trial import WRIST, Trial

FACING = np.diag([-1.0, -1.0, 1.0])
"""Rotation of a person who faces the robot: yaw of pi."""

SCALE = 0.03
"""Residuals well above this count linearly, not squared (pseudo-Huber) [m]."""

DIRECTION = 0.5
"""Weight of an error across the arm against one along it, which costs reach."""

NO_CONTACT = "no trial shows contact; expected training trials of handshake, rocket, parachute or handover"

OUTSTRETCHED = 0.85
"""Fraction of reach at which people meet, where no recording shows it (NuiSI: 0.86 to 0.9)."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A translation that fits contact frames of several trials, and how well it does."""

    translation: Float[np.ndarray, "3"]
    n_frames: int
    n_trials: int
    between_trials: float
    """Root mean square distance of the trials' own translations from the common one [m]."""
    within_trials: float
    """Root mean square distance of the frames from their trial's own translation [m]."""


@dataclass(frozen=True, eq=False)
class PlacedHuman:
    """The pose of the human's frame in the robot's base frame, and the numbers that a person may change."""

    T_world_human: Float[np.ndarray, "4 4"]
    placement: Placement


@dataclass(frozen=True)
class Meeting:
    """Where two people's hands meet in recordings: what puts a human before any robot that takes one's place."""

    partner: tuple[float, float, float]
    """The partner's wrist from the shoulder, in the partner's own frame, as a share of the arm's length."""
    human: tuple[float, float, float]
    """The human's wrist, in the human's own frame [m]."""
    source: str

    def __post_init__(self) -> None:
        for name in ("partner", "human"):
            if not (np.abs(getattr(self, name)) < MAX_PLACEMENT).all():
                raise UserError(f"meeting: {name} is {getattr(self, name)}; valid: numbers below {MAX_PLACEMENT}")
        if not np.linalg.norm(self.partner) > 0.0:
            raise UserError(f"meeting: partner is {self.partner}; valid: a place apart from the shoulder")

    def placement(self, chain: ArmChain) -> Placement:
        """Where a human stands who faces a robot, such that hands meet at the same fraction of reach."""
        meeting = hand_place(chain, np.array([self.partner]))[0]
        return _placement(chain, meeting - FACING @ self.human, self.source, estimated=True)


class Sample(NamedTuple):
    """Where each of F contact frames of one trial would have the sought translation."""

    points: Float[np.ndarray, "F 3"]
    weights: Float[np.ndarray, "F 3 3"]
    """Metric of the error: the squared error of translation t is (t - point)' weight (t - point)."""


def fit_translation(samples: Sequence[Sample]) -> Fit:
    """Robust least squares: the translation nearest to all samples [m], each trial counting the same.

    Minimises the sum over trials of the mean over frames of sqrt(1 + error^2 / SCALE^2), by iteratively
    re-weighted least squares. Raises `UserError` where there is no sample.
    """
    samples = [sample for sample in samples if len(sample.points)]
    if not samples:
        raise UserError(NO_CONTACT)
    own = [_robust_fit(sample, np.ones(len(sample.points))) for sample in samples]
    merged = Sample(*(np.concatenate(arrays) for arrays in zip(*samples, strict=True)))
    translation = _robust_fit(merged, np.concatenate([np.full(len(s.points), 1.0 / len(s.points)) for s in samples]))
    within = np.concatenate([sample.points - center for sample, center in zip(samples, own, strict=True)])
    return Fit(translation, len(merged.points), len(samples), _rms(np.array(own) - translation), _rms(within))


def dyad_translation(trials: Sequence[Trial]) -> Fit:
    """Where the partner's frame is in the human's (collar to collar), if both face each other [m].

    It brings the partners' wrists together in the contact frames of the given trials.
    """
    samples = []
    for trial in trials:
        touching = contact_frames(trial)
        if trial.partner_arm is not None and touching.any():
            points = trial.human_arm[touching, 2] - trial.partner_arm[touching, 2] @ FACING.T
            samples.append(Sample(points, np.tile(np.eye(3), (len(points), 1, 1))))
    return fit_translation(samples)


def estimate_placement(chain: ArmChain, trials: Sequence[Trial]) -> tuple[Placement, Fit]:
    """Where a human stands who faces the robot, such that hands meet at the partners' fraction of reach.

    Give the training trials of one dataset; those without contact are passed over. `UserError` where none
    shows contact.
    """
    fit = fit_translation([_meetings(chain, trial, FACING, np.eye(3)) for trial in trials])
    names = ", ".join(sorted({trial.dataset for trial in trials}))
    source = (
        f"estimated from {fit.n_frames} contact frames of {fit.n_trials} training trials of {names} "
        f"({100 * fit.between_trials:.1f} cm between trials, {100 * fit.within_trials:.1f} cm within)"
    )
    return _placement(chain, fit.translation, source, estimated=True), fit


def estimate_meeting(trials: Sequence[Trial]) -> Meeting:
    """Where hands meet: per trial the median over its contact frames, then the median over the trials.

    `UserError` where no trial shows contact.
    """
    partners, humans, n_frames = [], [], 0
    for trial in trials:
        touching = contact_frames(trial)
        if trial.partner_arm is not None and touching.any():
            arm = trial.partner_arm[touching]
            partners.append(np.median(arm[:, 2] - arm[:, 0], axis=0) / arm_length(trial.partner_arm))
            humans.append(np.median(trial.human_arm[touching, 2], axis=0))
            n_frames += len(arm)
    if not partners:
        raise UserError(NO_CONTACT)
    names = ", ".join(sorted({trial.dataset for trial in trials}))
    source = f"estimated from {n_frames} contact frames of {len(partners)} training trials of {names}"
    x, y, z = np.median(partners, axis=0).tolist()
    return Meeting((x, y, z), tuple(np.median(humans, axis=0).tolist()), source)


def T_world_human(
    chain: ArmChain, placement: Placement, rotation: Float[np.ndarray, "3 3"] = FACING
) -> Float[np.ndarray, "4 4"]:
    """Pose of the human's frame in the robot's base frame; the human faces the robot unless turned otherwise."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = chain.shoulder + np.array([placement.distance, placement.lateral, placement.height])
    return pose


@lru_cache(maxsize=1024)  # the pipeline asks at every rerun; trials are immutable and kept by their dataset
def recorded_placement(chain: ArmChain, trial: Trial, follow: HandMap | None = None) -> PlacedHuman | None:
    """The human as recorded, with the robot in the partner's place; None without one world frame.

    The orientation is the recorded one, seen from the partner's heading (the robot stands upright). The
    distance is such that the hands meet at the partner's fraction of reach; where the action has no
    contact, the distance between the shoulders shrinks as the sum of both arms' lengths does.
    """
    world_human, world_partner, partner = trial.T_world_human, trial.T_world_partner, trial.partner_arm
    if world_human is None or world_partner is None or partner is None:
        return None
    stands = upright(world_partner)
    human_rotation, partner_rotation = stands @ world_human[:3, :3], stands @ world_partner[:3, :3]
    sample = _meetings(chain, trial, human_rotation, partner_rotation, follow)
    if len(sample.points):
        translation = fit_translation([sample]).translation
    else:
        human_arm, partner_arm = arm_length(trial.human_arm), arm_length(partner)
        shoulder = np.nanmedian(trial.human_arm[:, 0], axis=0)
        apart = (
            in_frame(world_human, shoulder[None])[0] - in_frame(world_partner, np.nanmedian(partner[:, :1], axis=0))[0]
        )
        shrink = (human_arm + chain.reach) / (human_arm + partner_arm)
        translation = chain.shoulder + shrink * stands @ apart - human_rotation @ shoulder
    if not np.isfinite(translation).all():
        return None
    nearer = "nearer as its arm is shorter" if chain.reach < arm_length(partner) else "farther as its arm is longer"
    source = f"recorded: the robot takes the partner's place, {nearer}"
    placement = _placement(chain, translation, source, estimated=False)
    return PlacedHuman(T_world_human(chain, placement, human_rotation), placement)


def outstretched_placement(chain: ArmChain, trial: Trial) -> Placement:
    """Where the hands meet when both arms are stretched forward to 0.85 of their reach."""
    shoulder, reach = np.nanmedian(trial.human_arm[:, 0], axis=0), arm_length(trial.human_arm)
    forward = np.array([OUTSTRETCHED, 0.0, 0.0])
    translation = chain.shoulder + chain.reach * forward - FACING @ (shoulder + reach * forward)
    return _placement(chain, translation, "assumed: both arms stretched forward to 0.85 of their reach", estimated=True)


def place_human(
    chain: ArmChain,
    trial: Trial,
    chosen: Placement | None = None,
    stored: Placement | None = None,
    follow: HandMap | None = None,
) -> PlacedHuman:
    """Where the human of this trial stands: as chosen, else as recorded, else as stored with the model.

    A chosen placement moves the human but keeps the recorded orientation. Without any of the three, both
    arms are assumed to be stretched out. `follow` says where the robot's hands are if they follow the partner's;
    without it, its hand keeps the partner's fraction of reach.
    """
    recorded = recorded_placement(chain, trial, follow)
    if chosen is not None:
        rotation = FACING if recorded is None else recorded.T_world_human[:3, :3]
        return PlacedHuman(T_world_human(chain, chosen, rotation), chosen)
    if recorded is not None:
        return recorded
    placement = stored if stored is not None else outstretched_placement(chain, trial)
    return PlacedHuman(T_world_human(chain, placement), placement)


def _meetings(
    chain: ArmChain,
    trial: Trial,
    human_rotation: Float[np.ndarray, "3 3"],
    partner_rotation: Float[np.ndarray, "3 3"],
    follow: HandMap | None = None,
) -> Sample:
    """For every contact frame: where the human's frame must be for the hands to meet.

    The rotations are those of the human's and of the partner's frame in the robot's base frame.
    """
    if trial.partner_arm is None:
        return Sample(np.empty((0, 3)), np.empty((0, 3, 3)))
    touching = contact_frames(trial)
    if follow is None:
        meeting = scaled_wrist(chain, trial.partner_arm, partner_rotation)[touching]
    else:
        hands = np.asarray(trial.partner_points)
        meeting = follow(hands[touching])[:, trial.points.index(WRIST)]
    along = meeting - chain.shoulder
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    weights = DIRECTION**2 * np.eye(3) + (1.0 - DIRECTION**2) * along[:, :, None] * along[:, None, :]
    return Sample(meeting - trial.human_arm[touching, 2] @ human_rotation.T, weights)


def _robust_fit(sample: Sample, importance: Float[np.ndarray, " F"]) -> Float[np.ndarray, "3"]:
    """Minimiser of the weighted pseudo-Huber errors, from the median on."""
    center = np.median(sample.points, axis=0)
    for _ in range(100):
        error = center - sample.points
        squared = np.einsum("ni,nij,nj->n", error, sample.weights, error)
        pull = (importance / np.sqrt(1.0 + squared / SCALE**2))[:, None, None] * sample.weights
        moved = np.linalg.solve(pull.sum(axis=0), np.einsum("nij,nj->i", pull, sample.points))
        if np.linalg.norm(moved - center) < 1e-9:
            return moved
        center = moved
    return center


def _rms(errors: Float[np.ndarray, "N 3"]) -> float:
    """Root mean square length of N vectors."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _placement(chain: ArmChain, translation: Float[np.ndarray, "3"], source: str, estimated: bool) -> Placement:
    """The numbers of a translation in the robot's base frame, seen from its shoulder."""
    distance, lateral, height = (float(value) for value in translation - chain.shoulder)
    return Placement(distance, lateral, height, source, estimated)
