"""Everything that a view may draw, as NumPy arrays: the result of one run of the pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.files import write_arrays
from mild_viz.settings import Placement
from mild_viz.trial import ObjectTrack, Skeleton, freeze_arrays

SAVED = (
    "time", "log_alpha_human", "log_alpha_joint", "log_alpha_unobserved", "active_state", "log_transition",
    "human_latent_mean", "human_latent_covariance", "robot_latent_mean", "robot_latent_covariance",
    "robot_latent_truth", "joints_decoded", "joints_commanded", "joints_truth", "end_effector", "target",
    "contact", "stiffness", "fired",
)  # fmt: skip
"""Names of the arrays in a rollout file; row n of all of them belongs to human window n."""


ERROR_UNITS = {"joints": "rad²", "arm": "m²", "hands": "m²"}
"""By what a model decodes of the partner: a robot's joints; a second human's arm, or both hands, which the robot then
follows."""


@dataclass(frozen=True, eq=False)
class Inference:
    """What the model says about one trial: encode, filter, condition, decode.

    Row n belongs to human window n, whose newest observation is frame n + 4; joints are those of frame
    n + 5, the first of the predicted window. N windows, S states, D latent dimensions, J joints.
    """

    dataset: str
    split: str
    trial: int
    action: str
    variant: str
    rate: float
    joint_names: tuple[str, ...]
    time: Float[np.ndarray, " N"]
    """Time of the newest observation [s]."""
    observed: Bool[np.ndarray, " N"]
    """False where the window could not be filled (tracking lost): the filter then only predicts."""
    tracked: Bool[np.ndarray, " N"]
    """False where the newest observation itself was lost: a short gap is bridged by the last one that was seen."""
    log_alpha_human: Float[np.ndarray, "N S"]
    log_alpha_joint: Float[np.ndarray, "N S"]
    log_alpha_unobserved: Float[np.ndarray, "N S"]
    active_state: Int[np.ndarray, " N"]
    """argmax of the human-only forward variable."""
    log_transition: Float[np.ndarray, " N"]
    """log probability of the transition state (`latent.transition`); -inf without one, and where not observed."""
    human_latent_mean: Float[np.ndarray, "N D"]
    human_latent_covariance: Float[np.ndarray, "N D D"]
    robot_latent_mean: Float[np.ndarray, "N D"]
    """Predicted, Eq. conditioning-withcov-mu-t."""
    robot_latent_covariance: Float[np.ndarray, "N D D"]
    """Predicted, Eq. conditioning-withcov-sigma-t."""
    robot_latent_truth: Float[np.ndarray, "N D"]
    """Encoded true partner window; NaN where the truth is unknown."""
    joints_decoded: Float[np.ndarray, "N J"]
    joints_truth: Float[np.ndarray, "N J"]
    """NaN where the truth is unknown."""
    window_error: Float[np.ndarray, " N"]
    """Mean squared error of the predicted window [`error_unit`]; NaN where the truth is unknown."""
    human_state_means: Float[np.ndarray, "S D"]
    human_state_covariances: Float[np.ndarray, "S D D"]
    robot_state_means: Float[np.ndarray, "S D"]
    robot_state_covariances: Float[np.ndarray, "S D D"]
    human_arm: Float[np.ndarray, "N 3 3"]
    """Shoulder, elbow, wrist at the newest observation, human frame [m]; gaps are NaN."""
    human_hand: Float[np.ndarray, "N 3"]
    """The wrist as the controller sees it: gaps filled by the last observation."""
    human_skeleton: Skeleton | None = None
    """The whole body at the newest observations, human frame, where it was recorded."""
    partner_skeleton: Skeleton | None = None
    """The same of the second human, in that person's own frame."""
    object_track: ObjectTrack | None = None
    """What is handed over at the newest observations, human frame, where it was recorded."""
    transfer: int | None = None
    """Row at which it is handed over: the two persons' wrists are nearest."""
    phase: Int[np.ndarray, " N"] | None = None
    decodes: str = "joints"
    """What the model decodes of the partner: a key of `ERROR_UNITS`."""
    partner_decoded: Float[np.ndarray, "N P 3"] | None = None
    """The second human's points that were decoded, in that person's own frame [m]; None where joints were."""
    partner_truth: Float[np.ndarray, "N P 3"] | None = None
    """The same as recorded; NaN where the truth is unknown."""
    others_decoded: Mapping[str, Float[np.ndarray, "N _"]] = field(default_factory=dict)
    """`joints_decoded` of the robot's other arms, by name; those that are not named rest."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def error_unit(self) -> str:
        """The unit of `window_error`."""
        return ERROR_UNITS[self.decodes]

    @property
    def n_windows(self) -> int:
        return len(self.time)

    @property
    def n_states(self) -> int:
        return self.log_alpha_human.shape[1]

    def log_alpha(self, mode: str) -> Float[np.ndarray, "N S"]:
        """The forward variable in one of `ALPHA_MODES`."""
        return getattr(self, f"log_alpha_{mode}")


@dataclass(frozen=True, eq=False)
class OtherArm:
    """What an arm does that moves beside the one that interacts; K joints."""

    name: str
    controller: str
    joint_names: tuple[str, ...]
    joints_decoded: Float[np.ndarray, "N K"]
    """The decoded joints, its own or mirrored; the resting joints where the controller takes none."""
    joints_commanded: Float[np.ndarray, "N K"]
    end_effector: Float[np.ndarray, "N 3"]
    """World [m]."""
    target: Float[np.ndarray, "N 3"]
    """The human's left hand, world [m]; NaN where it is not known."""
    hand_distance: Float[np.ndarray, " N"]
    """|end_effector - target| [m]."""
    stiffness: Float[np.ndarray, "N K"]
    fired: Int[np.ndarray, " N"]
    """As `Rollout.fired`, of this arm."""

    def __post_init__(self) -> None:
        freeze_arrays(self)


OTHER_SAVED = ("joints_commanded", "end_effector", "target", "stiffness", "fired")
"""Names of the arrays of another arm in a rollout file, there with the arm's name before them."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """An `Inference` and the commands that a controller makes of it. World is the robot's base frame."""

    inference: Inference
    controller: str
    robot: str
    joints_commanded: Float[np.ndarray, "N J"]
    end_effector: Float[np.ndarray, "N 3"]
    """Commanded end effector position, world [m]."""
    end_effector_decoded: Float[np.ndarray, "N 3"]
    target: Float[np.ndarray, "N 3"]
    """The human's hand, world [m]."""
    hand_distance: Float[np.ndarray, " N"]
    """|end_effector - target| [m]."""
    contact: Bool[np.ndarray, " N"]
    stiffness: Float[np.ndarray, "N J"]
    """Fraction of full joint stiffness, 0 to 1."""
    compliant: bool
    """Whether the stiffness is lowered in contact, by the rules of the action (not by the settings)."""
    fired: Int[np.ndarray, " N"]
    """Which rules fired, as bit masks: bit i is `robot.control.rules.RULES[i]`."""
    T_world_human: Float[np.ndarray, "4 4"]
    link_names: tuple[str, ...]
    link_poses: Float[np.ndarray, "N L 7"]
    """Commanded pose of every drawn link in world: wxyz, xyz."""
    link_poses_decoded: Float[np.ndarray, "N L 7"]
    """The same for the decoded joints, before IK (the ghost)."""
    state_durations: Float[np.ndarray, " S"]
    """Mean length of a visit to each state [s], by `active_state`; 0 where never visited."""
    state_occupancy: Float[np.ndarray, " S"]
    """Share of the trial in which each state is active."""
    contact_states: frozenset[int]
    placement: Placement
    """Where the human stands, and in words for the page where that comes from."""
    T_world_partner: Float[np.ndarray, "4 4"] | None = None
    """Pose of the recorded second human's own frame; None where each person was recorded apart."""
    object_track: ObjectTrack | None = None
    """What is handed over as it was recorded, world."""
    other_arms: tuple[OtherArm, ...] = ()
    """The arms that move beside the one that interacts; those that only rest are not among them."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def array(self, name: str) -> np.ndarray:
        """One of the arrays named in `SAVED`."""
        return getattr(self if name in type(self).__dataclass_fields__ else self.inference, name)

    def save(self, path: Path) -> None:
        """Write the arrays named in `SAVED`, and in `OTHER_SAVED` of every other arm, to an .npz file, atomically."""
        arrays = {name: self.array(name) for name in SAVED}
        arrays |= {f"{arm.name}_{name}": getattr(arm, name) for arm in self.other_arms for name in OTHER_SAVED}
        write_arrays(path, arrays)
