"""What the stages share: latents of whole trials, HMMs on them, the states as priors, rows and batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from mild_viz.latent.hmm import HMM, unobserved_forward
from mild_viz.latent.state_models import fit_from_equal_segments
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows
from mild_viz.training.networks import gaussian_kl
from mild_viz.training.options import TrainingOptions


def joint_latents(human: VAE, partner: VAE, data: Windows) -> list[np.ndarray]:
    """Per trial, the posterior means of both agents side by side: (T, 2 D)."""
    both = np.concatenate([human.encode(data.human)[0], partner.encode(data.partner)[0]], axis=1)
    return [both[data.rows(trial)] for trial in range(len(data.actions))]


def fit_hmms(
    latents: Sequence[np.ndarray], actions: Sequence[str], options: TrainingOptions, floor: float, n_iterations: int
) -> dict[str, HMM]:
    """One model of the chosen kind per action on the joint latents of its trials, from the equal split in time."""
    hmms = {}
    for action in dict.fromkeys(actions):
        sequences = [sequence for sequence, of in zip(latents, actions, strict=True) if of == action]
        hmms[action] = fit_from_equal_segments(options.state_model, sequences, options.n_states, floor, n_iterations)
    return hmms


def prior_states(hmms: Mapping[str, HMM], data: Windows) -> np.ndarray:
    """Per row, the state that is most likely by the unobserved forward variable (i* of Eq. vaeHMM-prior)."""
    n_steps = int(data.step.max()) + 1
    best = {action: unobserved_forward(hmm, n_steps).argmax(1) for action, hmm in hmms.items()}
    states = np.empty(len(data.trial), dtype=np.int64)
    for trial, action in enumerate(data.actions):
        rows = data.rows(trial)
        states[rows] = best[action][data.step[rows]]
    return states


def action_numbers(data: Windows) -> tuple[list[str], np.ndarray]:
    """The actions in the order of their first trial, and every row's place in that list."""
    order = list(dict.fromkeys(data.actions))
    return order, np.array([order.index(action) for action in data.actions])[data.trial]


class StatePriors:
    """Marginal Gaussians of every state for one agent, of several models at once, as torch tensors."""

    def __init__(
        self,
        models: Sequence[Mapping[str, HMM]],
        data: Windows,
        agent: slice,
        states: Sequence[np.ndarray] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """`states` says per model which state is every row's prior; default: by the unobserved forward variable."""
        order, action_of_row = action_numbers(data)
        n_states = models[0][order[0]].n_states
        means, covariances = [], []
        for hmms in models:
            means.append(np.concatenate([hmms[action].emission_means[:, agent] for action in order]))
            covariances.append(np.concatenate([hmms[action].emission_covariances[:, agent, agent] for action in order]))
        covariance = np.stack(covariances)  # M, actions * states, D, D
        if states is None:
            states = [prior_states(hmms, data) for hmms in models]
        component = np.stack([action_of_row * n_states + rows for rows in states])
        single = {"dtype": torch.float32, "device": device}
        self._mean = torch.tensor(np.stack(means), **single)
        self._precision = torch.tensor(np.linalg.inv(covariance), **single)
        self._log_det = torch.tensor(np.linalg.slogdet(covariance)[1], **single)
        self._component = torch.tensor(component, device=device)
        self._model = torch.arange(len(models), device=device)[:, None]

    def kl(self, mean: Tensor, log_std: Tensor, rows: Tensor) -> Tensor:
        """KL_t (M, B) of posteriors (M, B, D) at the given rows (B,)."""
        which = (self._model, self._component[:, rows])
        return gaussian_kl(mean, log_std, self._mean[which], self._precision[which], self._log_det[which])


def batches(n_rows: int, size: int, rng: torch.Generator, device: str = "cpu") -> Sequence[Tensor]:
    """Row indices of one epoch in random order (the CPU's, on any device), in batches of equal size."""
    n_batches = max(1, n_rows // size)
    return torch.randperm(n_rows, generator=rng)[: n_batches * size].to(device).chunk(n_batches)


def standardisation(x: np.ndarray) -> tuple[Tensor, Tensor]:
    """Mean of every column, and one scale for all: their root mean square deviation.

    One scale keeps the proportions, so that the loss is the error that is reported. A scale a column would
    spend half of the latent on velocities, which are mostly noise (v3 on NuiSI: .048-.056 against .041-.045).
    """
    scale = max(float(np.sqrt(x.var(0).mean())), 1e-6)
    return torch.tensor(x.mean(0), dtype=torch.float32), torch.full((x.shape[1],), scale)


def complete_rows(data: Windows) -> Windows:
    """The rows without a gap: those that a loss can be taken on."""
    keep = data.complete
    return Windows(data.human[keep], data.partner[keep], data.trial[keep], data.step[keep], data.actions)
