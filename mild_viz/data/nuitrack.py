"""The raw Nuitrack recording of NuiSI's rocket fistbumps: read, cut into trials, normalise.

One line a frame: `index, time_ms, n_joints`, then for each of 25 joints `id, confidence`, its projection
(3 numbers) and its position in the camera's frame (3 numbers, millimetres). A line that ends after its
third field is a frame in which tracking was lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.data.skeletons import (
    NUITRACK_BONES,
    NUITRACK_IDS,
    NUITRACK_JOINTS,
    first_person_frame,
    joint_indices,
    to_frame,
)
from mild_viz.errors import UserError
from mild_viz.trial import Skeleton

N_JOINTS = 25
FIELDS_PER_JOINT = 8
HEADER_FIELDS = 3

ROCKET_RANGES = (
    (110, 310), (340, 550), (570, 750), (770, 920), (940, 1120), (1140, 1300),
    (1310, 1470), (1500, 1640), (1680, 1815), (1840, 2000), (2030, 2240), (2290, 2500),
)  # fmt: skip
"""Frames of each rocket trial, [first, last): the first nine are NuiSI's training trials, the rest its test."""


def read_recording(path: Path) -> Float[np.ndarray, "F 25 3"]:
    """Positions of all 25 joints by frame [m], camera's origin, axes turned to x away, y left, z up.

    NaN where tracking was lost, and for joints that Nuitrack never fills (written as zeros). A position of
    confidence 0 is kept: it is Nuitrack's own estimate, and the published NuiSI trials contain it as it is.
    """
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a Nuitrack recording: it is not plain text") from error
    if not lines:
        raise UserError(f"{path} is empty; expected one line of comma-separated numbers a frame")
    full = HEADER_FIELDS + N_JOINTS * FIELDS_PER_JOINT
    positions = np.full((len(lines), N_JOINTS, 3), np.nan)
    for frame, line in enumerate(lines):
        fields = line.split(",")
        try:
            values = np.array(fields, dtype=float)
        except ValueError as error:
            raise UserError(f"{path}, line {frame + 1}: {error}") from error
        if len(values) not in (HEADER_FIELDS, full):
            raise UserError(f"{path}, line {frame + 1} has {len(values)} fields; valid: {HEADER_FIELDS} or {full}")
        if np.isinf(values).any():
            raise UserError(f"{path}, line {frame + 1} holds an infinite number; expected finite or nan (a gap)")
        if values[0] != frame:
            raise UserError(f"{path}, line {frame + 1} has frame number {fields[0]}; expected {frame}")
        if len(values) == full:
            positions[frame] = values[HEADER_FIELDS:].reshape(N_JOINTS, FIELDS_PER_JOINT)[:, 5:]
    positions[(positions == 0.0).all(axis=2)] = np.nan
    return np.stack([positions[..., 2], -positions[..., 0], positions[..., 1]], axis=-1) / 1000.0


def upper_body(positions: Float[np.ndarray, "T 25 3"]) -> Skeleton:
    """The upper body of one trial in the person's own frame, which the first tracked frame sets.

    Origin at the collar, axes from the torso. Raises a `UserError` if no frame was tracked.
    """
    body = positions[:, NUITRACK_IDS]
    reference = joint_indices(NUITRACK_JOINTS, ("left_shoulder", "right_shoulder", "waist", "right_collar"))
    T_world_person = first_person_frame(body, reference)
    return Skeleton(NUITRACK_JOINTS, NUITRACK_BONES, to_frame(T_world_person, body))


def read_trials(path: Path, ranges: tuple[tuple[int, int], ...] = ROCKET_RANGES) -> list[Skeleton]:
    """The upper body in each of the frame ranges [first, last) of a raw recording."""
    recording = read_recording(path)
    needed = max(last for _, last in ranges)
    if len(recording) < needed:
        raise UserError(f"{path} has {len(recording)} frames; the listed trials need {needed}: is it truncated?")
    bodies = []
    for first, last in ranges:
        try:
            bodies.append(upper_body(recording[first:last]))
        except UserError as error:
            raise UserError(f"{path}, frames {first} to {last}: {error}") from error
    return bodies
