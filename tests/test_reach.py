"""The reach volume: every posture's hand is inside, and every radius is a real one."""

from __future__ import annotations

import numpy as np
import pytest

from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot
from mild_viz.robot.reach import reach_volume


@pytest.mark.parametrize("name", ["pepper", "panda"])
def test_hands_are_inside_and_the_border_is_reached(name: str) -> None:
    chain = load_robot(name).chain
    volume = reach_volume(chain)
    assert volume.radius.max() == pytest.approx(chain.reach, abs=5e-3)
    np.testing.assert_allclose(np.linalg.norm(volume.vertices - chain.shoulder, axis=1), volume.radius, atol=1e-9)

    # other postures than those that it was made of: none is outside by more than what 8 degrees make
    joints = np.random.default_rng(7).uniform(chain.lower, chain.upper, (20_000, chain.n_joints))
    hands = forward(chain, joints) - chain.shoulder
    directions = (volume.vertices - chain.shoulder) / np.maximum(volume.radius, 1e-12)[:, None]
    reached = volume.radius > 0.0
    nearest = np.argmax(hands @ directions[reached].T, axis=1)
    beyond = np.linalg.norm(hands, axis=1) - volume.radius[reached][nearest]
    assert np.quantile(beyond, 0.999) < 0.02 and beyond.max() < 0.12

    # a point near the border can be touched, one beyond it cannot
    best = int(volume.radius.argmax())
    direction = (volume.vertices[best] - chain.shoulder) / volume.radius[best]
    for share, touched in ((0.97, True), (1.1, False)):
        target = chain.shoulder + share * volume.radius[best] * direction
        starts = np.random.default_rng(1).uniform(chain.lower, chain.upper, (50, chain.n_joints))
        found = solve_ik(chain, np.tile(target, (50, 1)), starts, 1.0, 1e-9)
        assert (np.linalg.norm(forward(chain, found) - target, axis=1).min() < 0.01) == touched


def test_pepper_does_not_reach_through_its_own_back() -> None:
    chain = load_robot("pepper").chain
    volume = reach_volume(chain)
    lateral = (volume.vertices - chain.shoulder) @ [0.0, 1.0, 0.0]
    assert lateral.max() < 0.5 * chain.reach  # the right shoulder's roll keeps the arm on the right side
    assert lateral.min() < -0.9 * chain.reach
