"""What every reader checks of a file before it makes trials of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.data.windows import MIN_FRAMES
from mild_viz.errors import UserError

TRAJECTORY_ARRAYS = ("train_data", "train_labels", "test_data", "test_labels")
"""What a `traj_data.npz` of the authors holds."""

LABELS = ("wave", "handshake", "rocket", "parachute")
"""Action of each label number in the authors' files."""


def file_checksum(*paths: Path) -> str:
    """SHA-256 of the contents of the files, one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


def listed(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    """`array`, which must hold one entry a trial: a single number or an empty array raises a `UserError`."""
    if array.ndim == 0 or len(array) == 0:
        raise UserError(f"{path}: {name} is {array.dtype} of shape {array.shape}; expected one entry a trial")
    return array


def paired(path: Path, arrays: dict[str, np.ndarray], split: str) -> Iterator[tuple[Any, Any]]:
    """The trials and labels of one split of a `traj_data.npz`, side by side."""
    data, labels = (listed(path, name, arrays[name]) for name in (f"{split}_data", f"{split}_labels"))
    if len(data) != len(labels):
        raise UserError(f"{path}: {split}_data has {len(data)} trials and {split}_labels {len(labels)}; expected equal")
    return zip(data, labels, strict=True)


def check_trial_array(where: str, data: Any, n_columns: int) -> Float[np.ndarray, "T C"]:
    """`data` as float64 (T, n_columns), T at least 10. NaN is a gap; anything else that is not finite is refused."""
    array = np.asarray(data)
    if array.ndim != 2 or array.shape[1] != n_columns or array.dtype.kind not in "fiu":
        raise UserError(f"{where} is {array.dtype} of shape {array.shape}; expected numbers of shape (T, {n_columns})")
    if len(array) < MIN_FRAMES:
        raise UserError(f"{where} has {len(array)} frames; expected at least {MIN_FRAMES}")
    array = array.astype(np.float64)
    infinite = np.argwhere(np.isinf(array))
    if len(infinite):
        frame, column = infinite[0]
        raise UserError(
            f"{where}, frame {frame}, column {column} is {array[frame, column]}; expected finite or NaN (a gap)"
        )
    return array
