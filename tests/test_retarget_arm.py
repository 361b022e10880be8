"""A person's hand on a longer robot arm: place, limits, rate, gaps; and all real handovers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz.data.windows import fill_gaps, max_gap
from mild_viz.errors import UserError
from mild_viz.pairs import robot_truth, stack_windows
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import contact_frames, in_frame, upright
from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot
from mild_viz.robot.placement import recorded_placement
from mild_viz.robot.position_rule import PositionRule
from mild_viz.robot.retarget_arm import LARGEST_FRACTION, MAX_RATE, retarget_arm, scaled_wrist
from mild_viz.robot.robots import ROBOTS
from mild_viz.trial import Trial

PANDA, YUMI = load_robot("panda").chain, load_robot("yumi").chain
RATE = 30.0
T = 60


def reaching(n_frames: int = T) -> np.ndarray:
    """An arm of 0.55 m whose wrist goes from 55 % to 90 % of reach, forward and to the right."""
    share = 0.55 + 0.35 * (1.0 - np.cos(np.linspace(0.0, np.pi, n_frames))) / 2.0
    along = np.stack([np.cos(-0.5 * share), np.sin(-0.5 * share), -0.3 * share], axis=1)
    wrist = 0.55 * share[:, None] * along / np.linalg.norm(along, axis=1, keepdims=True)
    # the elbow lies below: both halves are 0.275 m long
    down = np.array([0.0, 0.0, -1.0]) - wrist * (-wrist[:, 2:] / (wrist**2).sum(1, keepdims=True))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    elbow = 0.5 * wrist + down * np.sqrt(0.275**2 - (wrist**2).sum(1, keepdims=True) / 4.0)
    return np.stack([np.zeros_like(wrist), elbow, wrist], axis=1) + [0.1, -0.2, 1.3]


def test_keeps_direction_and_fraction_of_reach() -> None:
    arm = reaching()
    reach = (arm[:, 2] - arm[:, 0]) / 0.55
    hand = forward(YUMI, retarget_arm(YUMI, arm, RATE))
    np.testing.assert_allclose(hand, YUMI.shoulder + YUMI.reach * reach, atol=5e-3)  # the other terms' price
    lifted = PANDA.shoulder + PANDA.reach * reach + [0.0, 0.0, PANDA.position.lift]
    far = np.linalg.norm(lifted - PANDA.shoulder, axis=1) > LARGEST_FRACTION * PANDA.reach
    hand = forward(PANDA, retarget_arm(PANDA, arm, RATE))
    assert not far.all()
    np.testing.assert_allclose(hand[~far], lifted[~far], atol=5e-3)


def test_the_farthest_hand_leaves_room_to_adapt() -> None:
    arm = np.tile([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.6, 0.0, 0.0]], (5, 1, 1))
    expected = YUMI.shoulder + [LARGEST_FRACTION * YUMI.reach, 0.0, 0.0]
    np.testing.assert_allclose(scaled_wrist(YUMI, arm, np.eye(3)), np.tile(expected, (5, 1)), atol=1e-12)
    turned = scaled_wrist(YUMI, arm, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(turned[:, 1] - YUMI.shoulder[1], expected[0] - YUMI.shoulder[0], atol=1e-12)
    far = np.linalg.norm(scaled_wrist(PANDA, arm, np.eye(3)) - PANDA.shoulder, axis=1)
    np.testing.assert_allclose(far, LARGEST_FRACTION * PANDA.reach, atol=1e-12)  # lifted, and no farther


def test_a_hanging_arm_stays_clear_of_base_and_floor() -> None:
    hanging = np.tile([[0.0, 0.0, 0.0], [0.0, -0.02, -0.3], [-0.03, -0.03, -0.55]], (5, 1, 1))
    hand = forward(PANDA, retarget_arm(PANDA, hanging, RATE))
    assert (np.linalg.norm(hand[:, :2], axis=1) > 0.29).all() and (hand[:, 0] > 0.0).all()
    assert (hand[:, 2] > PANDA.shoulder[2] - 0.6).all()


def test_turns_no_faster_than_it_says_even_where_tracking_jumps() -> None:
    arm = reaching()
    arm[30:32, 2] += [-0.3, 0.5, 0.4]
    joints = retarget_arm(PANDA, arm, RATE)
    step = np.abs(np.diff(joints, axis=0)).max()
    assert step == pytest.approx(MAX_RATE / RATE)
    # back where it was once the rate allows it
    np.testing.assert_allclose(joints[50:], retarget_arm(PANDA, reaching(), RATE)[50:], atol=1e-6)


def test_untracked_frames_stay_so_and_touch_no_other() -> None:
    arm = reaching()
    gap = arm.copy()
    gap[20:25, 1] = np.nan
    joints, whole = retarget_arm(PANDA, gap, RATE), retarget_arm(PANDA, arm, RATE)
    assert np.isnan(joints[20:25]).all() and np.isfinite(np.delete(joints, np.s_[20:25], axis=0)).all()
    np.testing.assert_allclose(joints[25:], whole[25:], atol=1e-3)
    assert np.isnan(retarget_arm(PANDA, np.full((4, 3, 3), np.nan), RATE)).all()


def pointing(chain: ArmChain, joints: np.ndarray) -> np.ndarray:
    """Where the hand points (T, 3), by the chain's matrices."""
    hand = np.tile(np.eye(3), (len(joints), 1, 1))
    for offset, axis, angles in zip(chain.offsets[:-1], chain.axes, joints.T, strict=True):
        hand = hand @ offset[:3, :3] @ Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    return hand @ chain.offsets[-1, :3, :3] @ chain.position.tool_axis


def elbows(chain: ArmChain, joints: np.ndarray) -> np.ndarray:
    """Where the elbow is (T, 3), by the kinematics of the arm up to its joint."""
    n = chain.joint_names.index(chain.elbow or "")
    upper = replace(
        chain, joint_names=chain.joint_names[:n], lower=chain.lower[:n], upper=chain.upper[:n], rest=chain.rest[:n],
        velocity=chain.velocity[:n], offsets=chain.offsets[: n + 1], axes=chain.axes[:n],
    )  # fmt: skip
    return forward(upper, joints[:, :n])


def test_the_elbow_lies_as_the_rule_says() -> None:
    arm = np.tile([[0.0, 0.0, 0.0], [0.25, 0.0, -0.2], [0.5, 0.0, -0.2]], (3, 1, 1))
    aside = []
    for arm[:, 1, 1] in (-0.12, 0.12):
        joints = retarget_arm(YUMI, arm, RATE)
        np.testing.assert_allclose(forward(YUMI, joints), scaled_wrist(YUMI, arm, np.eye(3)), atol=2e-3)
        elbow, hand = elbows(YUMI, joints)[0] - YUMI.shoulder, forward(YUMI, joints)[0] - YUMI.shoulder
        assert elbow[2] < 0.3 * hand[2]  # below the line to the hand
        aside.append(elbow[1])
    assert aside[1] > aside[0] + 0.02  # as the person's
    joints = retarget_arm(PANDA, arm, RATE)
    elbow, hand = elbows(PANDA, joints)[0] - PANDA.shoulder, forward(PANDA, joints)[0] - PANDA.shoulder
    assert elbow[2] > 0.1 > hand[2] and abs(elbow[1]) < 0.01  # above it, in the vertical plane


def test_an_arm_without_a_rule_keeps_the_place_of_the_hand() -> None:
    arm, made = reaching(), replace(PANDA, position=PositionRule())
    hand = forward(made, retarget_arm(made, arm, RATE))
    np.testing.assert_allclose(hand, made.shoulder + made.reach * (arm[:, 2] - arm[:, 0]) / 0.55, atol=2e-3)


@pytest.mark.parametrize(
    ("name", "robot", "median", "contact_95", "at_rate"),
    [
        ("handover", "panda", 0.0015, 0.005, 0.15),
        ("handover", "yumi", 0.0010, 0.015, 0.18),
        # people wave and bump faster than the rate admits on an arm 1.7 times as long
        ("nuisi", "panda", 0.0015, 0.070, 0.43),
        ("nuisi", "yumi", 0.0035, 0.030, 0.50),
    ],
)
def test_all_recordings_become_motions_that_the_robot_can_make(
    name: str, robot: str, median: float, contact_95: float, at_rate: float, dataset: Callable[[str], Any]
) -> None:
    chain = PANDA if robot == "panda" else YUMI
    recorded = dataset(name)
    errors, touching, moved, tilts, rates = [], [], [], [], []
    for trial in recorded.train + recorded.test:
        joints = robot_truth(trial, chain.joint_names)
        assert (joints >= chain.lower).all() and (joints <= chain.upper).all()
        world = trial.T_world_partner
        rotation = np.eye(3) if world is None else upright(world) @ world[:3, :3]
        arm = fill_gaps(trial.partner_arm, max_gap(trial.rate))
        errors.append(np.linalg.norm(forward(chain, joints) - scaled_wrist(chain, arm, rotation), axis=1))
        touching.append(contact_frames(trial))
        tilts.append(np.degrees(np.arcsin(pointing(chain, joints)[:, 2])))
        rates.append(np.abs(np.diff(joints, axis=0)).max(axis=1) * trial.rate)
        moved.append(joints)
    error, contact, tilt, speed = (np.concatenate(lists) for lists in (errors, touching, tilts, rates))
    held, in_contact = np.mean(speed > MAX_RATE - 1e-6), np.quantile(error[contact], [0.5, 0.95])
    print(
        f"{name} {robot}: hand {1e3 * np.median(error):.1f} mm off (median), in contact {1e3 * in_contact[0]:.1f} mm, "
        f"95 % within {1e3 * in_contact[1]:.1f} mm; tilt in contact {np.median(tilt[contact]):.0f} deg; "
        f"fastest joint {speed.max():.3f} rad/s, at the rate in {held:.1%} of the steps; no limit exceeded"
    )
    assert speed.max() <= MAX_RATE + 1e-9 and held < at_rate
    assert np.median(error) < median and in_contact[1] < contact_95
    assert abs(np.median(tilt[contact])) < 35.0  # 62 to 77 degrees down without the term, for the Panda
    assert (np.concatenate(moved).std(0)[[0, 1, 3]] > 0.1).all()  # the motion is not the resting posture


def test_windows_for_training_repeat_exactly(dataset: Callable[[str], Any]) -> None:
    trials = dataset("handover").train[:3]
    first, second = (stack_windows(trials, ROBOTS["panda"].joint_names) for _ in range(2))
    assert first.partner.shape[1] == 35 and first.complete.all()
    np.testing.assert_array_equal(first.partner, second.partner)


def test_the_hands_meet_where_the_handover_took_place(dataset: Callable[[str], Any]) -> None:
    """The robot stands in the giver's place: its retargeted hand comes near the receiver's in contact."""
    for trial in dataset("handover").test[:10]:
        placed = recorded_placement(PANDA, trial)
        assert placed is not None
        contact = contact_frames(trial)
        receiver = in_frame(placed.T_world_human, trial.human_arm[contact, 2])
        hand = forward(PANDA, robot_truth(trial, ROBOTS["panda"].joint_names)[contact])
        between = np.median(np.linalg.norm(hand - receiver, axis=1))
        assert between < 0.15, trial.name


@pytest.mark.parametrize("name", ["demo", "nuisi"])
def test_any_partner_can_be_retargeted(name: str, dataset: Callable[[str], Any]) -> None:
    trial = dataset(name).test[0]
    for joints in (ROBOTS["panda"].joint_names, ROBOTS["yumi"].joint_names):
        truth = robot_truth(trial, joints)
        assert truth.shape == (trial.n_frames, 7) and np.isfinite(truth).all()
    np.testing.assert_array_equal(robot_truth(trial, ROBOTS["pepper"].joint_names).shape, (trial.n_frames, 4))


def test_without_a_partner_or_a_known_robot_there_is_no_truth() -> None:
    trial = Trial("made", "test", 0, "handover", RATE, human_arm=reaching(), partner_arm=reaching())
    assert robot_truth(trial, ROBOTS["panda"].joint_names).shape == (T, 7)
    with pytest.raises(UserError, match="no motion for the joints elbow; it has no recorded robot"):
        robot_truth(trial, ("elbow",))
    with pytest.raises(UserError, match="no motion for the joints panda_joint1"):
        robot_truth(replace(trial, partner_arm=None), ROBOTS["panda"].joint_names)
