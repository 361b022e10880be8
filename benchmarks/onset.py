"""Start and end of the interaction on every trial at hand, and what the model loses by the time it is given before.

Every trial is fed to the phase tracker frame by frame. Recordings that begin with the reach (NuiSI) get a second of the
first frame before it, with a tracking error of 2 mm, since a person who is met stands there before.

OMP_NUM_THREADS=1 python benchmarks/onset.py
"""

from __future__ import annotations

import numpy as np
import tyro

from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.data.demo import joint_noise
from mild_viz.data.demo_body import DEMO_JOINTS
from mild_viz.data.load import data_root, load_dataset, missing_files
from mild_viz.data.skeletons import ARM_JOINTS
from mild_viz.data.windows import fill_gaps, human_windows, max_gap, windows
from mild_viz.live.config import RESTS, LiveConfig
from mild_viz.live.onset import INTERACTING, RETURNING, PhaseTracker
from mild_viz.pairs import robot_truth
from mild_viz.paths import default_checkpoint
from mild_viz.prediction import predict
from mild_viz.settings import WINDOW
from mild_viz.trial import Trial

LEADS = (5, 10, 15, 20, 29, 45)
"""Frames: 0.17 to 1.5 s at 30 Hz."""

HAND = ARM_JOINTS.index("right_wrist")


def with_rest(trial: Trial, seconds: float) -> tuple[np.ndarray, int]:
    """The arm (T, 3, 3) after so much rest, and the number of frames that were put before it."""
    rng = np.random.default_rng(trial.index)
    n_frames = round(seconds * trial.rate)
    first = trial.human_arm[np.isfinite(trial.human_arm).all((1, 2)).argmax()]
    return np.concatenate([first + 0.002 * rng.standard_normal((n_frames, 3, 3)), trial.human_arm]), n_frames


def phases(arm: np.ndarray, rate: float, config: LiveConfig) -> tuple[int | None, int | None, str]:
    """The frames at which the first interaction begins and ends, and why it ends."""
    tracker = PhaseTracker(config)
    start = None
    for frame, hand in enumerate(arm[:, HAND]):
        phase = tracker.update(frame / rate, hand)
        if phase == INTERACTING and start is None:
            start = frame
        if phase == RETURNING:
            return start, frame, tracker.reason
    return start, None, ""


def leaves(trial: Trial) -> int:
    """The frame in which the hand begins to move: the true one where it is known, else the last within 1 cm of where
    it was at first, before it is 10 cm away."""
    if trial.phase is not None:
        return int(np.argmax(trial.phase > 0))
    hand = trial.human_arm[:, HAND]
    away = np.linalg.norm(hand - np.nanmedian(hand[:3], axis=0), axis=1)
    near = np.flatnonzero(away[: int(np.argmax(away > 0.1))] < 0.01)
    return int(near[-1]) + 1 if len(near) else 0


def report_starts(dataset: str, rest: float, config: LiveConfig) -> None:
    """Delay of the start against the hand's own, false starts, and ends."""
    recordings = load_dataset(dataset)
    delays, ends, cut = [], [], 0
    false = missed = 0
    for trial in recordings.train + recordings.test:
        arm, before = with_rest(trial, rest)
        start, end, _ = phases(arm, trial.rate, config)
        if start is None:
            missed += 1
            continue
        false += start - before < leaves(trial)
        delays.append((start - before - leaves(trial)) / trial.rate)
        if end is None:
            cut += 1
        elif trial.phase is not None:
            ends.append((end - (len(trial.phase) - np.argmax(trial.phase[::-1] > 0))) / trial.rate)
    print(
        f"{dataset}: {len(delays)} trials; start after the hand's own: median {np.median(delays):.2f} s, "
        f"90 % within {np.quantile(delays, 0.9):.2f} s, longest {max(delays):.2f} s; {false} false, {missed} missed"
    )
    if ends:
        print(f"  end after the hand's return: median {np.median(ends):.2f} s, {min(ends):.2f} to {max(ends):.2f} s")
    print(f"  {cut} recordings end before the interaction does")


def report_rests(config: LiveConfig) -> None:
    """How long recordings go on before a start is seen, the first frame held for a second before them."""
    for dataset, used in RESTS.items():
        if missing_files(dataset, data_root()):
            print(f"{dataset} is not here; RESTS says {used:g} s")
            continue
        seconds = []
        for trial in load_dataset(dataset).train:
            arm, before = with_rest(trial, 1.0)
            start, _, _ = phases(arm, trial.rate, config)
            if start is not None:
                seconds.append((start - before) / trial.rate)
        print(
            f"{dataset}: {len(seconds)} training trials go on for {np.median(seconds):.2f} s, in the median, before a "
            f"start is seen; RESTS says {used:g} s"
        )


def report_rest(minutes: float, config: LiveConfig) -> None:
    """False starts while a hand rests, with the demo set's tracking error."""
    rng = np.random.default_rng(0)
    starts = 0
    for _ in range(round(minutes)):
        tracker = PhaseTracker(config)
        for frame, body in enumerate(joint_noise(rng, 1800)[:, 0]):
            if tracker.update(frame / 30.0, body[DEMO_JOINTS.index("right_wrist")]) == INTERACTING:
                starts += 1
                break
    print(f"resting hand with tracking error: {starts} false starts in {minutes:g} minutes")


def errors(checkpoint: Checkpoint, variant: str, trial: Trial, rest: float, config: LiveConfig) -> np.ndarray | None:
    """Mean squared error [rad^2] from the start on, for each of `LEADS` and for the whole recording."""
    arm, before = with_rest(trial, rest)
    start, end, _ = phases(arm, trial.rate, config)
    if start is None:
        return None
    filled = fill_gaps(arm, max_gap(trial.rate))
    truth = windows(robot_truth(trial, checkpoint.for_robot().joint_names))[WINDOW:]
    last = len(trial.human_arm) - 2 * WINDOW + 1 + before
    first = max(start - WINDOW + 1, before)
    found = []
    for begin in [max(start - lead + 1, 0) for lead in LEADS] + [before]:
        said = predict(checkpoint, variant, trial.action, human_windows(filled[begin:])[: last - begin])
        error = ((said.decoded[first - begin :] - truth[first - before :]) ** 2).mean(1)
        found.append(np.nanmean(error[: None if end is None else end - start]))
    return np.array(found)


def main(minutes: float = 30.0) -> None:
    """Print delays and false starts, then the error for every lead.

    Args:
        minutes: How much rest to look at for false starts.
    """
    config = LiveConfig()
    for dataset, rest in (("demo", 0.0), ("nuisi", 1.0)):
        report_starts(dataset, rest, config)
    report_rest(minutes, config)
    report_rests(config)
    print(
        f"\nmean squared error [rad^2] from the start to the end; the model begins so many frames before: {LEADS}, all"
    )
    for dataset, rest in (("demo", 0.0), ("nuisi", 1.0)):
        checkpoint = load_checkpoint(default_checkpoint(dataset))
        for variant in ("v3.1", "v3.2", "v4"):
            trials = load_dataset(dataset).test
            found = [errors(checkpoint, variant, trial, rest, config) for trial in trials]
            mean = np.mean([each for each in found if each is not None], axis=0)
            print(f"{dataset} {variant}: " + "  ".join(f"{value:.4f}" for value in mean))


if __name__ == "__main__":
    tyro.cli(main)
