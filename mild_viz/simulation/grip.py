"""When the human's hand holds the robot's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.simulation.settings import HumanHand


def find_grips(
    contact: Bool[np.ndarray, " N"],
    end_effector: Float[np.ndarray, "N 3"],
    target: Float[np.ndarray, "N 3"],
    rate: float,
    hand: HumanHand,
) -> tuple[tuple[int, int], ...]:
    """First and last frame of every grip: within contact, from where the hands meet on.

    Hands meet at the first frame in which commanded end effector and target [m] are within `hand.grasp_distance`,
    or where they come nearest. The commanded motion decides, not the simulated one, so that the same grips are
    compared at every stiffness. Frames without a target are outside.
    """
    distance = np.linalg.norm(end_effector - target, axis=1)
    grips = []
    for first, last in _runs(contact & np.isfinite(distance), int(hand.patience * rate)):
        near = np.flatnonzero(distance[first : last + 1] <= hand.grasp_distance)
        met = first + int(near[0] if len(near) else np.nanargmin(distance[first : last + 1]))
        if met < last and np.isfinite(distance[met : last + 1]).all():
            grips.append((met, last))
    return tuple(grips)


def _runs(flags: Bool[np.ndarray, " N"], gap: int) -> list[tuple[int, int]]:
    """First and last index of every run of true flags; shorter gaps than `gap` do not part them."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    runs: list[tuple[int, int]] = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and first - runs[-1][1] - 1 < gap:
            runs[-1] = (runs[-1][0], end - 1)
        else:
            runs.append((first, end - 1))
    return runs
