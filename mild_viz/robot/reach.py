"""Where an arm's hand can be: the outer boundary of its reach, by direction from the shoulder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from mild_viz.robot.chain import ArmChain
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.trial import freeze_arrays

SUBDIVISIONS = 3
"""Of the icosahedron whose corners are the directions: 642 of them, 8 degrees apart."""
SAMPLES = 300_000
STARTS = 6
"""Random postures from which IK stretches the arm out in every direction: random postures rarely are so."""


@dataclass(frozen=True, eq=False)
class ReachVolume:
    """A surface around the arm's shoulder. Where a direction cannot be reached at all it touches the shoulder."""

    vertices: Float[np.ndarray, "V 3"]
    """In the robot's base frame [m]."""
    faces: Int[np.ndarray, "F 3"]
    radius: Float[np.ndarray, " V"]
    """Farthest place that the hand was found at in a vertex' direction, from the shoulder [m]."""


@lru_cache(maxsize=16)  # chains are immutable, and kept by their robot
def reach_volume(chain: ArmChain) -> ReachVolume:
    """The reach of an arm's end effector inside the joint limits, about a third of a second the first time.

    Postures are sampled, random ones and ones that IK stretched out, and each direction takes the farthest hand among
    those that are nearest to it: every radius is that of a real posture. It is an outer boundary: holes inside, such
    as right before the shoulder, are not shown.
    """
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    directions = np.asarray(ball.vertices)
    rng = np.random.default_rng(0)
    lower, upper = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
    starts = rng.uniform(lower, upper, (STARTS * len(directions), chain.n_joints))
    stretched = solve_ik(chain, chain.shoulder + 10.0 * np.tile(directions, (STARTS, 1)), starts, 1.0, 0.0)
    random = rng.uniform(lower, upper, (SAMPLES, chain.n_joints))
    hands = forward(chain, np.concatenate([stretched, random])) - chain.shoulder
    distance = np.linalg.norm(hands, axis=1)
    radius = np.zeros(len(directions))
    np.maximum.at(radius, _nearest(directions, hands), distance)
    vertices = chain.shoulder + directions * radius[:, None]
    volume = ReachVolume(vertices, np.asarray(ball.faces, dtype=np.int64), radius)
    freeze_arrays(volume)
    return volume


def _nearest(directions: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Number of the direction that is nearest to each point's."""
    from scipy.spatial import KDTree

    lengths = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray(KDTree(directions).query(points / lengths)[1], dtype=np.int64)
