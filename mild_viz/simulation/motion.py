"""What a simulation says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.trial import freeze_arrays


@dataclass(frozen=True, eq=False)
class CompliantMotion:
    """N frames of an arm of J joints that follows its command as far as the human's hand lets it.

    Row n is the moment of command n; world is the robot's base frame.
    """

    time: Float[np.ndarray, " N"]
    """From the first command on [s]."""
    joints: Float[np.ndarray, "N J"]
    """Where the joints are [rad]."""
    end_effector: Float[np.ndarray, "N 3"]
    """Where the robot's hand is, world [m]."""
    gripped: Bool[np.ndarray, " N"]
    """Whether the human's hand holds the robot's."""
    hand_force: Float[np.ndarray, "N 3"]
    """Force of the human's hand on the robot's, world [N]."""
    force_peak: Float[np.ndarray, " N"]
    """Largest |hand_force| of all steps since the frame before [N]."""
    displacement: Float[np.ndarray, " N"]
    """Distance of the robot's hand from where it was commanded [m]."""
    human_displacement: Float[np.ndarray, " N"]
    """Distance of the human's hand from where it was recorded, counted from where the hands met [m]; 0 without grip."""
    torques: Float[np.ndarray, "N J"]
    """Of the motors, including the arm's weight where they carry it [N m]."""
    energy: Float[np.ndarray, " N"]
    """Kinetic, and in the springs of the joints and of the human's arm [J]."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def n_frames(self) -> int:
        return len(self.time)

    @property
    def force(self) -> Float[np.ndarray, " N"]:
        """|hand_force| [N]."""
        return np.linalg.norm(self.hand_force, axis=1)

    def summary(self) -> Summary:
        """What a grip was like; all 0 where the hands never met."""
        held = self.gripped
        if not held.any():
            return Summary(0.0, 0.0, 0.0, 0.0)
        return Summary(
            force_peak=float(self.force_peak[held].max()),
            force_rms=float(np.sqrt(np.mean(self.force[held] ** 2))),
            displacement_peak=float(self.displacement[held].max()),
            human_displacement_peak=float(self.human_displacement[held].max()),
        )


@dataclass(frozen=True)
class Summary:
    """Force and displacement while the hands hold each other."""

    force_peak: float
    """[N]"""
    force_rms: float
    """[N]"""
    displacement_peak: float
    """Of the robot's hand from its command [m]."""
    human_displacement_peak: float
    """Of the human's hand from its recorded way [m]."""
