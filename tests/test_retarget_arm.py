"""A person's hand on a longer robot arm: place, limits, rate, gaps; and all real handovers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mild_viz.errors import UserError
from mild_viz.pairs import robot_truth, stack_windows
from mild_viz.robot.contact import contact_frames, in_frame, upright
from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot
from mild_viz.robot.placement import recorded_placement
from mild_viz.robot.retarget_arm import LARGEST_FRACTION, MAX_RATE, retarget_arm, scaled_wrist
from mild_viz.robot.robots import ROBOTS
from mild_viz.trial import Trial

PANDA = load_robot("panda").chain
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
    hand = forward(PANDA, retarget_arm(PANDA, arm, RATE))
    np.testing.assert_allclose(hand, PANDA.shoulder + PANDA.reach * reach, atol=2e-3)  # the resting posture's price


def test_the_farthest_hand_leaves_room_to_adapt() -> None:
    arm = np.tile([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.6, 0.0, 0.0]], (5, 1, 1))
    expected = PANDA.shoulder + [LARGEST_FRACTION * PANDA.reach, 0.0, 0.0]
    np.testing.assert_allclose(scaled_wrist(PANDA, arm, np.eye(3)), np.tile(expected, (5, 1)), atol=1e-12)
    turned = scaled_wrist(PANDA, arm, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(turned[:, 1], expected[0], atol=1e-12)


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


def test_all_handovers_become_motions_that_the_panda_can_make(dataset: Callable[[str], Any]) -> None:
    handover = dataset("handover")
    errors, touching, spread = [], [], []
    for trial in handover.train + handover.test:
        joints = robot_truth(trial, ROBOTS["panda"].joint_names)
        assert (joints >= PANDA.lower).all() and (joints <= PANDA.upper).all()
        assert np.abs(np.diff(joints, axis=0)).max() <= MAX_RATE / trial.rate + 1e-9
        world = trial.T_world_partner
        wanted = scaled_wrist(PANDA, trial.partner_arm, upright(world) @ world[:3, :3])
        errors.append(np.linalg.norm(forward(PANDA, joints) - wanted, axis=1))
        touching.append(contact_frames(trial))
        spread.append(joints)
    error, contact = np.concatenate(errors), np.concatenate(touching)
    assert np.median(error) < 1.5e-3 and np.median(error[contact]) < 1.5e-3
    assert np.quantile(error[contact], 0.95) < 0.05
    assert (np.concatenate(spread).std(0)[[0, 1, 3]] > 0.1).all()  # the motion is not the resting posture


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
