"""The arm beside the one that interacts: mirrored, following the left hand, both, or at rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.pipeline import control, infer
from mild_viz.robot.control import rules
from mild_viz.robot.control.other_arm import mirrored, other_arm_options
from mild_viz.robot.control.safety import limits_of
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import OTHER_SAVED, Rollout
from mild_viz.settings import OTHER_ARM, ControlSettings
from mild_viz.trial import Trial

pytest_plugins = ["demo_fixtures"]


def run(model: Checkpoint, robot: RobotModel, trial: Trial, other_arm: str, **settings: Any) -> Rollout:
    return control(infer(model, trial, "v3.1"), model, robot, trial, ControlSettings(other_arm=other_arm, **settings))


@pytest.mark.parametrize("name", ["pepper", "yumi", "kobo"])
def test_mirrored_joints_put_the_hand_at_the_mirror_image(name: str) -> None:
    """Across the plane y = 0, to the precision of the descriptions; the sides swap for the robot's other arm."""
    two = load_robot(name)
    right, left = two.arms["right"], two.arms["left"]
    rng = np.random.default_rng(0)
    joints = rng.uniform(
        np.maximum(right.lower, -3.0) + 0.02, np.minimum(right.upper, 3.0) - 0.02, (50, right.n_joints)
    )
    joints = joints[(np.abs(mirrored(two, "left", joints)) == np.abs(joints)).all(1)]  # those within the left limits
    assert len(joints) > 20
    there = forward(left, mirrored(two, "left", joints))
    np.testing.assert_allclose(there, forward(right, joints) * [1.0, -1.0, 1.0], atol=5e-3)
    other = load_robot(name, left.joint_names)
    assert list(other.arms) == ["left", "right"]
    np.testing.assert_array_equal(mirrored(other, "right", mirrored(two, "left", joints)), joints)


def test_at_rest_nothing_changes(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    rollout = run(model, robot, handshake, "rest")
    assert rollout.other_arms == ()
    left = robot.link_names.index("LForeArm")
    assert (np.ptp(rollout.link_poses[:, left], axis=0) == 0.0).all()


def test_mild_is_the_mirror_image_of_the_decoded_joints(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    plain, rollout = (run(model, robot, handshake, other, controller="mild") for other in ("rest", "mild"))
    np.testing.assert_array_equal(rollout.joints_commanded, plain.joints_commanded)
    (arm,) = rollout.other_arms
    assert (arm.name, arm.controller, arm.joint_names) == ("left", "mild", robot.spec.arms["left"].joints)
    np.testing.assert_array_equal(arm.joints_commanded, rollout.joints_commanded * [1.0, -1.0, -1.0, -1.0])
    np.testing.assert_array_equal(arm.stiffness, rollout.stiffness)
    np.testing.assert_array_equal(arm.end_effector, forward(robot.arms["left"], arm.joints_commanded))
    np.testing.assert_allclose(arm.hand_distance, np.linalg.norm(arm.end_effector - arm.target, axis=1))
    # the page draws both
    hands = [robot.link_names.index(name) for name in ("RForeArm", "LForeArm")]
    right, left = (rollout.link_poses[:, hand, 4:] for hand in hands)
    np.testing.assert_allclose(left, right * [1.0, -1.0, 1.0], atol=1e-3)
    ghost = rollout.link_poses_decoded[:, hands[1], 4:]
    assert np.abs(ghost - left).max() > 0.01


def test_base_ik_follows_the_left_hand(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    (arm,) = run(model, robot, handshake, "base-ik").other_arms
    skeleton, chain = handshake.human_skeleton, robot.arms["left"]
    assert skeleton is not None
    rollout = run(model, robot, handshake, "rest")
    wrist = skeleton.positions[4 : 4 + len(arm.target), skeleton.joint_names.index("left_wrist")]
    T = rollout.T_world_human
    np.testing.assert_allclose(arm.target, wrist @ T[:3, :3].T + T[:3, 3], atol=1e-12)
    nearest = solve_ik(chain, arm.target[60:], arm.joints_commanded[60:], 1.0, 0.0)
    best = np.linalg.norm(forward(chain, nearest) - arm.target[60:], axis=1)
    assert np.median(arm.hand_distance[60:] - best) < 0.01
    assert ((arm.fired >> rules.BY_IK) & 1).all()


def test_mild_ik_is_both(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    plain, adapted = (run(model, robot, handshake, other).other_arms[0] for other in ("mild", "mild-ik"))
    by_ik = (adapted.fired >> rules.BY_IK) & 1 == 1
    np.testing.assert_array_equal(by_ik, run(model, robot, handshake, "rest").contact)
    first = int(np.argmax(by_ik))
    np.testing.assert_array_equal(adapted.joints_commanded[:first], plain.joints_commanded[:first])
    assert np.mean(adapted.hand_distance[by_ik]) < np.mean(plain.hand_distance[by_ik])


@pytest.mark.parametrize("other_arm", ["mild", "base-ik", "mild-ik"])
def test_the_other_arm_keeps_its_limits(model: Checkpoint, robot: RobotModel, handshake: Trial, other_arm: str) -> None:
    (arm,) = run(model, robot, handshake, other_arm).other_arms
    limits = limits_of(robot.arms["left"], robot.spec.safety)
    assert (arm.joints_commanded >= limits.lower).all() and (arm.joints_commanded <= limits.upper).all()
    moved = np.diff(arm.joints_commanded, axis=0, prepend=limits.rest[None]) * handshake.rate
    assert (np.abs(moved) <= limits.velocity + 1e-9).all()
    changed = np.diff(moved, axis=0, prepend=0 * moved[:1]) * handshake.rate
    assert (np.abs(changed) <= limits.acceleration + 1e-6).all()


def test_it_is_in_the_rollouts_file(model: Checkpoint, robot: RobotModel, handshake: Trial, tmp_path: Path) -> None:
    rollout = run(model, robot, handshake, "mild")
    rollout.save(tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as arrays:
        for name in OTHER_SAVED:
            np.testing.assert_array_equal(arrays[f"left_{name}"], getattr(rollout.other_arms[0], name))
        np.testing.assert_array_equal(arrays["fired"], rollout.fired)


def test_only_what_can_be_is_offered(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    body = handshake.human_skeleton
    assert other_arm_options(robot, body) == OTHER_ARM
    assert other_arm_options(robot, None) == ("rest", "mild")
    assert other_arm_options(replace(robot, arms={"right": robot.chain}), body) == ()
    unlike = replace(robot, spec=replace(robot.spec, arms={
        name: replace(arm, mirror_of=None, mirror_signs=()) for name, arm in robot.spec.arms.items()
    }))  # fmt: skip
    assert other_arm_options(unlike, body) == ("rest", "base-ik")
    for offered in OTHER_ARM:  # and what is offered is not refused
        run(model, robot, handshake, offered)
    run(model, unlike, handshake, "base-ik")


def test_what_cannot_be_is_refused(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    with pytest.raises(UserError, match="other_arm 'both' is unknown; valid: rest, base-ik, mild, mild-ik"):
        ControlSettings(other_arm="both")
    bare = replace(handshake, human_skeleton=None)
    with pytest.raises(UserError, match="left hand was not recorded, which base-ik needs; valid .*: rest, mild"):
        run(model, robot, bare, "base-ik")
    assert np.isnan(run(model, robot, bare, "mild").other_arms[0].target).all()
    lone = replace(robot, arms={"right": robot.chain})
    with pytest.raises(UserError, match="robot pepper has one arm; valid for the other arm: rest"):
        control(infer(model, handshake, "v3.1"), model, lone, handshake, ControlSettings(other_arm="mild"))
    unlike = replace(robot, spec=replace(robot.spec, arms={
        name: replace(arm, mirror_of=None, mirror_signs=()) for name, arm in robot.spec.arms.items()
    }))  # fmt: skip
    with pytest.raises(UserError, match="nothing says how arm 'left' mirrors 'right'; valid for it: rest, base-ik"):
        run(model, unlike, handshake, "mild")
    with pytest.raises(UserError, match="other_arm is mild; valid for a stream, which drives the arms .*: rest"):
        streaming.stream_model(
            model, "v3.1", "handshake", robot, ControlSettings(other_arm="mild"), np.eye(4), handshake.rate
        )


def test_what_cannot_be_mirrored_is_not_offered(handshake: Trial) -> None:
    """An arm of fewer joints than the mirror's signs: Pepper's without the elbow's roll."""
    three = load_robot("pepper", load_robot("pepper").chain.joint_names[:3])
    assert other_arm_options(three, handshake.human_skeleton) == ("rest", "base-ik")
    with pytest.raises(UserError, match="nothing says how arm 'left' mirrors 'right'"):
        mirrored(three, "left", three.chain.rest[None])
