"""The handovers: the real files, and small bad ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz.data.handover import read_handover
from mild_viz.data.skeletons import ARM_JOINTS, NUITRACK_JOINTS, ZED_JOINTS, joint_indices, person_frame, to_world
from mild_viz.errors import UserError
from mild_viz.trial import Dataset

Load = Callable[[str], Dataset]


def test_handovers_put_both_bodies_back_into_one_world(dataset: Load, data_root: Path) -> None:
    handover = dataset("handover")
    assert (len(handover.train), len(handover.test)) == (160, 40)
    closest = []
    with np.load(data_root / "handover" / "test.npz") as file:
        recorded, offsets = {name: file[name].astype(float) for name in ("receiver", "giver")}, file["offsets"]
    for index, trial in enumerate(handover.test):
        frames = slice(offsets[index], offsets[index + 1])
        assert trial.action == "handover" and trial.rate == 30.0
        wrists = []
        people = ((trial.T_world_human, trial.human_skeleton, trial.human_arm, "receiver"),
                  (trial.T_world_partner, trial.partner_skeleton, trial.partner_arm, "giver"))  # fmt: skip
        for T_world_person, body, arm, role in people:
            assert T_world_person is not None and body is not None and arm is not None
            np.testing.assert_allclose(T_world_person[:3, :3] @ T_world_person[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.linalg.det(T_world_person[:3, :3]) > 0
            np.testing.assert_allclose(to_world(T_world_person, body.positions), recorded[role][frames], atol=1e-12)
            np.testing.assert_array_equal(arm, body.positions[:, joint_indices(ZED_JOINTS, ARM_JOINTS)])
            wrists.append(
                to_world(T_world_person, body.positions[:, joint_indices(ZED_JOINTS, ("right_wrist", "left_wrist"))])
            )
        distance = np.linalg.norm(wrists[0][:, :, None] - wrists[1][:, None], axis=-1).min(axis=0)
        closest.append(np.unravel_index(distance.argmin(), (2, 2)))
    assert set(closest) == {(0, 0)}  # right hand to right hand, always


def heading(rotations: Rotation) -> float:
    """By how much an object has turned about the vertical from the first frame to the last [rad]."""
    return float((rotations[-1] * rotations[0].inv()).as_rotvec()[2])


def test_the_object_turns_with_the_hand_that_holds_it(dataset: Load, data_root: Path) -> None:
    """While the giver holds it, it turns about the vertical as the giver's forearm does, who follows the receiver.

    This tells unit, frame and the quaternion's order: read as xyzw, the object would not turn at all.
    """
    with np.load(data_root / "handover" / "test.npz") as file:
        recorded, offsets = file["object_quaternion"].astype(float), file["offsets"]
    forearm, read, swapped, apart = [], [], [], []
    for index, trial in enumerate(dataset("handover").test):
        track, T_world_human, T_world_partner = trial.object_track, trial.T_world_human, trial.T_world_partner
        assert track is not None and T_world_human is not None and T_world_partner is not None
        assert trial.partner_arm is not None
        giver, receiver = to_world(T_world_partner, trial.partner_arm), to_world(T_world_human, trial.human_arm)
        held = slice(0, int(np.nanargmin(np.linalg.norm(giver[:, 2] - receiver[:, 2], axis=1))) + 1)
        own = Rotation.from_quat(track.wxyzs[held][:, [1, 2, 3, 0]])
        rotations = Rotation.from_matrix(T_world_human[:3, :3]) * own
        along = giver[held, 2] - giver[held, 1]
        angle = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
        forearm.append(angle[-1] - angle[0])
        read.append(heading(rotations))
        swapped.append(heading(Rotation.from_quat(recorded[offsets[index] :][held])))
        apart.append(np.linalg.norm(to_world(T_world_human, track.positions)[held] - giver[held, 2], axis=1))
    assert np.corrcoef(forearm, read)[0, 1] > 0.7 and np.median(forearm) < -0.6 and np.median(read) < -0.6
    assert abs(np.corrcoef(forearm, swapped)[0, 1]) < 0.2 and abs(np.median(swapped)) < 0.1
    assert np.median(np.concatenate(apart)) == pytest.approx(0.31, abs=0.02)


def write_handover(root: Path, **changes: Any) -> None:
    """Two trials of 20 frames: two people 2 m apart who face each other; z is up."""
    body = np.zeros((len(ZED_JOINTS), 3))
    for name, place in {
        "pelvis": (0, 0, 0.9), "neck": (0, 0, 1.4), "head": (0, 0, 1.6), "left_shoulder": (0, 0.2, 1.4),
        "right_shoulder": (0, -0.2, 1.4), "right_elbow": (0, -0.2, 1.1), "right_wrist": (0.3, -0.2, 1.1),
    }.items():  # fmt: skip
        body[ZED_JOINTS.index(name)] = place
    receiver = np.tile(body, (40, 1, 1))
    giver = receiver * [-1.0, -1.0, 1.0] + [2.0, 0.0, 0.0]
    arrays = {"receiver": receiver, "giver": giver, "offsets": np.array([0, 20, 40]), "rate_hz": np.float32(30.0)}
    arrays.update(changes)
    (root / "handover").mkdir(parents=True, exist_ok=True)
    for split in ("train", "test"):
        np.savez(root / "handover" / f"{split}.npz", **arrays)


TURNS = {
    "z": np.eye(3),
    "y": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-z": np.diag([-1.0, 1.0, -1.0]),
}


@pytest.mark.parametrize("up", TURNS)
def test_up_axis_is_found_whichever_it_is(tmp_path: Path, up: str) -> None:
    write_handover(tmp_path)
    with np.load(tmp_path / "handover" / "train.npz") as file:
        receiver, giver = file["receiver"] @ TURNS[up].T, file["giver"] @ TURNS[up].T
    write_handover(tmp_path / "turned", receiver=receiver, giver=giver)
    trial = read_handover(tmp_path / "turned").trial("train", 1)
    assert trial.T_world_human is not None and trial.T_world_partner is not None
    np.testing.assert_allclose(trial.human_arm[3], [[0, -0.2, 0], [0, -0.2, -0.3], [0.3, -0.2, -0.3]], atol=1e-12)
    np.testing.assert_allclose(trial.T_world_human[:3, 2], [0, 0, 1], atol=1e-12)  # z of the person is z of the world
    np.testing.assert_allclose(trial.T_world_human[2, 3], 1.4)
    T_human_partner = np.linalg.inv(trial.T_world_human) @ trial.T_world_partner
    np.testing.assert_allclose(T_human_partner[:3, 3], [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_human_partner[:3, 0], [-1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"giver": np.zeros((40, 33, 3))}, r"giver is float64 of shape \(40, 33, 3\); expected \(N, 34, 3\)"),
        ({"giver": np.zeros((41, 34, 3))}, r"receiver and giver have \(40, 41\) frames"),
        ({"offsets": np.array([0, 20, 39])}, "offsets run from 0 to 39; expected 0 to 40"),
        ({"offsets": np.array([0, 36, 40])}, ".*in steps of at least 10 frames"),
        ({"offsets": np.array([0.0, 40.0])}, "offsets is float64"),
        ({"offsets": np.array([0, 20, 10, 40], dtype=np.uint64)}, "offsets run from 0 to 40; .*at least 10 frames"),
        ({"offsets": np.array(40)}, r"offsets is int64 of shape \(\)"),
        ({"rate_hz": np.float32(0.0)}, "rate_hz is 0.0; expected one number above 0"),
        ({"rate_hz": np.array("fast")}, "rate_hz is fast; expected one number above 0"),
        ({"rate_hz": np.array(30j)}, "rate_hz is 30j; expected one number above 0"),
        ({"rate_hz": np.float32(np.nan)}, "rate_hz is nan; expected one number above 0"),
        (
            {"receiver": np.full((40, 34, 3), np.nan), "giver": np.full((40, 34, 3), np.nan)},
            "head and pelvis are tracked",
        ),
        ({"receiver": np.full((40, 34, 3), np.nan)}, "train trial 0: a person's own frame needs both shoulders"),
        ({"receiver": np.full((40, 34, 3), np.inf)}, "receiver has an infinite coordinate"),
        ({"giver": np.full((40, 34, 3), 1.0)}, "train trial 0: a person's own frame needs both shoulders"),
    ],
)
def test_bad_handover_files_name_file_and_reason(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    write_handover(tmp_path, **changes)
    with pytest.raises(UserError, match=f"handover/train.npz: {complaint}"):
        read_handover(tmp_path)


def test_a_trial_that_begins_with_a_gap_is_read(tmp_path: Path) -> None:
    write_handover(tmp_path)
    whole = read_handover(tmp_path)
    with np.load(tmp_path / "handover" / "train.npz") as file:
        receiver = file["receiver"]
    receiver[20] = np.nan
    receiver[21, ZED_JOINTS.index("neck")] = np.nan
    write_handover(tmp_path, receiver=receiver)
    gap, plain = read_handover(tmp_path).trial("train", 1), whole.trial("train", 1)
    assert gap.T_world_human is not None and plain.T_world_human is not None
    np.testing.assert_allclose(gap.T_world_human, plain.T_world_human, atol=1e-12)
    assert np.isnan(gap.human_arm[0]).all()
    np.testing.assert_allclose(gap.human_arm[1:], plain.human_arm[1:], atol=1e-12)


def test_an_object_is_read_in_the_humans_own_frame_whichever_way_is_up(tmp_path: Path) -> None:
    position = np.tile([0.5, 0.1, 1.2], (40, 1))
    quarter = Rotation.from_euler("z", np.repeat([[0.0], [np.pi / 2]], 20, axis=0))
    position[25] = np.nan
    for up, turn in TURNS.items():
        turned = (Rotation.from_matrix(turn) * quarter * Rotation.from_matrix(turn).inv()).as_quat()[:, [3, 0, 1, 2]]
        turned[25] = np.nan
        write_handover(tmp_path)
        with np.load(tmp_path / "handover" / "train.npz") as file:
            bodies = {name: file[name] @ turn.T for name in ("receiver", "giver")}
        write_handover(tmp_path, **bodies, object_position=position @ turn.T, object_quaternion=turned)
        first, track = (read_handover(tmp_path).trial("train", i).object_track for i in range(2))
        assert first is not None and track is not None, up
        np.testing.assert_allclose(track.positions[4], [0.5, 0.1, -0.2], atol=1e-12)
        before, after = (Rotation.from_quat(one.wxyzs[4, [1, 2, 3, 0]]) for one in (first, track))
        np.testing.assert_allclose((after * before.inv()).as_rotvec(), [0.0, 0.0, np.pi / 2], atol=1e-12)
        assert np.isnan(track.positions[5]).all() and np.isnan(track.wxyzs[5]).all()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"object_position": np.zeros((40, 3))}, " has object_position but no object_quaternion; expected both"),
        (
            {"object_position": np.zeros((39, 3)), "object_quaternion": np.zeros((40, 4))},
            r": object_position is float64 of shape \(39, 3\); expected \(40, 3\)",
        ),
        (
            {"object_position": np.zeros((40, 3)), "object_quaternion": np.zeros((40, 4))},
            ": object_quaternion of frame 0 has length 0; expected unit quaternions",
        ),
        (
            {"object_position": np.full((40, 3), np.inf), "object_quaternion": np.zeros((40, 4))},
            ": object_position has an infinite value",
        ),
    ],
)
def test_a_bad_object_names_file_and_reason(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    write_handover(tmp_path, **changes)
    with pytest.raises(UserError, match=f"handover/train.npz{complaint}"):
        read_handover(tmp_path)


def test_a_recording_in_which_nobody_stands_is_refused(tmp_path: Path) -> None:
    lying = np.random.default_rng(0).normal(size=(40, 34, 3))
    head, pelvis = joint_indices(ZED_JOINTS, ("head", "pelvis"))
    lying[:, head] = lying[:, pelvis] + 1.0
    write_handover(tmp_path, receiver=lying, giver=lying)
    with pytest.raises(UserError, match="heads are above pelvises along .*expected mostly one axis"):
        read_handover(tmp_path)


def test_a_persons_frame_is_right_handed_and_faces_forward() -> None:
    T_world_person = person_frame(*np.array([[0.0, 0.2, 1.4], [0.0, -0.2, 1.4], [0.0, 0.0, 0.9], [0.0, 0.0, 1.4]]))
    np.testing.assert_allclose(T_world_person[:3, :3], np.eye(3), atol=1e-12)
    with pytest.raises(UserError, match="needs both shoulders, the waist and"):
        person_frame(*np.zeros((4, 3)))
    with pytest.raises(UserError, match="no joint 'tail'; it has: head, neck"):
        joint_indices(NUITRACK_JOINTS, ("tail",))
