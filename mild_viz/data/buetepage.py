"""Bütepage's human-human interactions: the right arms of two people, from the recordings that HRI-Yumi continues.

The layout is that of the authors' preprocessing: per frame (T, 18) right shoulder, elbow and wrist of person 1, then
of person 2, each turned to x forward, y left, z up, and moved to that person's own right shoulder in the first frame;
labels per frame, one-hot of 5, the fifth where nobody moves any more. Two things are taken over from HRI-Yumi, because
nothing that was found states them for these files: the clock (40 Hz), and that lengths are metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mild_viz.data.checks import TRAJECTORY_ARRAYS, check_trial_array, file_checksum, paired
from mild_viz.data.npz import load_npz
from mild_viz.data.windows import MIN_FRAMES
from mild_viz.data.yumi import ARM_COLUMNS, KEEP_EVERY, LOG_RATE, kept_frames, read_labels
from mild_viz.errors import UserError
from mild_viz.trial import Dataset, Trial

FILE = Path("buetepage/traj_data.npz")


def read_buetepage(root: Path) -> Dataset:
    """The human-human set from `root`: right arms [m] of both, of every five frames the first, as HRI-Yumi."""
    path = Path(root) / FILE
    train, test = read_file(path)
    return Dataset(
        name="buetepage",
        title="Bütepage human-human: two people wave, shake hands, bump fists (8 Hz)",
        train=tuple(train),
        test=tuple(test),
        checksum=file_checksum(path),
    )


def read_file(path: Path) -> tuple[list[Trial], list[Trial]]:
    """The training and the test trials of a human-human `traj_data.npz`."""
    arrays = load_npz(path, TRAJECTORY_ARRAYS)
    return _read_split(path, "train", arrays), _read_split(path, "test", arrays)


def _read_split(path: Path, split: str, arrays: dict[str, np.ndarray]) -> list[Trial]:
    trials = []
    for index, (data, labels) in enumerate(paired(path, arrays, split)):
        where = f"{path}: {split} trial {index}"
        frames = check_trial_array(where, data, 2 * ARM_COLUMNS)
        action, active = read_labels(where, labels, len(frames))
        kept = kept_frames(len(frames))
        arms = frames[kept].reshape(-1, 2, 3, 3)
        if len(arms) < MIN_FRAMES:
            raise UserError(f"{where} has {len(frames)} frames; expected at least {KEEP_EVERY * MIN_FRAMES}")
        trials.append(
            Trial(
                dataset="buetepage",
                split=split,
                index=index,
                action=action,
                rate=LOG_RATE / KEEP_EVERY,
                human_arm=arms[:, 0],
                partner_arm=arms[:, 1],
                active=active[kept],
            )
        )
    return trials
