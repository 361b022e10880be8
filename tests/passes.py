"""A pass written by hand, for tests that need certain states, phases and predictions, and no model."""

from __future__ import annotations

import numpy as np

from mild_viz.evaluation.passes import Pass
from mild_viz.settings import WINDOW
from mild_viz.trial import Trial
from tests.models import random_hmm, random_vae

FLOOR = 1e-9


def one_hot(states: list[int] | np.ndarray, n_states: int) -> np.ndarray:
    """log alpha that is certain of the given states."""
    probability = np.where(np.eye(n_states)[np.asarray(states)] > 0, 1.0, FLOOR)
    return np.log(probability / probability.sum(1, keepdims=True))


def make_pass(
    active: list[int],
    joint: list[int] | None = None,
    phase: list[int] | None = None,
    *,
    n_states: int = 4,
    rate: float = 10.0,
    action: str = "handshake",
    predicted: np.ndarray | None = None,
    truth: np.ndarray | None = None,
    human_human: bool = False,
) -> Pass:
    """A pass of len(active) windows; phases are those of the newest observations."""
    rng = np.random.default_rng(0)
    n, frames = len(active), len(active) + 2 * WINDOW - 1
    full_phase = None
    if phase is not None:
        full_phase = np.concatenate([np.zeros(WINDOW - 1, int), phase, np.zeros(WINDOW, int)])
    partner = np.zeros((n, 20)) if truth is None else truth
    return Pass(
        trial=Trial("made", "test", 0, action, rate, np.zeros((frames, 3, 3)), phase=full_phase),
        human_human=human_human,
        hmm=random_hmm(rng, n_states, 4),
        partner_vae=random_vae(rng, partner.shape[1], latent=2),
        log_alpha=one_hot(active, n_states),
        log_alpha_joint=one_hot(active if joint is None else joint, n_states),
        human_mean=np.zeros((n, 2)),
        partner_mean=np.zeros((n, 2)),
        partner_covariance=np.tile(np.eye(2), (n, 1, 1)),
        partner_truth=np.zeros((n, 2)),
        predicted=np.zeros_like(partner) if predicted is None else predicted,
        truth=partner,
        errors=np.where(np.isfinite(partner).all(1), 0.0, np.nan),
    )
