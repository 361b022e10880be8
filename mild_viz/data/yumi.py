"""HRI-Yumi: a human's right arm and the right arm of a YuMi that was guided through the same interactions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from mild_viz.data.checks import LABELS, TRAJECTORY_ARRAYS, check_trial_array, file_checksum, paired
from mild_viz.data.npz import load_npz
from mild_viz.errors import UserError
from mild_viz.trial import Dataset, Trial

FILE = Path("buetepage_hr/traj_data.npz")
NOT_ACTIVE = len(LABELS)
"""Fifth label: the hands have come to rest at the end of the trial."""

LOG_RATE = 40.0
"""The robot log's TIME column steps by 0.025 s [Hz]."""

KEEP_EVERY = 5
"""The paper's protocol keeps 0.2 of the frames."""

ARM_COLUMNS = 9
JOINT_NAMES = tuple(f"yumi_joint_{number}_r" for number in (1, 2, 7, 3, 4, 5, 6))
"""The right arm from the body to the wrist, in ABB's numbering, as YuMi's description names the joints."""


def read_yumi(root: Path) -> Dataset:
    """HRI-Yumi from `root`: human right arm [m], YuMi's right arm joints [rad].

    Of every five frames the first is kept, floor(T / 5) of them, so that a trial has as many windows as in
    the paper's protocol (929 in the test split); the authors interpolate, we keep recorded frames. The rate is
    what the log's clock makes of it, 8 Hz, although the paper says 20 Hz.
    """
    path = Path(root) / FILE
    train, test = read_file(path)
    return Dataset(
        name="yumi",
        title="HRI-Yumi: a person and a YuMi wave, shake hands, bump fists (8 Hz)",
        train=tuple(train),
        test=tuple(test),
        checksum=file_checksum(path),
    )


def read_file(path: Path) -> tuple[list[Trial], list[Trial]]:
    """The training and the test trials of an HRI-Yumi `traj_data.npz`."""
    arrays = load_npz(path, TRAJECTORY_ARRAYS)
    return _read_split(path, "train", arrays), _read_split(path, "test", arrays)


def _read_split(path: Path, split: str, arrays: dict[str, np.ndarray]) -> list[Trial]:
    trials = []
    for index, (data, labels) in enumerate(paired(path, arrays, split)):
        where = f"{path}: {split} trial {index}"
        frames = check_trial_array(where, data, ARM_COLUMNS + len(JOINT_NAMES))
        action, active = read_labels(where, labels, len(frames))
        kept = kept_frames(len(frames))
        trials.append(
            Trial(
                dataset="yumi",
                split=split,
                index=index,
                action=action,
                rate=LOG_RATE / KEEP_EVERY,
                human_arm=frames[kept, :ARM_COLUMNS].reshape(-1, 3, 3),
                robot_joints=frames[kept, ARM_COLUMNS:],
                robot_joint_names=JOINT_NAMES,
                active=active[kept],
            )
        )
    return trials


def kept_frames(n_frames: int) -> slice:
    """Of every five frames the first, floor(n / 5) of them."""
    return slice(0, n_frames // KEEP_EVERY * KEEP_EVERY, KEEP_EVERY)


def read_labels(where: str, labels: Any, n_frames: int) -> tuple[str, Int[np.ndarray, " T"]]:
    """The one action of a trial, and 1 in each frame in which it is going on, from one-hot rows (T, 5)."""
    one_hot = np.asarray(labels)
    if one_hot.shape != (n_frames, NOT_ACTIVE + 1):
        raise UserError(f"{where} has labels of shape {one_hot.shape}; expected {(n_frames, NOT_ACTIVE + 1)}")
    if one_hot.dtype.kind not in "fiub":
        raise UserError(f"{where} has labels of type {one_hot.dtype}; expected numbers, 0 or 1")
    if not (np.isin(one_hot, (0, 1)).all() and (one_hot.sum(axis=1) == 1).all()):
        raise UserError(f"{where} has labels that are not one-hot; expected one 1 and four 0 in every row")
    label = one_hot.argmax(axis=1)
    actions = np.unique(label[label != NOT_ACTIVE])
    if len(actions) != 1:
        names = ", ".join(LABELS[number] for number in actions) or "none"
        raise UserError(f"{where} is labelled with the actions {names}; expected exactly one")
    return LABELS[actions[0]], (label != NOT_ACTIVE).astype(np.int64)
