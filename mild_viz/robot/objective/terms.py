"""Optional terms of inverse kinematics: how the hand is held, where the elbow lies, what each joint costs, how fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.trial import freeze_arrays


@dataclass(frozen=True, eq=False)
class IKTerms:
    """What is minimised beside Eq. ik-prior-simplified, over N problems; without values, nothing.

        lambda_x |x - f(q)|^2 + lambda_q sum_i w_i (prior_i - q_i)^2
          + lambda_r |R(q) a - d|^2     or  lambda_r/2 |R(q) - R*|_F^2      orientation
          + lambda_e |(e(q) - s) / l - u|^2                                 elbow
        subject to the joint limits, and to |q_n - q_(n-1)| <= max_step.

    R(q) is the rotation of the end effector in the base frame. Both forms of its term are 4 lambda_r sin^2(t/2), about
    lambda_r t^2, for an angle t between what is and what is wanted; one axis leaves the turn about it free. e(q) is the
    origin of the elbow's joint, s the arm's shoulder (`ArmChain.shoulder`), l their distance in the resting posture.
    While the first term holds the hand, only the part of u across the line from shoulder to hand acts, and decides the
    swivel. Weights are m^2 (per rad^2 of the angle), so that they compare with lambda_x = 1.

    A row of NaN leaves its term out of that problem.
    """

    orientation_weight: float = 0.0
    """lambda_r [m^2/rad^2]."""
    orientation: Float[np.ndarray, "3 3"] | Float[np.ndarray, "N 3 3"] | None = None
    """R*, a full rotation; or else, `tool_axis` and `tool_direction`."""
    tool_axis: Float[np.ndarray, "3"] | None = None
    """a, unit vector in the end effector's frame."""
    tool_direction: Float[np.ndarray, "3"] | Float[np.ndarray, "N 3"] | None = None
    """d, unit vector in the base frame: where `tool_axis` should point."""
    elbow_weight: float = 0.0
    """lambda_e [m^2]."""
    elbow_joint: str | None = None
    """Name of the joint whose origin is the elbow."""
    elbow_direction: Float[np.ndarray, "3"] | Float[np.ndarray, "N 3"] | None = None
    """u, unit vector in the base frame from the shoulder to where the elbow should be."""
    joint_weights: Float[np.ndarray, " J"] | None = None
    """w, at least 0; 1 where it is None."""
    max_step: Float[np.ndarray, " J"] | float | None = None
    """How far a joint goes from one problem to the next [rad]: its velocity limit divided by the rate."""
    previous: Float[np.ndarray, " J"] | None = None
    """What the first problem's solution is at most `max_step` from [rad]; None: it may be anywhere."""

    def __post_init__(self) -> None:
        freeze_arrays(self)
        for name in ("orientation_weight", "elbow_weight"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise UserError(f"{name} is {value}; expected a finite number of at least 0")
        axis = self.tool_axis is not None and self.tool_direction is not None
        if self.orientation_weight > 0.0 and (self.orientation is not None) == axis:
            raise UserError("orientation_weight is set; expected either orientation, or tool_axis and tool_direction")
        if self.elbow_weight > 0.0 and (self.elbow_joint is None or self.elbow_direction is None):
            raise UserError("elbow_weight is set; expected elbow_joint and elbow_direction with it")
        for name in ("joint_weights", "max_step"):
            values = getattr(self, name)
            if values is not None and not np.all(np.asarray(values) >= 0.0):
                raise UserError(f"{name} is {values}; expected numbers of at least 0")
        if self.previous is not None and self.max_step is None:
            raise UserError("previous is set without max_step, which says how far a joint goes from there")

    def packed(self, chain: ArmChain, count: int) -> Float[np.ndarray, "_ K"]:
        """Rows for `objective.kernels`: one for all problems, or `count` where a wanted direction changes between them.

        Raises:
            UserError: if a field does not fit the arm or the number of problems.
        """
        from mild_viz.robot.objective import kernels as k

        wanted = (self.orientation, self.tool_direction, self.elbow_direction)
        varies = any(value is not None and value.ndim == dims for value, dims in zip(wanted, (3, 2, 2), strict=True))
        rows = np.tile(k.plain_terms(chain.n_joints), (count if varies else 1, 1))
        if self.joint_weights is not None:
            rows[:, k.JOINT_WEIGHTS :] = _per_joint(chain, "joint_weights", self.joint_weights)
        if self.orientation_weight > 0.0:
            axes, directions = np.zeros((3, 3)), np.zeros((len(rows), 3, 3))
            if self.orientation is not None:  # half of every axis: |R - R*|_F^2 / 2
                axes[:] = np.sqrt(0.5) * np.eye(3)
                directions[:] = np.sqrt(0.5) * np.swapaxes(_rows("orientation", self.orientation, count, 2), -1, -2)
            else:
                axes[0] = _unit("tool_axis", self.tool_axis)
                directions[:, 0] = _unit("tool_direction", _rows("tool_direction", self.tool_direction, count, 1))
            rows[:, k.TURN] = self.orientation_weight * np.isfinite(directions).all(axis=(1, 2))
            rows[:, k.TOOL_AXES : k.TOOL_DIRECTIONS] = axes.ravel()
            rows[:, k.TOOL_DIRECTIONS : k.ELBOW] = directions.reshape(len(rows), 9)
        if self.elbow_weight > 0.0:
            number, length = upper_arm(chain, self.elbow_joint or "")
            direction = _unit("elbow_direction", _rows("elbow_direction", self.elbow_direction, count, 1))
            rows[:, k.ELBOW] = self.elbow_weight / length**2 * np.isfinite(direction).all(axis=-1)
            rows[:, k.ELBOW_JOINT] = number
            rows[:, k.ELBOW_POINT : k.JOINT_WEIGHTS] = chain.shoulder + length * direction
        return rows

    def steps(self, chain: ArmChain) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " J"]]:
        """`max_step` and `previous` of every joint; infinite and NaN where there are none."""
        steps = np.full(chain.n_joints, np.inf)
        if self.max_step is not None:
            steps[:] = self.max_step if np.ndim(self.max_step) == 0 else _per_joint(chain, "max_step", self.max_step)
        if self.previous is None:
            return steps, np.full(chain.n_joints, np.nan)
        return steps, np.array(_per_joint(chain, "previous", self.previous))


def upper_arm(chain: ArmChain, elbow_joint: str) -> tuple[int, float]:
    """Number of the joint at the elbow, and its distance from the shoulder in the resting posture [m].

    Raises:
        UserError: if the arm lacks this joint, or it turns about the shoulder itself.
    """
    from mild_viz.robot.kinematics.kernels import arm_forward

    if elbow_joint not in chain.joint_names:
        raise UserError(f"elbow_joint '{elbow_joint}' is unknown; valid: {', '.join(chain.joint_names)}")
    number = chain.joint_names.index(elbow_joint)
    origins, directions, position = np.empty((chain.n_joints, 3)), np.empty((chain.n_joints, 3)), np.empty(3)
    arm_forward(chain.arm, np.array(chain.rest), origins, directions, position)
    length = float(np.linalg.norm(origins[number] - chain.shoulder))
    if length < 1e-3:
        raise UserError(f"elbow_joint '{elbow_joint}' lies in the shoulder; expected a joint farther along the arm")
    return number, length


def _per_joint(chain: ArmChain, name: str, values: object) -> np.ndarray:
    array = np.asarray(values, dtype=float)
    if array.shape != (chain.n_joints,):
        raise UserError(f"{name} has the shape {array.shape}; expected a value for each of {chain.joint_names}")
    return array


def _rows(name: str, values: np.ndarray | None, count: int, dims: int) -> np.ndarray:
    array = np.asarray(values, dtype=float)
    if array.ndim > dims and len(array) != count:
        raise UserError(f"{name} has {len(array)} rows; expected one for all, or one for each of {count} targets")
    return array


def _unit(name: str, vectors: np.ndarray | None) -> np.ndarray:
    """The vectors divided by their length; NaN stays NaN."""
    array = np.asarray(vectors, dtype=float)
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise UserError(f"{name} holds a vector of length 0; expected a direction")
    return array / length
