"""NuiSI: human-human wave, handshake, rocket and parachute fistbump, right arms at 30 Hz."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mild_viz.data import nuitrack
from mild_viz.data.checks import LABELS, TRAJECTORY_ARRAYS, check_trial_array, file_checksum, paired
from mild_viz.data.npz import load_npz
from mild_viz.data.skeletons import ARM_JOINTS, NUITRACK_JOINTS, joint_indices
from mild_viz.errors import UserError
from mild_viz.trial import Dataset, Skeleton, Trial

RATE = 30.0
FILE = Path("nuisi/traj_data.npz")
RAW_FILES = (Path("nuisi/raw/Rocket_p1.txt"), Path("nuisi/raw/Rocket_p2.txt"))
"""Raw recordings of person 1 (the human) and person 2 (the partner); only these were published with the trials."""

MATCH_TOLERANCE = 1e-6
"""Largest difference between a raw recording and the published trial that was cut from it [m]."""


def read_nuisi(root: Path) -> Dataset:
    """NuiSI from `root`, with the whole upper bodies of the rocket trials where the raw recordings are present.

    The checksum is that of the .npz file: the raw recordings add bodies to draw, never other arms.
    """
    path = Path(root) / FILE
    train, test = read_file(path)
    for file, field in zip(RAW_FILES, ("human", "partner"), strict=True):
        if (root / file).exists():
            train, test = _attach_bodies(root / file, field, train, test)
    return Dataset(
        name="nuisi",
        title="NuiSI: two people wave, shake hands, bump fists (Nuitrack, 30 Hz)",
        train=tuple(train),
        test=tuple(test),
        checksum=file_checksum(path),
    )


def read_file(path: Path) -> tuple[list[Trial], list[Trial]]:
    """The training and the test trials of a NuiSI `traj_data.npz`: right arms of both persons, (T, 18) each."""
    arrays = load_npz(path, TRAJECTORY_ARRAYS)
    return _read_split(path, "train", arrays), _read_split(path, "test", arrays)


def _read_split(path: Path, split: str, arrays: dict[str, np.ndarray]) -> list[Trial]:
    trials = []
    for index, (data, label) in enumerate(paired(path, arrays, split)):
        where = f"{path}: {split} trial {index}"
        number = np.asarray(label)
        if number.ndim != 0 or number.dtype.kind not in "fiu" or number not in range(len(LABELS)):
            meanings = ", ".join(f"{number} {action}" for number, action in enumerate(LABELS))
            raise UserError(f"{where} has label {label}; valid: {meanings}")
        arms = check_trial_array(where, data, 18).reshape(-1, 2, 3, 3)
        trials.append(
            Trial(
                dataset="nuisi",
                split=split,
                index=index,
                action=LABELS[int(number)],
                rate=RATE,
                human_arm=arms[:, 0],
                partner_arm=arms[:, 1],
            )
        )
    return trials


def _attach_bodies(path: Path, person: str, train: list[Trial], test: list[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Give the rocket trials the body of `person` ('human' or 'partner') from the raw recording at `path`."""
    rockets = [trial for trial in train + test if trial.action == "rocket"]
    bodies = nuitrack.read_trials(path)
    if len(rockets) != len(bodies):
        raise UserError(f"{path} holds {len(bodies)} rocket trials; the NuiSI file beside it has {len(rockets)}")
    body_of: dict[str, Skeleton] = {}
    for trial, body in zip(rockets, bodies, strict=True):
        arm = trial.human_arm if person == "human" else trial.partner_arm
        raw_arm = body.positions[:, joint_indices(NUITRACK_JOINTS, ARM_JOINTS)]
        if arm is None or not _agree(arm, raw_arm):
            raise UserError(f"{path} does not belong to {trial.name}: its {person}'s arm differs from the trial's")
        body_of[trial.name] = body

    def dressed(trial: Trial) -> Trial:
        body = body_of.get(trial.name)
        return trial if body is None else replace(trial, **{f"{person}_skeleton": body})

    return [dressed(trial) for trial in train], [dressed(trial) for trial in test]


def _agree(published: np.ndarray, raw: np.ndarray) -> bool:
    return published.shape == raw.shape and np.allclose(published, raw, rtol=0.0, atol=MATCH_TOLERANCE, equal_nan=True)
