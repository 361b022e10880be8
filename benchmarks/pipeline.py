"""How much faster the pipeline is than the reference's way, measured by turns in one process.

Three figures: the full rerun of a trial (`infer` and `control`, with the poses of every drawn link, which the
reference's way does not compute), the control-only rerun, and one streaming frame. Targets: at least 300 times faster,
below 5 ms, at least 200 times faster.

    OMP_NUM_THREADS=1 python benchmarks/pipeline.py --dataset nuisi --action handshake
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
import tyro
from naive import NaiveMild, windows_of_frames

from mild_viz import paths, streaming
from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.data.windows import fill_gaps, human_features
from mild_viz.errors import UserError
from mild_viz.pipeline import NEWEST, control, infer, with_contact_states
from mild_viz.robot.model import load_robot
from mild_viz.rollout import Rollout
from mild_viz.settings import VARIANTS, ControlSettings
from mild_viz.trial import Dataset, Skeleton, Trial


def main(
    dataset: str = "demo",
    action: str = "handshake",
    variant: str = "v3.1",
    frames: int = 430,
    rounds: int = 3,
    checkpoint: Path | None = None,
    robot: str = "pepper",
    contact_states: tuple[int, ...] | None = None,
) -> None:
    """Print what each way takes, and the ratios.

    Args:
        dataset: Recordings, demo or nuisi.
        action: Interaction; the model's contact states for it decide where inverse kinematics runs.
        variant: Variant of MILD.
        frames: Length of the trial; a recorded one is played to and fro until it is that long.
        rounds: Turns; the median over them is printed.
        checkpoint: Model; the shipped one of the dataset by default.
        robot: Name or URDF.
        contact_states: States in which the partners touch; the model's own by default.
    """
    torch.set_num_threads(1)
    model = load_checkpoint(checkpoint or paths.default_checkpoint(dataset))
    interface = model.for_robot()
    body = load_robot(robot, interface.joint_names, interface.end_effector)
    trial = lengthened(longest_trial(load_dataset(dataset), action), frames)
    chosen = None if contact_states is None else frozenset(contact_states)
    settings = with_contact_states(ControlSettings(controller="mild-ik", contact_states=chosen), model, variant, action)
    if not settings.contact_states:
        raise UserError(f"checkpoint {model.name} has no contact states for '{action}'; give --contact-states")
    touching = settings.contact_states

    inference = infer(model, trial, variant)
    rollout = control(inference, model, body, trial, settings)
    stream = streaming.stream_model(model, variant, action, body, settings, rollout.T_world_human, trial.rate)
    windows = windows_of_frames(human_features(trial.human_arm))[: inference.n_windows]
    # The reference has no v4 (histories, several models): that is timed alone.
    naive = None if VARIANTS[variant].own_models else NaiveMild(model, variant, action, body)
    if naive is not None:
        check_same_numbers(naive, windows, rollout)

    def full() -> None:
        control(infer(model, trial, variant), model, body, trial, settings)

    def control_only() -> None:
        control(inference, model, body, trial, settings)

    def naive_frames() -> np.ndarray:
        """Time of each frame [s]; NaN without a reference."""
        if naive is None:
            return np.full(n, np.nan)
        return np.diff([time.perf_counter(), *(time.perf_counter() for _ in naive.frames(windows, target, touching))])

    def stream_frames() -> np.ndarray:
        """Time of each frame that gives a row of the rollout [s]."""
        carry, times = streaming.start(stream), [time.perf_counter()]
        for arm in trial.human_arm:
            carry, _ = streaming.step(stream, carry, arm)
            times.append(time.perf_counter())
        return np.diff(times)[NEWEST : NEWEST + n]

    n, target, contact = inference.n_windows, rollout.target, rollout.contact
    for job in (full, control_only, stream_frames):
        job()  # compile
    naive_times, stream_times, full_times, control_times = [], [], [], []
    for _ in range(rounds):
        naive_times.append(naive_frames())
        full_times.append(duration(full))
        control_times.append(duration(control_only))
        stream_times.append(np.median([stream_frames() for _ in range(5)], axis=0))

    print(f"{trial.name}, {action}, {variant}: {trial.n_frames} frames, {n} windows, {contact.mean():.0%} in contact")
    if naive is None:
        print("no reference to compare with: its way has no such variant (below: nan)")
    print(f"reference's way      {np.median([t.sum() for t in naive_times]) * 1e3:9.1f} ms")
    ratio = np.median([t.sum() / mine for t, mine in zip(naive_times, full_times, strict=True)])
    print(f"full rerun           {np.median(full_times) * 1e3:9.2f} ms, ratio {ratio:.0f} (target >= 300)")
    print(f"control-only rerun   {np.median(control_times) * 1e3:9.2f} ms (target < 5 ms)")
    print("one streaming frame (target: ratio >= 200)")
    for label, rows in (("all", np.full(n, True)), ("in contact, with IK", contact), ("not in contact", ~contact)):
        theirs, ours = (np.array([t[rows].mean() for t in times]) for times in (naive_times, stream_times))
        print(
            f"  {label:20} reference {np.median(theirs) * 1e6:8.0f} us, ours {np.median(ours) * 1e6:6.1f} us, "
            f"ratio {np.median(theirs / ours):.0f}"
        )


def duration(job: Callable[[], None], repeats: int = 20) -> float:
    """Median wall time of one call [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def longest_trial(dataset: Dataset, action: str) -> Trial:
    trials = [trial for trial in dataset.train + dataset.test if trial.action == action]
    if not trials:
        raise UserError(f"dataset {dataset.name} has no '{action}'; valid: {', '.join(dataset.actions)}")
    return max(trials, key=lambda trial: trial.n_frames)


def lengthened(trial: Trial, n_frames: int) -> Trial:
    """The trial played to and fro until it has `n_frames`, its gaps closed (the reference's way knows none)."""
    arm = fill_gaps(trial.human_arm, trial.n_frames)
    first = int(np.argmax(~np.isnan(arm).any((1, 2))))
    order = np.concatenate([np.arange(first, trial.n_frames), np.arange(trial.n_frames - 2, first, -1)])
    rows = np.resize(order, n_frames)

    def taken(value: object) -> object:
        if isinstance(value, Skeleton):
            return Skeleton(value.joint_names, value.bones, value.positions[rows])
        return value[rows] if isinstance(value, np.ndarray) and len(value) == trial.n_frames else value

    changes = {field.name: taken(getattr(trial, field.name)) for field in fields(trial)}
    return replace(trial, **{**changes, "human_arm": arm[rows]})


def check_same_numbers(naive: NaiveMild, windows: np.ndarray, rollout: Rollout) -> None:
    """Both ways must compute the same thing: forward variable, decoded joints, forward kinematics."""
    answers = list(naive.frames(windows[:50], rollout.target[:50], frozenset()))
    inference = rollout.inference
    # Not in logarithms: the reference's way underflows where a state is all but impossible.
    np.testing.assert_allclose(
        [np.exp(a.log_alpha) for a in answers], np.exp(inference.log_alpha_human[:50]), atol=1e-8
    )
    np.testing.assert_allclose([answer.decoded for answer in answers], inference.joints_decoded[:50], atol=1e-8)
    for joints, position in zip(inference.joints_decoded[:5], rollout.end_effector_decoded[:5], strict=True):
        np.testing.assert_allclose(naive.forward_kinematics(joints), position, atol=1e-6)


if __name__ == "__main__":
    tyro.cli(main)
