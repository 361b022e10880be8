"""From where a person's hands are to where a two-armed robot's are: one map for both hands, fitted to what it reaches.

The giver's hand trajectories are re-scaled to fit the robot's task space (Sec. Bimanual Robot-to-Human Handovers). A
workspace is the box that each hand of the training recordings keeps to; the map scales every axis and translates, such
that each box lies inside what the arm of that side reaches. Of all such maps it is the one that leaves the boxes
largest. Both hands have the same one, and no axis is stretched, since the hands hold one object between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import contact_frames
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import RobotModel
from mild_viz.robot.retarget_arm import LARGEST_FRACTION, LOWEST, NEAREST, PRIOR
from mild_viz.settings import MAX_PLACEMENT
from mild_viz.trial import HAND_POINTS, Trial

ARM_OF = dict(zip(HAND_POINTS, ("right", "left"), strict=True))
"""The robot's arm that follows each hand."""

OUTSIDE = 0.05
"""Share of the recorded positions that a box leaves out on each side: hands behind the back, and tracking errors."""

SPACING = 0.05
"""Distance of the points at which an arm's reach is sampled [m]."""

REACHED = 0.01
"""A point is reached if the hand comes this near [m], with the prior of `retarget_arm`."""

SCALES = sorted(product(np.arange(10, 1, -1) / 10.0, repeat=3), key=lambda scale: -np.prod(scale))
"""Scales of the axes that are tried, 0.2 to 1 each, the largest volume first."""


@dataclass(frozen=True)
class Box:
    """A box along the axes of a person's own frame [m]."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        sides = np.subtract(self.upper, self.lower)
        if not ((sides >= 0.0) & (np.abs(self.lower) < MAX_PLACEMENT) & (np.abs(self.upper) < MAX_PLACEMENT)).all():
            raise UserError(
                f"workspace: a box from {self.lower} to {self.upper}; valid: no lower above its upper, and numbers "
                f"below {MAX_PLACEMENT}"
            )


Workspace = tuple[Box, ...]
"""Of each of `HAND_POINTS`."""


@dataclass(frozen=True, eq=False)
class HandMap:
    """Places of a person's hands [m, own frame] to those of a robot's [m, base frame]: scale * point + offset."""

    scale: Float[np.ndarray, "3"]
    offset: Float[np.ndarray, "3"]
    workspace: Workspace

    def __call__(self, hands: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "T P 3"]:
        """Each hand moved into its box where it is outside, and mapped. NaN stays NaN."""
        lower, upper = (np.array([getattr(box, side) for box in self.workspace]) for side in ("lower", "upper"))
        return self.scale * np.clip(hands, lower, upper) + self.offset


def measure_workspace(trials: Sequence[Trial]) -> Workspace:
    """Where the second human's hands are in recordings, but for `OUTSIDE` on each side. `UserError` if nowhere.

    Those of all frames, and of the frames of contact, whatever part of the recordings these are.
    """
    hands, touching = [], []
    for trial in trials:
        points = trial.partner_points
        if points is not None:
            hands.append(points)
            touching.append(contact_frames(trial))
    seen = np.concatenate([*hands, np.empty((0, len(HAND_POINTS), 3))])
    contact = np.concatenate([*touching, np.empty(0, dtype=bool)])
    known = np.isfinite(seen).all(axis=(1, 2))
    if not known.any():
        raise UserError("no trial shows both hands of a second human; expected trials that do")
    lower, upper = np.quantile(seen[known], [OUTSIDE, 1.0 - OUTSIDE], axis=0)
    if (known & contact).any():
        low, high = np.quantile(seen[known & contact], [OUTSIDE, 1.0 - OUTSIDE], axis=0)
        lower, upper = np.minimum(lower, low), np.maximum(upper, high)
    return tuple(Box(tuple(low), tuple(high)) for low, high in zip(lower.tolist(), upper.tolist(), strict=True))


@lru_cache(maxsize=16)  # robots are kept while a page or a stream runs
def hand_map(robot: RobotModel, workspace: Workspace) -> HandMap:
    """The largest map of a workspace into what a robot's two arms reach; of equally large ones the middle one.

    The workspace's middle plane (y = 0) lies between the robot's shoulders.

    Raises:
        UserError: if the robot has not one arm for each hand, or reaches too little.
    """
    missing = [arm for arm in ARM_OF.values() if arm not in robot.arms]
    if missing:
        raise UserError(
            f"robot '{robot.name}' has no {' and no '.join(missing)} arm, which a model of two hands moves; it has: "
            f"{', '.join(robot.arms)}"
        )
    if (first := next(iter(robot.arms))) not in ARM_OF.values():
        raise UserError(
            f"robot '{robot.name}' interacts with its arm '{first}'; a model of two hands moves: "
            f"{', '.join(ARM_OF.values())}; put one of them first in its robot.toml"
        )
    arms = [robot.arms[ARM_OF[point]] for point in HAND_POINTS]
    middle = float(np.mean([arm.shoulder[1] for arm in arms]))
    axes = _grid(arms, middle)
    counts = [_counts(reached(arm, axes)) for arm in arms]
    for scale in map(np.array, SCALES):
        fits = _translations(axes, counts, workspace, scale, middle)
        if len(fits):
            chosen = fits[np.linalg.norm(fits - fits.mean(axis=0), axis=1).argmin()]
            return HandMap(scale, chosen, workspace)
    raise UserError(f"robot '{robot.name}' reaches less than a fifth of where the hands of the recordings are")


def reached(arm: ArmChain, axes: Sequence[Float[np.ndarray, "_"]]) -> Bool[np.ndarray, "X Y Z"]:
    """Which points of a grid [m, base frame] an arm reaches without stretching, clear of its own base and the floor."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    from_shoulder = points - arm.shoulder
    distance, aside = np.linalg.norm(from_shoulder, axis=1), np.linalg.norm(from_shoulder[:, :2], axis=1)
    inside = (distance <= LARGEST_FRACTION * arm.reach) & (aside >= NEAREST * arm.reach)
    inside &= (from_shoulder[:, 0] > 0.0) & (from_shoulder[:, 2] >= -LOWEST * arm.reach)
    near = np.flatnonzero(inside)
    solved = solve_ik(arm, points[near], np.tile(arm.rest, (len(near), 1)), 1.0, PRIOR)
    inside[near] = np.linalg.norm(forward(arm, solved) - points[near], axis=1) <= REACHED
    return inside.reshape([len(axis) for axis in axes])


def _grid(arms: Sequence[ArmChain], middle: float) -> list[Float[np.ndarray, "_"]]:
    """Axes of a grid around all arms, even about the middle plane."""
    reach, origin = max(arm.reach for arm in arms), np.mean([arm.shoulder for arm in arms], axis=0)
    aside = max(abs(float(arm.shoulder[1]) - middle) for arm in arms)
    n, n_aside = int(np.ceil(reach / SPACING)), int(np.ceil((reach + aside) / SPACING))
    steps = SPACING * np.arange(-n, n + 1)
    return [origin[0] + steps, middle + SPACING * np.arange(-n_aside, n_aside + 1), origin[2] + steps]


def _counts(mask: Bool[np.ndarray, "X Y Z"]) -> np.ndarray:
    """Number of points before each corner, along all axes (a summed-volume table)."""
    table = np.pad(mask.astype(np.int64), ((1, 0), (1, 0), (1, 0)))
    return table.cumsum(0).cumsum(1).cumsum(2)


def _translations(
    axes: Sequence[Float[np.ndarray, "_"]],
    counts: Sequence[np.ndarray],
    workspace: Workspace,
    scale: Float[np.ndarray, "3"],
    middle: float,
) -> Float[np.ndarray, "K 3"]:
    """Translations by whole steps of the grid with which each scaled box, widened to grid points, is reached whole."""
    origin = np.array([axes[0][0], middle, axes[2][0]])
    steps = np.stack(np.meshgrid(np.arange(len(axes[0])), np.arange(len(axes[2])), indexing="ij"), -1).reshape(-1, 2)
    offsets = origin + SPACING * np.insert(steps, 1, 0, axis=1)
    fits = np.ones(len(offsets), dtype=bool)
    starts, shape = np.array([axis[0] for axis in axes]), np.array([len(axis) for axis in axes])
    for table, box in zip(counts, workspace, strict=True):
        first = np.floor((scale * np.array(box.lower) + offsets - starts) / SPACING + 1e-9).astype(int)
        last = np.ceil((scale * np.array(box.upper) + offsets - starts) / SPACING - 1e-9).astype(int) + 1
        fits &= ((first >= 0) & (last <= shape)).all(axis=1)
        low, high = np.clip(first, 0, shape), np.clip(last, 0, shape)
        found = np.zeros(len(offsets), dtype=np.int64)
        for corner in np.ndindex(2, 2, 2):
            index = np.where(np.array(corner, dtype=bool), high, low)
            found += (-1) ** (3 - sum(corner)) * table[tuple(index.T)]
        fits &= found == (high - low).prod(axis=1)
    return offsets[fits]
