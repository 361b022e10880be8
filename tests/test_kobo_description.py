"""Kobo is two Pandas on a stand: each arm, seen from its own base, against the reference description of one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from urdf_tree import URDFS, Tree, check_generator, check_meshes

from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot

SIDES = ("right", "left")


@pytest.fixture(scope="module")
def ours() -> Tree:
    return Tree(URDFS / "kobo" / "kobo.urdf")


@pytest.mark.parametrize("side", SIDES)
def test_each_arm_equals_the_reference_panda(side: str, ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared("robots/panda/panda.urdf"))
    moving = [name for name, joint in reference.joints.items() if joint.get("type") != "fixed"]
    links = [f"panda_link{number}" for number in range(1, 8)]
    links += ["panda_hand", "panda_leftfinger", "panda_rightfinger", "end_effector_frame"]
    for name in moving:
        assert ours.limits(f"{side}_{name}") == pytest.approx(reference.limits(name))
    rng = np.random.default_rng(20)
    bounds = np.array([[reference.limits(name)["lower"], reference.limits(name)["upper"]] for name in moving])
    for values in rng.uniform(bounds[:, 0], bounds[:, 1], (1000, len(moving))):
        angles = dict(zip(moving, values.tolist(), strict=True))
        own = dict.fromkeys(ours.joints, 0.0) | {f"{side}_{name}": value for name, value in angles.items()}
        base = np.linalg.inv(ours.pose(f"{side}_panda_link0", own))
        for link in links:
            mine = base @ ours.pose(f"{side}_{link}", own)
            theirs = reference.pose(link, dict.fromkeys(reference.joints, 0.0) | angles)
            assert np.linalg.norm(mine[:3, 3] - theirs[:3, 3]) < 1e-6, link
            # 2 sqrt(2) sin(angle / 2), see `urdf_tree.check_poses`
            assert np.linalg.norm(mine[:3, :3] - theirs[:3, :3]) / np.sqrt(2) < 1e-6, link


def test_the_chains_are_the_tree_and_both_arms_move(ours: Tree) -> None:
    robot = load_robot("kobo")
    rng = np.random.default_rng(3)
    joints = {side: rng.uniform(chain.lower, chain.upper, (20, 7)) for side, chain in robot.arms.items()}
    poses = robot.link_poses(joints["right"], others={"left": joints["left"]})
    for side, chain in robot.arms.items():
        ends = forward(chain, joints[side])
        for row in range(20):
            angles = dict.fromkeys(ours.joints, 0.0)
            angles |= {name: value for other, arm in robot.arms.items()
                       for name, value in zip(arm.joint_names, joints[other][row].tolist(), strict=True)}  # fmt: skip
            np.testing.assert_allclose(ends[row], ours.pose(chain.end_effector, angles)[:3, 3], atol=1e-6)
            link = f"{side}_panda_link7"
            drawn = poses[row, robot.link_names.index(link), 4:]
            np.testing.assert_allclose(drawn, ours.pose(link, angles)[:3, 3], atol=1e-6)


def test_the_hands_rest_level_in_front_of_the_stand_on_the_floor() -> None:
    robot = load_robot("kobo")
    hands = {side: forward(chain, chain.rest[None])[0] for side, chain in robot.arms.items()}
    np.testing.assert_allclose(hands["left"], hands["right"] * (1.0, -1.0, 1.0), atol=1e-6)
    assert 0.4 < hands["right"][0] < 0.9 and 1.0 < hands["right"][2] < 1.5
    assert robot.floor == pytest.approx(0.0, abs=1e-3)


def test_meshes_load_coloured_and_small(ours: Tree) -> None:
    check_meshes(ours, URDFS / "kobo", 600_000, bright=190)  # the white shells are the Panda's


def test_generator_reproduces_the_committed_files(tmp_path: Path) -> None:
    check_generator("kobo", tmp_path)
