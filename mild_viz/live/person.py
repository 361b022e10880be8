"""From a skeleton frame to the arm in the person's own frame, which the model was trained on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.data.demo_body import DEMO_BONES, DEMO_JOINTS
from mild_viz.data.skeletons import (
    ARM_JOINTS,
    REFERENCE_JOINTS,
    ZED_BONES,
    ZED_JOINTS,
    joint_indices,
    person_frame,
    to_frame,
)
from mild_viz.errors import UserError
from mild_viz.live.messages import Observation

REFERENCES = (
    ("left_shoulder", "right_shoulder", "waist", "right_collar"),
    REFERENCE_JOINTS,
)
"""Joints that give a person's frame, as Nuitrack and the ZED SDK name them (`data.skeletons.person_frame`)."""


class Body:
    """Where the joints stand in the frames of one sender, and the person's frame."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._arm: list[int] = []
        self._reference: list[int] | None = None
        self.coordinates = "person"
        self.T_world_person: Float[np.ndarray, "4 4"] | None = np.eye(4)
        """Identity where the sender gives the person's own frame; None where it is not known yet."""

    def read(self, seen: Observation) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "4 3"]]:
        """Arm and reference joints as sent [m]; NaN where not tracked, or not sent."""
        if seen.names != self._names:
            self._names = seen.names
            self._arm = joint_indices(seen.names, ARM_JOINTS)
            known = [joint_indices(seen.names, names) for names in REFERENCES if set(names) <= set(seen.names)]
            self._reference = known[0] if known else None
        if seen.coordinates != self.coordinates:
            self.coordinates = seen.coordinates
            self.T_world_person = np.eye(4) if seen.coordinates == "person" else None
        reference = np.full((4, 3), np.nan) if self._reference is None else seen.positions[self._reference]
        return seen.positions[self._arm], reference

    def place(self, references: Float[np.ndarray, "N 4 3"]) -> bool:
        """Take the person's frame from the mean of several frames' reference joints; False where that is impossible."""
        if self.coordinates == "person":
            return True
        complete = references[np.isfinite(references).all(axis=(1, 2))]
        if not len(complete):
            return False
        try:
            self.T_world_person = person_frame(*complete.mean(axis=0))
        except UserError:  # joints that coincide
            return False
        return True

    def to_person(self, points: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
        """Points as sent, in the person's frame; NaN while that is not known."""
        if self.coordinates == "person":
            return points
        return np.full_like(points, np.nan) if self.T_world_person is None else to_frame(self.T_world_person, points)


def skeleton_bones(names: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Bones between the joints of a frame, by their names; none where too little was sent to draw a body."""
    if not {"left_shoulder", "right_shoulder"} <= set(names):
        return ()
    # The demo set's joints are Nuitrack's, and legs.
    joints, bones = (ZED_JOINTS, ZED_BONES) if "pelvis" in names else (DEMO_JOINTS, DEMO_BONES)
    between = [(joints[a], joints[b]) for a, b in bones]
    return tuple((names.index(a), names.index(b)) for a, b in between if a in names and b in names)
