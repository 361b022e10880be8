"""HRI-Yumi: the real file, and small bad ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.data.yumi import JOINT_NAMES, read_yumi
from mild_viz.errors import UserError
from mild_viz.trial import Dataset

Load = Callable[[str], Dataset]


def objects(*items: Any) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def write_trial(root: Path, data: np.ndarray, labels: np.ndarray) -> None:
    """An HRI-Yumi file whose training and test splits are one and the same trial."""
    path = root / "buetepage_hr" / "traj_data.npz"
    path.parent.mkdir(parents=True)
    np.savez(
        path,
        train_data=objects(data),
        train_labels=objects(labels),
        test_data=objects(data),
        test_labels=objects(labels),
    )


def test_yumi_has_the_papers_windows_at_the_logs_clock(dataset: Load) -> None:
    yumi = dataset("yumi")
    assert (len(yumi.train), len(yumi.test)) == (32, 9)
    assert sum(trial.n_frames - 9 for trial in yumi.test) == 929
    for trial in yumi.train + yumi.test:
        assert trial.rate == 8.0 and trial.robot_joints is not None and trial.active is not None
        assert 10.0 < trial.n_frames / trial.rate < 17.5
        np.testing.assert_array_equal(trial.human_arm[0, 0], 0.0)
        # "Not active" is the rest at the end: once over, it stays over.
        assert trial.active[0] == 1 and (np.diff(trial.active) <= 0).all()


def test_yumi_joints_are_those_of_the_reference_description(dataset: Load, shared: Callable[[str], Path]) -> None:
    """Same names, in the order from the body to the wrist, and every recorded angle within the limits."""
    import xml.etree.ElementTree as ElementTree

    robot = ElementTree.parse(shared("robots/yumi/yumi.urdf")).getroot()
    joints = {joint.get("name"): joint for joint in robot.findall("joint") if joint.find("parent") is not None}
    chain = [joints[name] for name in JOINT_NAMES]
    links = [(joint.find("parent"), joint.find("child")) for joint in chain]
    for (_, child), (parent, _) in zip(links[:-1], links[1:], strict=True):
        assert child is not None and parent is not None and child.get("link") == parent.get("link")
    limits = [joint.find("limit") for joint in chain]
    lower, upper = (
        np.array([float(limit.get(end, "nan")) for limit in limits if limit is not None]) for end in ("lower", "upper")
    )
    for trial in dataset("yumi").train + dataset("yumi").test:
        assert trial.robot_joint_names == JOINT_NAMES and trial.robot_joints is not None
        assert ((lower <= trial.robot_joints) & (trial.robot_joints <= upper)).all()


def yumi_labels(n_frames: int, label: int, active: int) -> np.ndarray:
    labels = np.zeros((n_frames, 5))
    labels[:active, label] = 1
    labels[active:, 4] = 1
    return labels


def test_yumi_keeps_every_fifth_frame(tmp_path: Path) -> None:
    data = np.tile(np.arange(104.0)[:, None], (1, 16))
    write_trial(tmp_path, data, yumi_labels(104, 3, 61))
    trial = read_yumi(tmp_path).trial("train", 0)
    assert trial.action == "parachute" and trial.robot_joints is not None and trial.active is not None
    np.testing.assert_array_equal(trial.robot_joints[:, 0], np.arange(0, 100, 5))
    np.testing.assert_array_equal(trial.human_arm[:, 2, 2], np.arange(0, 100, 5))
    np.testing.assert_array_equal(trial.active, np.arange(0, 100, 5) < 61)


@pytest.mark.parametrize(
    ("labels", "complaint"),
    [
        (np.zeros((104, 4)), r"labels of shape \(104, 4\); expected \(104, 5\)"),
        (np.zeros((104, 5)), "not one-hot"),
        (np.zeros((104, 5), dtype=[("x", "f8")]), "has labels of type .*; expected numbers, 0 or 1"),
        (yumi_labels(104, 3, 0), "labelled with the actions none; expected exactly one"),
        (np.concatenate([yumi_labels(52, 0, 52), yumi_labels(52, 1, 52)]), "the actions wave, handshake"),
    ],
)
def test_bad_yumi_labels_are_refused(tmp_path: Path, labels: np.ndarray, complaint: str) -> None:
    write_trial(tmp_path, np.zeros((104, 16)), labels)
    with pytest.raises(UserError, match=f"traj_data.npz: train trial 0 .*{complaint}"):
        read_yumi(tmp_path)
