"""The object of a handover in the robot's hand, and then in the receiver's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz import paths
from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.skeletons import to_world
from mild_viz.pipeline import control, infer
from mild_viz.robot.carried import OBJECT_LENGTH, carry_object
from mild_viz.robot.contact import transfer_frame
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from mild_viz.trial import Dataset, ObjectTrack

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def moving_hand(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A hand that goes up and turns, and stops at the origin without a turn in row 6."""
    left = np.clip(6 - np.arange(n), 0, None)
    places = np.stack([0.1 * left, np.zeros(n), -0.05 * left], axis=1)
    return places, Rotation.from_euler("zx", np.stack([0.2 * left, 0.1 * left], axis=1)).as_quat()[:, [3, 0, 1, 2]]


def test_the_object_is_rigid_in_the_robots_hand_and_does_not_jump_where_the_hands_meet() -> None:
    hand, wxyzs = moving_hand(12)
    # the receiver's hand meets the robot's in row 6, 10 cm below the tracked point
    positions = np.array([0.0, 0.0, 0.1]) + np.outer(np.clip(np.arange(12) - 6, 0, None), [0.02, 0.0, 0.0])
    track = ObjectTrack(positions, np.tile(IDENTITY, (12, 1)))
    carried = carry_object(track, 6, np.eye(4), hand, wxyzs)
    assert carried.by_robot.tolist() == [True] * 6 + [False] * 6
    np.testing.assert_allclose(carried.poses[6:, 4:], positions[6:], atol=1e-12)
    in_hand = Rotation.from_quat(wxyzs[:6, [1, 2, 3, 0]]).inv().apply(carried.poses[:6, 4:] - hand[:6])
    np.testing.assert_allclose(in_hand, np.tile([0.0, 0.0, 0.1], (6, 1)), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(carried.poses[:6, :4] * wxyzs[:6], axis=1)), 1.0, atol=1e-12)


def test_the_robot_never_holds_the_object_beside_itself() -> None:
    hand, wxyzs = moving_hand(12)
    for place in ([1.0, 0.0, 2.0], [0.0, 0.0, -0.5], [0.3, 0.2, 0.1]):
        track = ObjectTrack(np.tile(place, (12, 1)), np.tile(IDENTITY, (12, 1)))
        carried = carry_object(track, 6, np.eye(4), hand, wxyzs)
        up = Rotation.from_quat(carried.poses[:6, [1, 2, 3, 0]]).apply([0.0, 0.0, 1.0])
        along = np.sum((carried.poses[:6, 4:] - hand[:6]) * up, axis=1)
        np.testing.assert_allclose(carried.poses[:6, 4:] - along[:, None] * up, hand[:6], atol=1e-12)  # on its axis
        assert (along > -1e-12).all() and (along < OBJECT_LENGTH + 1e-12).all()


def test_an_object_that_was_lost_at_the_transfer_is_held_as_it_was_seen_next() -> None:
    hand, wxyzs = moving_hand(12)
    positions, seen = np.tile([0.0, 0.0, 0.1], (12, 1)), np.tile(IDENTITY, (12, 1))
    positions[5:8] = seen[5:8] = np.nan
    carried = carry_object(ObjectTrack(positions, seen), 6, np.eye(4), hand, wxyzs)
    assert np.isfinite(carried.poses[:6]).all() and np.isnan(carried.poses[6:8]).all()
    nowhere = carry_object(ObjectTrack(positions * np.nan, seen * np.nan), 6, np.eye(4), hand, wxyzs)
    assert np.isnan(nowhere.poses).all() and not nowhere.by_robot.any()


def test_recorded_handovers_give_the_object_to_the_receiver(dataset: Callable[[str], Dataset]) -> None:
    checkpoint = load_checkpoint(paths.default_checkpoint("handover"))
    robot = load_robot("panda")
    jumps = []
    for trial in dataset("handover").test[:6]:
        assert trial.object_track is not None and trial.T_world_human is not None
        inference = infer(checkpoint, trial, "v3.1")
        rollout = control(inference, checkpoint, robot, trial, ControlSettings())
        poses, by_robot, moment = rollout.object_poses, rollout.object_by_robot, transfer_frame(trial)
        assert poses is not None and by_robot is not None and moment is not None
        last = moment - 4  # rows begin with the fifth frame
        assert by_robot[:last].all() and not by_robot[last:].any()
        recorded = to_world(rollout.T_world_human, trial.object_track.positions[4 : 4 + len(poses)])
        np.testing.assert_allclose(poses[last:, 4:], recorded[last:], atol=1e-12)
        # a rigid grasp
        apart = np.linalg.norm(poses[:last, 4:] - rollout.end_effector[:last], axis=1)
        assert np.ptp(apart) < 1e-9 and apart.max() <= OBJECT_LENGTH
        jumps.append(np.linalg.norm(poses[last, 4:] - poses[last - 1, 4:]))
        # the giver, seen by the receiver: right hand beside the object in the beginning
        giver = inference.partner_skeleton
        assert giver is not None and inference.object_track is not None
        hand = giver.positions[:, giver.joint_names.index("right_hand")]
        assert np.linalg.norm(hand[0] - inference.object_track.positions[0]) == pytest.approx(0.27, abs=0.06)
    assert np.median(jumps) < 0.15


def test_without_an_object_or_a_common_world_there_is_no_transfer(dataset: Callable[[str], Dataset]) -> None:
    trial = dataset("nuisi").test[0]
    assert transfer_frame(trial) is None
    checkpoint = load_checkpoint(paths.default_checkpoint("nuisi"))
    inference = infer(checkpoint, trial, "v3.1")
    assert inference.handed_over is None and inference.object_track is None and inference.partner_skeleton is None
