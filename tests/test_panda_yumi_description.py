"""Our Panda and YuMi against the reference descriptions, and their committed files against their generator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from urdf_tree import URDFS, Tree, check_generator, check_joints, check_meshes, check_poses

from mild_viz.data.yumi import JOINT_NAMES
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot
from mild_viz.robot.robots import ROBOTS, robot_of

BASES = {"panda": "world", "yumi": "yumi_base_link"}
ADDED = {"panda": (), "yumi": ("gripper_r_tip_joint", "gripper_l_tip_joint")}


@pytest.fixture(scope="module", params=["panda", "yumi"])
def robot(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def ours(robot: str) -> Tree:
    return Tree(URDFS / robot / f"{robot}.urdf")


def test_poses_equal_the_reference(robot: str, ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared(f"robots/{robot}/{robot}.urdf"))
    moving = [name for name, joint in ours.joints.items() if joint.get("type") != "fixed"]
    parents = {Tree.end(joint, "parent") for joint in ours.joints.values()}
    ends = {Tree.end(joint, "child") for name, joint in ours.joints.items() if name not in ADDED[robot]} - parents
    arm = [Tree.end(ours.joints[name], "child") for side in ROBOTS[robot].arms.values() for name in side.joints]
    check_poses(ours, reference, BASES[robot], sorted({*ends, *arm}), moving)


def test_joints_equal_the_reference(robot: str, ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared(f"robots/{robot}/{robot}.urdf"))
    check_joints(ours, reference, ADDED[robot])
    # the reference of YuMi stands in a world frame; ours begins at the robot
    assert set(ours.joints) - set(ADDED[robot]) == set(reference.joints) - {"world_joint"}


def test_meshes_load_coloured_and_small(robot: str, ours: Tree) -> None:
    check_meshes(ours, URDFS / robot, 600_000)


def test_generator_reproduces_the_committed_files(robot: str, tmp_path: Path) -> None:
    check_generator(robot, tmp_path)


def test_the_chain_is_the_tree_and_every_link_follows_it(robot: str, ours: Tree) -> None:
    model = load_robot(robot)
    chain = model.chain
    joints = np.random.default_rng(3).uniform(chain.lower, chain.upper, (20, chain.n_joints))
    ends, poses = forward(chain, joints), model.link_poses(joints)
    drawn = set(model.link_names) & set(model.moving_links)
    for row, values in enumerate(joints):
        angles = (
            dict.fromkeys(ours.joints, 0.0)
            | dict(model.spec.rest)
            | dict(zip(chain.joint_names, values.tolist(), strict=True))
        )
        for name, joint in ours.joints.items():
            follows = joint.find("mimic")
            if follows is not None:
                angles[name] = angles[str(follows.get("joint"))]
        np.testing.assert_allclose(ends[row], ours.pose(chain.end_effector, angles)[:3, 3], atol=1e-6)
        for number, link in enumerate(model.link_names):
            if link in drawn:
                np.testing.assert_allclose(poses[row, number, 4:], ours.pose(link, angles)[:3, 3], atol=1e-6)


def test_ik_with_seven_joints_finds_reachable_points_inside_the_limits(robot: str) -> None:
    chain = load_robot(robot).chain
    rng = np.random.default_rng(5)
    known = np.clip(chain.rest + rng.normal(scale=0.4, size=(200, chain.n_joints)), chain.lower, chain.upper)
    targets, priors = forward(chain, known), np.tile(chain.rest, (200, 1))
    found = solve_ik(chain, targets, priors, 1.0, 1e-6)
    error = np.linalg.norm(forward(chain, found) - targets, axis=1)
    assert np.quantile(error, 0.95) < 1e-3
    assert (found >= chain.lower).all() and (found <= chain.upper).all()
    cost = error**2 + 1e-6 * ((found - priors) ** 2).sum(1)
    assert (cost <= 1e-6 * ((known - priors) ** 2).sum(1) + 1e-9).mean() > 0.9  # never above the known solution's cost


def test_reach_is_what_the_arm_can_do_not_what_its_links_add_up_to() -> None:
    panda, pepper = load_robot("panda").chain, load_robot("pepper").chain
    # joint 4 lets the elbow straighten but for its two offsets; the hand goes on along the forearm, beside it by 88 mm
    assert 0.90 < panda.reach < 0.96 < np.linalg.norm(panda.offsets[1:, :3, 3], axis=1).sum()
    far = np.random.default_rng(1).uniform(panda.lower, panda.upper, (200_000, 7))
    assert np.linalg.norm(forward(panda, far) - panda.shoulder, axis=1).max() < panda.reach
    assert pepper.reach == pytest.approx(np.linalg.norm(pepper.offsets[1:, :3, 3], axis=1).sum(), abs=1e-9)


def test_rests_within_the_limits_and_fingers_leave_the_grasp_point(robot: str) -> None:
    model = load_robot(robot)
    assert set(model.spec.rest) <= {joint.name for joint in model.description.joints}
    assert (model.chain.rest > model.chain.lower).all() and (model.chain.rest < model.chain.upper).all()
    on_path = {joint.name for joint in model.description.path_to(model.chain.end_effector)}
    for hand in model.spec.hands.values():
        assert not on_path & set(hand)
        for name, value in hand.items():
            joint = model.description.joint(name)
            assert joint.lower <= value <= joint.upper


def test_yumi_is_named_in_the_order_of_the_recordings() -> None:
    # ABB's numbering 1, 2, 7, 3, 4, 5, 6 is the order along the arm: load_chain refuses any other
    assert ROBOTS["yumi"].joint_names == JOINT_NAMES
    assert load_robot("yumi").chain.joint_names == JOINT_NAMES


def test_every_dataset_has_a_robot() -> None:
    from mild_viz.data.load import DATASETS
    from mild_viz.errors import UserError

    assert {robot_of(name) for name in DATASETS} == {"pepper", "yumi", "panda", "kobo"}
    with pytest.raises(UserError, match="valid: demo"):
        robot_of("gestures")
