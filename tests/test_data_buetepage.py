"""Bütepage's human-human set: small files in the layout of the authors' preprocessing (the real one is not at hand)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.data.buetepage import read_buetepage
from mild_viz.data.commands import check, list_datasets
from mild_viz.data.download import fetch
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.pairs import stack_windows
from mild_viz.robot.robots import ROBOTS


def objects(*items: Any) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def one_hot(n_frames: int, label: int, active: int) -> np.ndarray:
    return np.eye(5)[np.where(np.arange(n_frames) < active, label, 4)]


def people(n_frames: int, seed: int) -> np.ndarray:
    """Two right arms that hang and are raised, each from its own first shoulder, as (T, 18)."""
    rng = np.random.default_rng(seed)
    swing = np.linspace(0.0, 1.2, n_frames)[:, None] + rng.normal(scale=0.01, size=(1, 2))
    down = np.stack([np.sin(swing), np.zeros_like(swing), -np.cos(swing)], axis=-1)
    shoulder = np.zeros((n_frames, 2, 1, 3))
    arms = np.concatenate([shoulder, 0.3 * down[:, :, None], 0.55 * down[:, :, None]], axis=2)
    return arms.reshape(n_frames, 18)


def write(root: Path, **changes: Any) -> Path:
    """A set of two training trials and one test trial; object arrays are pickles, as the authors write them."""
    arrays: dict[str, Any] = {
        "train_data": objects(people(104, 0), people(80, 1)),
        "train_labels": objects(one_hot(104, 3, 61), one_hot(80, 0, 80)),
        "test_data": objects(people(90, 2)),
        "test_labels": objects(one_hot(90, 1, 70)),
    }
    path = root / "buetepage" / "traj_data.npz"
    path.parent.mkdir(parents=True)
    np.savez(path, **(arrays | changes))
    return path


def test_reads_both_arms_at_a_fifth_of_the_frames(tmp_path: Path) -> None:
    write(tmp_path)
    dataset = read_buetepage(tmp_path)
    assert [trial.action for trial in dataset.train + dataset.test] == ["parachute", "wave", "handshake"]
    trial, frames = dataset.trial("train", 0), people(104, 0)[:100:5].reshape(20, 2, 3, 3)
    assert trial.rate == 8.0 and trial.partner_arm is not None and trial.active is not None
    np.testing.assert_array_equal(trial.human_arm, frames[:, 0])
    np.testing.assert_array_equal(trial.partner_arm, frames[:, 1])
    np.testing.assert_array_equal(trial.active, np.arange(0, 100, 5) < 61)
    assert load_dataset("buetepage", tmp_path).checksum == dataset.checksum


def test_gives_windows_for_both_kinds_of_models(tmp_path: Path) -> None:
    write(tmp_path)
    trials = read_buetepage(tmp_path).train
    human = stack_windows(trials, None)
    assert human.human.shape == human.partner.shape == (20 - 9 + 16 - 9, 90) and human.complete.all()
    robot = stack_windows(trials, ROBOTS["pepper"].joint_names)
    assert robot.partner.shape == (18, 20) and robot.complete.all()


def test_commands_know_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list_datasets(tmp_path) == 0
    assert "buetepage" in capsys.readouterr().out
    path = write(tmp_path)
    assert list_datasets(tmp_path) == 0
    assert "2 + 1" in capsys.readouterr().out
    assert check(path) == 0
    printed = capsys.readouterr().out
    assert "human-human" in printed and "parachute" in printed


def test_is_not_fetched_without_a_known_checksum(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"'buetepage' cannot be fetched.*phd_utils.*buetepage/traj_data.npz"):
        fetch("buetepage", tmp_path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"test_data": objects(people(90, 2)[:, :16])}, r"test trial 0 is float64 of shape \(90, 16\).*\(T, 18\)"),
        ({"test_labels": objects(1)}, r"test trial 0 has labels of shape \(\); expected \(90, 5\)"),
        ({"test_labels": objects(np.zeros((90, 5)))}, "test trial 0 has labels that are not one-hot"),
        (
            {"test_data": objects(people(49, 2)), "test_labels": objects(one_hot(49, 1, 49))},
            "test trial 0 has 49 frames; expected at least 50",
        ),
        ({"test_data": objects()}, "test_data is .*expected one entry a trial"),
    ],
)
def test_bad_files_name_file_and_reason(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    write(tmp_path, **changes)
    with pytest.raises(UserError, match=f"buetepage/traj_data.npz.*{complaint}"):
        read_buetepage(tmp_path)
