"""Pepper's joint angles from a person's arm."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz.robot.model import load_robot
from mild_viz.robot.retarget import retarget_pepper

PITCH, ROLL, YAW, ELBOW = range(4)


def arm(upper: tuple[float, float, float], fore: tuple[float, float, float]) -> np.ndarray:
    """One frame of shoulder, elbow, wrist."""
    shoulder = np.array([0.1, -0.2, 0.0])
    return np.array([[shoulder, shoulder + upper, shoulder + np.add(upper, fore)]])


def straight_from_the_text(frame: np.ndarray) -> np.ndarray:
    """design.md section 4, one frame, with scipy's rotations and arc cosines."""
    u, f = frame[1] - frame[0], frame[2] - frame[1]

    def angle(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0)))

    elbow = np.clip(angle(u, f), 0.0087, 1.562)
    roll = np.clip(np.arcsin(np.clip(min(u[1], -0.0087) / np.linalg.norm(u), -1, 1)), -1.562, -0.0087)
    pitch = np.arctan2(max(u[0], 0.0), u[2]) - np.pi / 2
    turn = Rotation.from_euler("Y", pitch) * Rotation.from_euler("Z", roll) * Rotation.from_euler("Z", elbow)
    return np.array([pitch, roll, angle(f, turn.apply([np.linalg.norm(f), 0.0, 0.0])), elbow])


def test_random_arms_follow_the_definition():
    random = np.random.default_rng(0)
    frames = random.normal(scale=0.3, size=(500, 3, 3))
    expected = np.array([straight_from_the_text(frame) for frame in frames])
    np.testing.assert_allclose(retarget_pepper(frames), expected, atol=1e-7)


@pytest.mark.parametrize(
    ("upper", "fore", "expected"),
    [
        # hanging straight down: pitch 90 degrees, the rolls at the ends of their ranges
        ((0.0, 0.0, -0.3), (0.0, 0.0, -0.25), (np.pi / 2, -0.0290004, None, 0.0087)),
        # stretched forward
        ((0.3, 0.0, 0.0), (0.25, 0.0, 0.0), (0.0, -0.0290004, None, 0.0087)),
        # upper arm down, forearm forward: the elbow at a right angle
        ((0.0, -0.01, -0.3), (0.25, 0.0, 0.0), (np.pi / 2, -0.0333210, None, 1.562)),
        # out to the side
        ((0.0, -0.3, 0.0), (0.0, -0.25, 0.0), (-np.pi / 2, -1.562, None, 0.0087)),
    ],
)
def test_postures(upper, fore, expected):
    angles = retarget_pepper(arm(upper, fore))[0]
    for value, wanted in zip(angles, expected, strict=True):
        if wanted is not None:
            assert value == pytest.approx(wanted, abs=1e-5)


def test_missing_joints_and_limbs_without_length_give_nan_without_warnings():
    frames = np.concatenate([arm((0.0, 0.0, -0.3), (0.2, 0.0, 0.0))] * 4)
    frames[1, 2] = np.nan
    frames[2, 1] = frames[2, 0]
    frames[3, 0, 1] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angles = retarget_pepper(frames)
        assert retarget_pepper(frames[:0]).shape == (0, 4)
    assert np.isfinite(angles[0]).all() and np.isnan(angles[1:]).all()


def test_recorded_arms_stay_within_the_limits(dataset):
    chain = load_robot("pepper").chain
    for trial in dataset("nuisi").train:
        angles = retarget_pepper(trial.partner_arm)
        assert np.isfinite(angles).all()
        inside = (angles[:, [ROLL, ELBOW]] >= chain.lower[[ROLL, ELBOW]] - 1e-4) & (
            angles[:, [ROLL, ELBOW]] <= chain.upper[[ROLL, ELBOW]] + 1e-4
        )
        assert inside.all()
        assert np.all(np.abs(angles[:, PITCH]) <= np.pi / 2 + 1e-12)
        assert np.all(angles[:, YAW] >= 0.0)


def test_pepper_points_where_the_person_points(dataset):
    """Shoulder-to-elbow of Pepper lies along the person's within the clipping and Pepper's crooked elbow."""
    trial = dataset("nuisi").train[10]
    angles = retarget_pepper(trial.partner_arm)
    upper = trial.partner_arm[:, 1] - trial.partner_arm[:, 0]
    pepper = Rotation.from_euler("YZ", angles[:, [PITCH, ROLL]]).apply([1.0, 0.0, 0.0])
    cosine = np.sum(upper * pepper, axis=1) / np.linalg.norm(upper, axis=1)
    in_front = upper[:, 0] > 0.02
    assert in_front.sum() > 50 and np.median(cosine[in_front]) > 0.99
