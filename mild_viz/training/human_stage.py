"""Algorithm 1: one VAE for both humans, and one HMM per interaction as its prior. All seeds train together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mild_viz.latent.hmm import HMM, unobserved_forward
from mild_viz.latent.state_models import fit_from_equal_segments
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows
from mild_viz.training.networks import BatchedVAE, gaussian_kl, standard_kl
from mild_viz.training.options import TrainingOptions
from mild_viz.training.state import RunState, Trainer

Progress = Callable[[str, int, int, dict[str, float]], None]
"""Called as progress(stage, epoch, n_epochs, values) after every epoch."""


@dataclass(frozen=True, eq=False)
class HumanModel:
    """What one seed of the human stage leaves: frozen from here on."""

    vae: VAE
    hmms: dict[str, HMM]


def joint_latents(human: VAE, partner: VAE, data: Windows) -> list[np.ndarray]:
    """Per trial, the posterior means of both agents side by side: (T, 2 D)."""
    both = np.concatenate([human.encode(data.human)[0], partner.encode(data.partner)[0]], axis=1)
    return [both[data.rows(trial)] for trial in range(len(data.actions))]


def fit_hmms(
    latents: Sequence[np.ndarray], actions: Sequence[str], options: TrainingOptions, n_iterations: int
) -> dict[str, HMM]:
    """One model of the chosen kind per action on the joint latents of its trials, from the equal split in time."""
    hmms = {}
    for action in dict.fromkeys(actions):
        sequences = [sequence for sequence, of in zip(latents, actions, strict=True) if of == action]
        hmms[action] = fit_from_equal_segments(
            options.state_model, sequences, options.n_states, options.covariance_floor, n_iterations
        )
    return hmms


def prior_states(hmms: dict[str, HMM], data: Windows) -> np.ndarray:
    """Per row, the state that is most likely by the unobserved forward variable (i* of Eq. vaeHMM-prior)."""
    n_steps = int(data.step.max()) + 1
    best = {action: unobserved_forward(hmm, n_steps).argmax(1) for action, hmm in hmms.items()}
    states = np.empty(len(data.trial), dtype=np.int64)
    for trial, action in enumerate(data.actions):
        rows = data.rows(trial)
        states[rows] = best[action][data.step[rows]]
    return states


class StatePriors:
    """Marginal Gaussians of every state for one agent, of several models at once, as torch tensors."""

    def __init__(self, models: Sequence[dict[str, HMM]], data: Windows, agent: slice) -> None:
        order = list(dict.fromkeys(data.actions))
        action_of_row = np.array([order.index(action) for action in data.actions])[data.trial]
        n_states = models[0][order[0]].n_states
        means, covariances = [], []
        for hmms in models:
            means.append(np.concatenate([hmms[action].emission_means[:, agent] for action in order]))
            covariances.append(np.concatenate([hmms[action].emission_covariances[:, agent, agent] for action in order]))
        covariance = np.stack(covariances)  # M, actions * states, D, D
        self._mean = torch.tensor(np.stack(means), dtype=torch.float32)
        self._precision = torch.tensor(np.linalg.inv(covariance), dtype=torch.float32)
        self._log_det = torch.tensor(np.linalg.slogdet(covariance)[1], dtype=torch.float32)
        component = [action_of_row * n_states + prior_states(hmms, data) for hmms in models]
        self._component = torch.tensor(np.stack(component))
        self._model = torch.arange(len(models))[:, None]

    def kl(self, mean: Tensor, log_std: Tensor, rows: Tensor) -> Tensor:
        """KL_t (M, B) of posteriors (M, B, D) at the given rows (B,)."""
        which = (self._model, self._component[:, rows])
        return gaussian_kl(mean, log_std, self._mean[which], self._precision[which], self._log_det[which])


def batches(n_rows: int, size: int, rng: torch.Generator) -> Sequence[Tensor]:
    """Row indices of one epoch in random order, in batches of equal size."""
    n_batches = max(1, n_rows // size)
    return torch.randperm(n_rows, generator=rng)[: n_batches * size].chunk(n_batches)


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


def train_human_stage(
    data: Windows, options: TrainingOptions, progress: Progress, state: RunState | None = None
) -> list[HumanModel]:
    """Algorithm 1 for `options.seeds` seeds together: alternate VAE epochs and EM.

    `data` pairs human windows with windows of the second human. Returns one frozen model a seed.
    """
    rng = torch.Generator().manual_seed(options.seed)
    usable = complete_rows(data)
    offset, scale = standardisation(np.concatenate([usable.human, usable.partner]))
    net = BatchedVAE(options.seeds, offset, scale, options.hidden, options.latent_size, rng)
    x_human = net.standardise(torch.tensor(usable.human, dtype=torch.float32))
    x_partner = net.standardise(torch.tensor(usable.partner, dtype=torch.float32))
    n_batches = len(batches(len(usable.trial), options.batch_size, rng))
    n_epochs = options.human_epochs
    trainer = Trainer(net, options, n_epochs * n_batches, options.gradient_clip * options.seeds, rng)

    def fit_models(n_iterations: int) -> tuple[list[HumanModel], list[tuple[Tensor, StatePriors | None]]]:
        models = []
        for seed in range(options.seeds):
            vae = net.export(seed)
            latents = joint_latents(vae, vae, data)
            hmms = fit_hmms(latents, data.actions, options, n_iterations)
            models.append(HumanModel(vae, hmms))
        size, tables = options.latent_size, [model.hmms for model in models]
        return models, [
            (x_human, StatePriors(tables, usable, slice(0, size))),
            (x_partner, StatePriors(tables, usable, slice(size, 2 * size))),
        ]

    # Before the first EM there is no model: the prior is N(0, I), as Algorithm 1 starts.
    agents: list[tuple[Tensor, StatePriors | None]] = [(x_human, None), (x_partner, None)]
    first = 0
    if state is not None and (saved := state.load("human")) is not None:
        first = trainer.restore(saved)
        if 0 < first < n_epochs:
            _, agents = fit_models(options.em_iterations)
    for epoch in range(first, n_epochs):
        totals = {"reconstruction": 0.0, "kl": 0.0}
        for rows in batches(len(usable.trial), options.batch_size, rng):
            loss = torch.zeros(())
            for x, prior in agents:
                target = x[rows].expand(options.seeds, -1, -1)
                mean, log_std = net.encode(target)
                sample = mean + torch.exp(log_std) * torch.randn(mean.shape, generator=rng)
                error = ((net.decode(sample) - target) ** 2).sum(-1).mean(1)
                kl = (prior.kl(mean, log_std, rows) if prior else standard_kl(mean, log_std)).mean(1)
                loss = loss + (error + options.beta * kl).sum()
                totals["reconstruction"] += float(error.mean().detach()) / (2 * n_batches)
                totals["kl"] += float(kl.mean().detach()) / (2 * n_batches)
            trainer.descend(loss)
        if epoch + 1 < n_epochs and (epoch < 10 or epoch % options.em_every == 0):
            _, agents = fit_models(options.em_iterations)
            if state is not None:
                state.save("human", trainer.state(epoch + 1))
        progress("human", epoch + 1, n_epochs, totals)
    if state is not None:
        state.save("human", trainer.state(n_epochs))
    return fit_models(options.final_em_iterations)[0]
