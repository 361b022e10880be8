"""From recorded positions to the windows that the model reads: gaps, velocities, sliding windows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.settings import WINDOW

MAX_GAP_SECONDS = 0.5
"""How long a lost observation is bridged by repeating the last one [s]."""

MIN_FRAMES = 2 * WINDOW
"""The shortest trial that holds one human window and the robot window after it."""


def max_gap(rate: float) -> int:
    """Longest gap, in frames at `rate` [Hz], that `fill_gaps` bridges: half a second."""
    return round(MAX_GAP_SECONDS * rate)


def fill_gaps(positions: Float[np.ndarray, "T ..."], max_gap: int) -> Float[np.ndarray, "T ..."]:
    """Repeat the last complete frame over gaps, for up to `max_gap` frames; later frames of the gap become NaN.

    A frame is missing if any of its numbers is NaN, and is then replaced whole: an arm of which only the
    wrist is known is not an arm. Causal on purpose (no interpolation towards the next observation), so that
    a stream can do the same. Frames before the first complete one stay NaN.
    """
    n_frames = len(positions)
    missing = np.isnan(positions.reshape(n_frames, -1)).any(axis=1)
    frames = np.arange(n_frames)
    last = np.maximum.accumulate(np.where(missing, -1, frames))
    filled = positions[last]
    filled[(last < 0) | (frames - last > max_gap)] = np.nan
    return filled


def human_features(points: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "T F"]:
    """Per frame: the positions of a person's P points (an arm: shoulder, elbow, wrist) [m], then their velocities.

    A velocity is the difference to the previous frame (metres a frame, not a second; 0 in the first frame),
    as the authors take it. It is NaN beside a missing frame.
    """
    positions = points.reshape(len(points), -1)
    velocities = np.diff(positions, axis=0, prepend=positions[:1])
    velocities[:1] = 0.0
    return np.concatenate([positions, velocities], axis=1)


def windows(features: Float[np.ndarray, "T F"]) -> Float[np.ndarray, "N FW"]:
    """Every run of 5 successive frames, flattened frame by frame: row n is frames n to n + 4, N = T - 4.

    A row with a missing frame is NaN throughout. Fewer than 5 frames raise a `UserError`.
    """
    n_frames, n_features = features.shape
    if n_frames < WINDOW:
        raise UserError(f"a recording of {n_frames} frames has no window; expected at least {WINDOW} frames")
    view = np.lib.stride_tricks.sliding_window_view(features, WINDOW, axis=0)
    rows = view.transpose(0, 2, 1).reshape(n_frames - WINDOW + 1, WINDOW * n_features).copy()
    rows[np.isnan(rows).any(axis=1)] = np.nan
    return rows


def human_windows(points: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "N FW"]:
    """Windows of `human_features`, N = T - 4; 90 columns for an arm."""
    return windows(human_features(points))


def pair_windows(
    human: Float[np.ndarray, "T P 3"], robot: Float[np.ndarray, "T J"]
) -> tuple[Float[np.ndarray, "N FW"], Float[np.ndarray, "N JW"]]:
    """The pairs that a model is trained and measured on: N = T - 9.

    Row n of the first holds human frames n to n + 4, row n of the second the robot frames n + 5 to n + 9
    that follow (joints, or any other per-frame numbers of the partner). Rows with a missing frame are NaN.
    """
    n_frames = len(human)
    if n_frames < MIN_FRAMES:
        raise UserError(f"a trial of {n_frames} frames has no pair of windows; expected at least {MIN_FRAMES}")
    return human_windows(human)[:-WINDOW], windows(robot)[WINDOW:]
