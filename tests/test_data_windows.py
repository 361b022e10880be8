"""Gaps, velocities and windows, against loops that follow the convention word by word."""

from __future__ import annotations

import numpy as np
import pytest

from mild_viz.data.windows import fill_gaps, human_features, human_windows, max_gap, pair_windows, windows
from mild_viz.errors import UserError


def random_arm(n_frames: int) -> np.ndarray:
    return np.random.default_rng(n_frames).normal(size=(n_frames, 3, 3))


def test_features_are_positions_then_differences_to_the_previous_frame() -> None:
    arm = random_arm(12)
    features = human_features(arm)
    for frame in range(12):
        velocity = np.zeros(9) if frame == 0 else (arm[frame] - arm[frame - 1]).ravel()
        np.testing.assert_array_equal(features[frame], np.concatenate([arm[frame].ravel(), velocity]))


@pytest.mark.parametrize("n_frames", [10, 11, 40])
def test_robot_window_follows_the_human_window(n_frames: int) -> None:
    arm, joints = random_arm(n_frames), np.random.default_rng(1).normal(size=(n_frames, 4))
    human, robot = pair_windows(arm, joints)
    assert human.shape == (n_frames - 9, 90)
    assert robot.shape == (n_frames - 9, 20)
    features = human_features(arm)
    for n in range(n_frames - 9):
        np.testing.assert_array_equal(human[n], features[n : n + 5].ravel())
        np.testing.assert_array_equal(robot[n], joints[n + 5 : n + 10].ravel())
    np.testing.assert_array_equal(human_windows(arm)[: n_frames - 9], human)


def test_inputs_are_not_changed() -> None:
    arm, joints = random_arm(20), np.zeros((20, 4))
    joints[7] = np.nan
    before = arm.copy(), joints.copy()
    pair_windows(arm, joints)
    fill_gaps(arm, 2)
    np.testing.assert_array_equal(arm, before[0])
    np.testing.assert_array_equal(joints, before[1])


def test_rows_with_a_missing_frame_are_nan_throughout() -> None:
    arm = random_arm(30)
    arm[12, 2, 1] = np.nan
    human, robot = pair_windows(arm, np.ones((30, 4)))
    lost = np.isnan(human)
    assert (lost.all(axis=1) == lost.any(axis=1)).all()
    # Frame 12 itself is in windows 8 to 12, the velocity of frame 13 in windows up to 13.
    np.testing.assert_array_equal(np.flatnonzero(lost.any(axis=1)), np.arange(8, 14))
    assert not np.isnan(robot).any()


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(UserError, match="9 frames has no pair of windows; expected at least 10"):
        pair_windows(random_arm(9), np.zeros((9, 4)))
    with pytest.raises(UserError, match="expected at least 5"):
        windows(np.zeros((4, 3)))


def streamed_fill(positions: np.ndarray, longest: int) -> np.ndarray:
    """What `fill_gaps` promises, one observation at a time."""
    last, age, filled = np.full(positions.shape[1:], np.nan), 0, []
    for frame in positions:
        if np.isnan(frame).any():
            age += 1
            filled.append(last if age <= longest else np.full_like(last, np.nan))
        else:
            last, age = frame, 0
            filled.append(frame)
    return np.array(filled)


@pytest.mark.parametrize("longest", [0, 1, 4])
def test_gap_filling_is_causal(longest: int) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        arm = random_arm(60)
        for start, length in zip(rng.integers(0, 60, 5), rng.integers(1, 8, 5), strict=True):
            arm[start : start + length, rng.integers(3)] = np.nan
        np.testing.assert_array_equal(fill_gaps(arm, longest), streamed_fill(arm, longest))


def test_longest_gap_is_half_a_second() -> None:
    assert (max_gap(30.0), max_gap(8.0), max_gap(20.0)) == (15, 4, 10)
