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


def file_checksum(*paths: Path) -> str:
    """SHA-256 of the contents of the files, one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


def paired(path: Path, arrays: dict[str, np.ndarray], split: str) -> Iterator[tuple[Any, Any]]:
    """The trials and labels of one split of a `traj_data.npz`, side by side."""
    data, labels = arrays[f"{split}_data"], arrays[f"{split}_labels"]
    if len(data) != len(labels) or len(data) == 0:
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
