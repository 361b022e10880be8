"""NuiSI and its raw Nuitrack recordings: the real files, and small bad ones."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import unavailable

from mild_viz.data import commands, nuitrack
from mild_viz.data.load import load_dataset
from mild_viz.data.nuisi import RAW_FILES, read_nuisi
from mild_viz.data.skeletons import ARM_JOINTS, NUITRACK_JOINTS, joint_indices
from mild_viz.data.windows import fill_gaps, max_gap, pair_windows
from mild_viz.errors import UserError
from mild_viz.trial import Dataset

Load = Callable[[str], Dataset]


def objects(*items: Any) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def write_trials(root: Path, data: list[Any], labels: list[float]) -> Path:
    """A NuiSI file whose training split is `data`, and whose test split is its first trial."""
    path = root / "nuisi" / "traj_data.npz"
    path.parent.mkdir(parents=True)
    np.savez(
        path,
        train_data=objects(*data),
        train_labels=np.array(labels),
        test_data=objects(data[0]),
        test_labels=np.array(labels[:1]),
    )
    return path


def test_nuisi_is_complete(dataset: Load) -> None:
    nuisi = dataset("nuisi")
    assert nuisi.actions == ("wave", "handshake", "rocket", "parachute")
    counts = {
        action: [sum(t.action == action for t in nuisi.split(s)) for s in ("train", "test")] for action in nuisi.actions
    }
    assert counts == {"wave": [9, 3], "handshake": [8, 3], "rocket": [9, 3], "parachute": [7, 2]}
    for trial in nuisi.train + nuisi.test:
        assert trial.rate == 30.0 and trial.partner_arm is not None
        assert trial.robot_joints is None and trial.T_world_human is None
        for arm in (trial.human_arm, trial.partner_arm):
            assert arm.dtype == np.float64 and np.isfinite(arm).all() and not arm.flags.writeable
            # The frame's origin is the collar and y points to the left: the right shoulder is 17 cm to the right.
            np.testing.assert_allclose(arm[0, 0], [0.0, -0.17, 0.0], atol=0.025)
    assert sum(t.n_frames - 9 for t in nuisi.test) == 1213 + 663 + 553 + 552


def test_raw_rockets_reproduce_the_published_trials_for_both_persons(dataset: Load, data_root: Path) -> None:
    nuisi = dataset("nuisi")
    rockets = [trial for trial in nuisi.train + nuisi.test if trial.action == "rocket"]
    assert [trial.split for trial in rockets] == ["train"] * 9 + ["test"] * 3
    arm = joint_indices(NUITRACK_JOINTS, ARM_JOINTS)
    for file, person in zip(RAW_FILES, ("human", "partner"), strict=True):
        if not (data_root / file).is_file():
            unavailable(f"{data_root / file} is missing; run: mild-viz data fetch nuisi")
        bodies = nuitrack.read_trials(data_root / file)
        assert len(bodies) == len(rockets) == 12
        for trial, body in zip(rockets, bodies, strict=True):
            published = trial.human_arm if person == "human" else trial.partner_arm
            assert published is not None
            np.testing.assert_allclose(body.positions[:, arm], published, rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(body.positions[:, arm], published, rtol=0.0, atol=2e-15)


def test_rocket_trials_carry_whole_upper_bodies(dataset: Load, data_root: Path) -> None:
    if not all((data_root / file).is_file() for file in RAW_FILES):
        unavailable(f"{data_root / RAW_FILES[0]} is missing; run: mild-viz data fetch nuisi")
    for trial in dataset("nuisi").train + dataset("nuisi").test:
        bodies = (trial.human_skeleton, trial.partner_skeleton)
        if trial.action != "rocket":
            assert bodies == (None, None)
            continue
        for body in bodies:
            assert body is not None and body.joint_names == NUITRACK_JOINTS
            assert body.positions.shape == (trial.n_frames, 14, 3) and np.isfinite(body.positions).all()
            first = dict(zip(NUITRACK_JOINTS, body.positions[0], strict=True))
            # A person who stands upright in the person's own frame: x forward, y left, z up, collar at the origin.
            np.testing.assert_allclose(first["right_collar"], 0.0, atol=1e-12)
            assert 0.1 < first["head"][2] < 0.35 and -0.65 < first["waist"][2] < -0.35
            assert first["left_shoulder"][1] > 0.1 and first["right_shoulder"][1] < -0.1
            lengths = [np.ptp(body.positions[0][[a, b]], axis=0).max() for a, b in body.bones]
            assert max(lengths) < 0.5


def test_nuisi_without_the_raw_recordings(dataset: Load, data_root: Path, tmp_path: Path) -> None:
    whole = dataset("nuisi")
    (tmp_path / "nuisi").mkdir()
    shutil.copy(data_root / "nuisi" / "traj_data.npz", tmp_path / "nuisi")
    bare = read_nuisi(tmp_path)
    assert bare.checksum == whole.checksum  # a model trained on either is the same
    assert all(trial.human_skeleton is None for trial in bare.train + bare.test)
    np.testing.assert_array_equal(bare.train[20].human_arm, whole.train[20].human_arm)


def test_raw_recordings_of_other_trials_are_refused(dataset: Load, data_root: Path, tmp_path: Path) -> None:
    dataset("nuisi")
    (tmp_path / "nuisi" / "raw").mkdir(parents=True)
    shutil.copy(data_root / "nuisi" / "traj_data.npz", tmp_path / "nuisi")
    if not (data_root / RAW_FILES[1]).is_file():
        unavailable(f"{data_root / RAW_FILES[1]} is missing; run: mild-viz data fetch nuisi")
    shutil.copy(data_root / RAW_FILES[1], tmp_path / RAW_FILES[0])
    with pytest.raises(UserError, match="Rocket_p1.txt does not belong to nuisi/train/17: its human's arm differs"):
        read_nuisi(tmp_path)


@pytest.mark.parametrize(
    ("data", "label", "complaint"),
    [
        (np.zeros((20, 17)), 0.0, r"train trial 0 is float64 of shape \(20, 17\); expected numbers of shape \(T, 18\)"),
        (np.zeros(18), 0.0, r"of shape \(18,\)"),
        (np.zeros((9, 18)), 0.0, "has 9 frames; expected at least 10"),
        (np.full((20, 18), np.inf), 0.0, "frame 0, column 0 is inf; expected finite or NaN"),
        (np.zeros((20, 18)), 4.0, "has label 4.0; valid: 0 wave, 1 handshake, 2 rocket, 3 parachute"),
        (np.zeros((20, 18)), 0.5, "has label 0.5"),
        (np.full((20, 18), "a"), 0.0, "is <U1"),
    ],
)
def test_bad_nuisi_files_name_file_trial_and_reason(tmp_path: Path, data: Any, label: float, complaint: str) -> None:
    write_trials(tmp_path, [data], [label])
    with pytest.raises(UserError, match=f"traj_data.npz: .*{complaint}"):
        read_nuisi(tmp_path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"train_labels": np.zeros(1, dtype=[("action", "i8")])}, r"train trial 0 has label \(0,\); valid: 0 wave"),
        ({"train_labels": np.zeros(1, dtype=complex)}, "train trial 0 has label 0j; valid: 0 wave"),
        ({"train_labels": np.array(0.0)}, r"train_labels is float64 of shape \(\); expected one entry a trial"),
        ({"train_data": np.array(1.0)}, r"train_data is float64 of shape \(\); expected one entry a trial"),
        (
            {"test_data": np.zeros((0, 20, 18))},
            r"test_data is float64 of shape \(0, 20, 18\); expected one entry a trial",
        ),
        ({"test_data": np.zeros((1, 20), dtype=[("x", "f8")])}, r"test trial 0 is \[\('x', '<f8'\)\] of shape \(20,\)"),
    ],
)
def test_arrays_of_another_kind_are_refused_and_listed_as_unusable(
    tmp_path: Path, changes: dict[str, np.ndarray], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_trials(tmp_path, [np.zeros((20, 18))], [0.0])
    with np.load(path, allow_pickle=True) as file:
        arrays: dict[str, Any] = dict(file) | changes
    np.savez(path, **arrays)
    for read in (lambda: read_nuisi(tmp_path), lambda: commands.check(path)):
        with pytest.raises(UserError, match=f"{path}: {complaint}"):
            read()
    assert commands.list_datasets(tmp_path) == 1
    assert "unusable" in capsys.readouterr().out


def test_trials_and_labels_must_pair_up(tmp_path: Path) -> None:
    path = write_trials(tmp_path, [np.zeros((20, 18))] * 2, [0.0])
    with pytest.raises(UserError, match=f"{path}: train_data has 2 trials and train_labels 1"):
        read_nuisi(tmp_path)


def test_lost_frames_stay_gaps_and_are_bridged_by_windows(tmp_path: Path) -> None:
    data = np.random.default_rng(0).normal(size=(60, 18))
    data[20:23] = np.nan
    data[40:, :9] = np.nan
    write_trials(tmp_path, [data], [1.0])
    trial = load_dataset("nuisi", tmp_path).trial("train", 0)
    assert trial.partner_arm is not None
    np.testing.assert_array_equal(np.isnan(trial.human_arm[:, 0, 0]), np.isnan(data[:, 0]))
    filled = fill_gaps(trial.human_arm, max_gap(trial.rate))
    np.testing.assert_array_equal(filled[22], trial.human_arm[19])
    human, _ = pair_windows(filled, fill_gaps(trial.partner_arm, max_gap(trial.rate)).reshape(60, 9))
    # 15 lost frames are bridged (40 to 54); windows from 51 on would need frame 55.
    np.testing.assert_array_equal(np.isnan(human).any(axis=1), np.arange(51) + 4 >= 55)


# The raw Nuitrack text


def nuitrack_line(frame: int, positions: np.ndarray | None) -> str:
    if positions is None:
        return f"{frame},{1693077907064 + 33 * frame},0"
    joints = [f"{i},0.75,0.5,0.5,1000,{x:.3f},{y:.3f},{z:.3f}" for i, (x, y, z) in enumerate(positions)]
    return ",".join([f"{frame},{1693077907064 + 33 * frame},25", *joints])


def standing_person() -> np.ndarray:
    """25 joints in the camera's frame [mm], facing the camera, 1.2 m away; only those that a frame needs differ."""
    positions = np.tile([0.0, 300.0, 1200.0], (25, 1))
    # Camera: x to its right, y up, z away. The person faces it, so the person's left is at the camera's right.
    positions[6], positions[12] = [150.0, 300.0, 1200.0], [-150.0, 300.0, 1200.0]
    positions[4] = [0.0, -200.0, 1200.0]
    positions[14] = [-150.0, 300.0, 900.0]
    positions[[0, 10, 16, 20, 24]] = 0.0
    return positions


def write_recording(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_hand_held_towards_the_camera_is_in_front_of_the_person(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "p.txt", [nuitrack_line(n, standing_person()) for n in range(12)])
    (body,) = nuitrack.read_trials(path, ((0, 12),))
    wrist = body.positions[0, NUITRACK_JOINTS.index("right_wrist")]
    np.testing.assert_allclose(wrist, [0.3, -0.15, 0.0], atol=1e-12)
    np.testing.assert_allclose(body.positions[0, NUITRACK_JOINTS.index("waist")], [0.0, 0.0, -0.5], atol=1e-12)


def test_lines_of_three_fields_are_lost_frames(tmp_path: Path) -> None:
    lines = [nuitrack_line(n, None if n in (0, 5) else standing_person()) for n in range(12)]
    path = write_recording(tmp_path / "p.txt", lines)
    recording = nuitrack.read_recording(path)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(recording).all(axis=(1, 2))), [0, 5])
    assert np.isnan(recording[:, 10]).all()  # a joint that Nuitrack never fills is not at the camera
    (body,) = nuitrack.read_trials(path, ((1, 12),))
    np.testing.assert_array_equal(np.isnan(body.positions).any(axis=(1, 2)), np.arange(11) == 4)
    # A trial that begins with a lost frame has its own frame from the next one; the gap stays a gap.
    (later,) = nuitrack.read_trials(path, ((0, 12),))
    np.testing.assert_array_equal(np.isnan(later.positions).any(axis=(1, 2)), np.isin(np.arange(12), (0, 5)))
    np.testing.assert_array_equal(later.positions[1:], body.positions)
    lost = write_recording(tmp_path / "lost.txt", [nuitrack_line(n, None) for n in range(12)])
    with pytest.raises(UserError, match=f"{lost}, frames 0 to 12: .*tracked and apart in one frame at least"):
        nuitrack.read_trials(lost, ((0, 12),))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda lines: [], "is empty; expected one line"),
        (lambda lines: lines[:-1] + [lines[-1][:500]], "line 12 has .* fields; valid: 3 or 203"),
        (lambda lines: lines[:-1], "has 11 frames; the listed trials need 12: is it truncated"),
        (lambda lines: lines[:3] + lines[4:], "line 4 has frame number 4; expected 3"),
        (lambda lines: [lines[0].replace("0.75", "high")] + lines[1:], "line 1: could not convert string to float"),
        (lambda lines: [lines[0].replace("0.75", "inf")] + lines[1:], "line 1 holds an infinite number"),
    ],
)
def test_damaged_recordings_name_file_and_line(
    tmp_path: Path, change: Callable[[list[str]], list[str]], complaint: str
) -> None:
    lines = change([nuitrack_line(n, standing_person()) for n in range(12)])
    path = tmp_path / "p.txt"
    path.write_text("".join(line + "\n" for line in lines))
    with pytest.raises(UserError, match=f"{path}.*{complaint}"):
        nuitrack.read_trials(path, ((0, 12),))
    with pytest.raises(UserError, match="absent.txt cannot be read: No such file"):
        nuitrack.read_recording(tmp_path / "absent.txt")
