"""How much faster an iteration of EM is than hmmlearn's, on the latents of NuiSI, by turns in one process.

Both start from the same equal split in time of the same sequences: the joint human and partner latents of the model's
training trials, of each action and of all of them in one model. hmmlearn runs its scaled recursions
(`GaussianHMM(covariance_type="full", implementation="scaling")`) without priors and floors, and so do we; both run the
same number of iterations, and their log-likelihoods must agree to 1e-3 before every one of them. Target: at least 5
times faster an iteration.

    OMP_NUM_THREADS=1 python benchmarks/em.py
"""

from __future__ import annotations

import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import tyro
from hmmlearn.hmm import GaussianHMM

from mild_viz import paths
from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.latent.em import equal_segments, fit
from mild_viz.latent.hmm import HMM
from mild_viz.pairs import stack_windows
from mild_viz.training.human_stage import joint_latents

N_STATES = 6
START_FLOOR = 1e-3
"""Added to the covariances of the common start [latent units squared]; the iterations themselves have no floor."""


def main(dataset: str = "nuisi", checkpoint: Path | None = None, iterations: int = 10, rounds: int = 15) -> None:
    """Print the time of an iteration either way, and the ratio.

    Args:
        dataset: Recordings of two people; the training trials are used.
        checkpoint: Model that gives the latents; the shipped one of the dataset by default.
        iterations: Iterations of EM in one run.
        rounds: Turns; the minimum over them and the median of their ratios are printed.
    """
    model = load_checkpoint(checkpoint or paths.default_checkpoint(dataset))
    data = stack_windows(load_dataset(dataset).train, None)
    latents = [rows[np.isfinite(rows).all(1)] for rows in joint_latents(model.human_vae, model.human_vae, data)]
    print(
        f"{dataset}, latents of {model.name}: {iterations} iterations from the same start, {N_STATES} states, "
        f"{latents[0].shape[1]} dimensions; minimum of {rounds} turns; "
        "target: ratio at least 5"
    )
    columns = ("sequences of", "number", "steps", "hmmlearn", "ours", "ratio", "median", "log-likelihoods apart")
    print("{:12} {:>6} {:>6} {:>11} {:>11} {:>6} {:>7}  {}".format(*columns))
    for action in ("all", *model.actions):
        sequences = [z for z, of in zip(latents, data.actions, strict=True) if action in ("all", of)]
        compare(action, sequences, iterations, rounds)


def compare(label: str, sequences: list[np.ndarray], iterations: int, rounds: int) -> None:
    """Measure both ways by turns, check that they compute the same thing, and print a row."""
    start = equal_segments(sequences, N_STATES, START_FLOOR)
    stacked, lengths = np.concatenate(sequences), [len(sequence) for sequence in sequences]
    fit(start, sequences, 0.0, 1)  # compile
    theirs_seconds, ours_seconds = np.empty(rounds), np.empty(rounds)
    for n in range(rounds):
        theirs = hmmlearn_model(start, iterations)
        begin = time.perf_counter()
        theirs.fit(stacked, lengths)
        theirs_seconds[n] = (time.perf_counter() - begin) / iterations
        begin = time.perf_counter()
        _, history = fit(start, sequences, 0.0, iterations, tolerance=-1.0, transition_floor=0.0)
        ours_seconds[n] = (time.perf_counter() - begin) / iterations
    apart = np.abs(np.array(theirs.monitor_.history) - history).max()
    assert apart < 1e-3, f"{label}: the log-likelihoods differ by {apart}"
    fastest = [seconds.min() * 1e3 for seconds in (theirs_seconds, ours_seconds)]
    print(
        f"{label:12} {len(sequences):6d} {len(stacked):6d} {fastest[0]:8.2f} ms {fastest[1]:8.2f} ms "
        f"{fastest[0] / fastest[1]:6.1f} {np.median(theirs_seconds / ours_seconds):7.1f}  {apart:.1e}",
        flush=True,
    )


def hmmlearn_model(start: HMM, iterations: int) -> GaussianHMM:
    """hmmlearn's model at the same start, that stops at nothing and adds nothing to the covariances."""
    model = GaussianHMM(
        start.n_states, covariance_type="full", implementation="scaling", init_params="", n_iter=iterations,
        tol=-np.inf, min_covar=0.0, covars_prior=0.0, covars_weight=0,
    )  # fmt: skip
    model.startprob_, model.transmat_ = start.initial_probs.copy(), start.transition_matrix.copy()
    model.means_, model.covars_ = start.emission_means.copy(), start.emission_covariances.copy()
    return model


if __name__ == "__main__":
    tyro.cli(main)
