"""Recordings that can be learnt from: every check before anything is trained, each naming trial and frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mild_viz.data.windows import MIN_FRAMES
from mild_viz.errors import UserError
from mild_viz.pairs import Windows, stack_windows
from mild_viz.training.priors import complete_rows
from mild_viz.trial import Trial

STILL = 1e-9
"""Standard deviation below which nothing has moved [rad or m]."""


def training_windows(trials: Sequence[Trial], joint_names: Sequence[str] | None) -> Windows:
    """Windows to learn from; the partner is the robot with `joint_names`, or the second human if None.

    A lost observation (NaN) of a person is a gap, which is bridged or left out.

    Raises:
        UserError: naming the action that cannot be learnt from, or the partner that never moves.
    """
    data = stack_windows(trials, joint_names)
    usable = complete_rows(data)
    whole = set(usable.trial.tolist())
    for action in dict.fromkeys(data.actions):
        if not any(of == action and trial in whole for trial, of in enumerate(data.actions)):
            raise UserError(f"action '{action}' has no complete window in the training trials; check the recordings")
    if float(usable.partner.std(0).max()) < STILL:
        names = ", ".join(joint_names or ["the second human's arm"])
        raise UserError(
            f"dataset '{trials[0].dataset}': {names} never moved in the {len(trials)} training trials (all values are "
            "constant); expected a partner that moves"
        )
    return data


def check_trial(trial: Trial) -> None:
    """Refuse a trial that is too short, or that holds what is no number, naming it and the frame."""
    if trial.n_frames < MIN_FRAMES:
        raise UserError(
            f"trial {trial.name} has {trial.n_frames} frames, which is less than two windows; expected at least "
            f"{MIN_FRAMES}: leave it out of the recordings"
        )
    for name in ("human_points", "partner_points", "robot_joints"):
        values = getattr(trial, name)
        if values is None:
            continue
        # A robot's log has no lost frames; a tracker's has, as NaN, but nothing that is infinite.
        bad = ~np.isfinite(values) if name == "robot_joints" else np.isinf(values)
        frames = np.flatnonzero(bad.reshape(len(values), -1).any(1))
        if len(frames):
            raise UserError(
                f"trial {trial.name}: {name} is not a number at frame {frames[0]}"
                f"{f' and {len(frames) - 1} more' if len(frames) > 1 else ''}; expected finite values"
            )
