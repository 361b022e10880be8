"""`v4`: human VAE, HMM and robot VAE trained together, on what the model decodes when it runs.

Per epoch: descend on reconstruction of both agents, KL to the states' Gaussians, and the error of what is decoded from
the conditional given the filtered forward variable and a short history; then fit HMMs and regressions anew to the
latents. The gains are constants of an epoch, and the latents that they act on are not: the gradient of the prediction
reaches the human's encoder.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mild_viz.checkpoint import Checkpoint
from mild_viz.latent.context import ContextLayout, fit_regression
from mild_viz.latent.hmm import forward_filter, log_emission
from mild_viz.latent.interaction import InteractionModel
from mild_viz.pairs import Windows
from mild_viz.training.human_stage import Agents, make_agents
from mild_viz.training.networks import sampled, squared_error, standard_kl
from mild_viz.training.options import TrainingOptions
from mild_viz.training.priors import StatePriors, action_numbers, batches, complete_rows, fit_hmms, joint_latents
from mild_viz.training.progress import HeldOut, Progress
from mild_viz.training.state import RunState, Trainer


class Conditioning:
    """Contexts, forward variables and regressions of all models, at the rows that a loss can be taken on (U of them).

    The forward variables and the regressions are constants of an epoch.
    """

    def __init__(self, data: Windows, layout: ContextLayout, rate: float, device: str) -> None:
        self.layout, self.rows, self._device = layout, np.flatnonzero(data.complete), device
        self.past = [_rows_before(data, self.rows, lag) for lag in layout.lags]
        """Per lag, where among the U rows the one of so many steps before stands."""
        self.clock = layout.times(data.step[self.rows].astype(float), rate)
        self.actions, numbers = action_numbers(data)
        self.action = numbers[self.rows]
        self._past = [torch.tensor(rows, device=device) for rows in self.past]
        self._clock, self._action = self._tensor(self.clock), torch.tensor(self.action, device=device)

    def _tensor(self, x: np.ndarray) -> Tensor:
        return torch.tensor(x, dtype=torch.float32, device=self._device)

    def update(self, alphas: np.ndarray, models: Sequence[InteractionModel]) -> None:
        """Take new forward variables (M, U, S) and the models' regressions."""
        tables = [[model.regressions[action] for action in self.actions] for model in models]
        self._alpha = self._tensor(alphas)
        self._gain = self._tensor(np.stack([[each.gain for each in table] for table in tables]))
        self._offset = self._tensor(np.stack([[each.offset for each in table] for table in tables]))

    def latent(self, net: Agents, newest: Tensor, x: Tensor, rows: Tensor) -> Tensor:
        """Conditional mean (M, B, D) at some of the U rows, from their newest human latent (M, B, D).

        `x` (U, X) are the human's windows.
        """
        n_models = len(self._alpha)
        past = [net.human.encode(x[which[rows]].expand(n_models, -1, -1))[0] for which in self._past]
        context = torch.cat([newest, *past, self._clock[rows].expand(n_models, -1, -1)], dim=-1)
        gain, offset = self._gain[:, self._action[rows]], self._offset[:, self._action[rows]]  # M B S D C
        means = torch.einsum("mbsdc,mbc->mbsd", gain, context) + offset
        return (self._alpha[:, rows][..., None] * means).sum(2)


def _rows_before(data: Windows, rows: np.ndarray, lag: int) -> np.ndarray:
    """For each of the complete rows, which of them shows the human `lag` steps earlier, as the running model has it.

    Over a gap that is the last one seen before it; at the beginning of a trial its first row; where that is lost, too,
    the row itself.
    """
    place = np.full(len(data.trial), -1)
    place[rows] = np.arange(len(rows))
    last = np.maximum.accumulate(place)
    first = np.searchsorted(data.trial, data.trial)
    found = last[np.maximum(np.arange(len(place)) - lag, first)][rows]
    own = np.arange(len(rows))
    of_trial = (found >= 0) & (data.trial[rows[np.maximum(found, 0)]] == data.trial[rows])
    return np.where(of_trial, found, own)


def fit_models(
    net: Agents, data: Windows, conditioning: Conditioning, options: TrainingOptions, n_iterations: int
) -> tuple[list[InteractionModel], np.ndarray]:
    """HMMs and regressions on the latents as they are now. Returns the models and their filtered alpha (M, U, S)."""
    rows, size = conditioning.rows, options.latent_size
    models, alphas = [], []
    for m in range(options.seeds * options.members):
        human_vae, robot_vae = net.human.export(m), net.partner.export(m)
        latents = joint_latents(human_vae, robot_vae, data)
        hmms = fit_hmms(latents, data.actions, options, options.joint_floor, n_iterations)
        filtered = []
        for both, action in zip(latents, data.actions, strict=True):
            human_hmm = hmms[action].marginal(slice(0, size))
            filtered.append(forward_filter(human_hmm, log_emission(human_hmm, both[:, :size]))[0])
        alpha = np.exp(np.concatenate(filtered)[rows])
        stacked = np.concatenate(latents)[rows]
        human, robot = stacked[:, :size], stacked[:, size:]
        contexts = np.concatenate([human, *(human[before] for before in conditioning.past), conditioning.clock], axis=1)
        regressions = {}
        for number, action in enumerate(conditioning.actions):
            of = conditioning.action == number
            regressions[action] = fit_regression(contexts[of], robot[of], alpha[of], options.context_noise)
        models.append(InteractionModel(human_vae, hmms, robot_vae, conditioning.layout, regressions))
        alphas.append(alpha)
    return models, np.stack(alphas)


def train_joint_stage(
    data: Windows,
    rate: float,
    options: TrainingOptions,
    progress: Progress,
    state: RunState | None = None,
    init: Checkpoint | None = None,
    held: HeldOut | None = None,
) -> list[list[InteractionModel]]:
    """All models of v4 at once: `options.members` for every one of `options.seeds` seeds, whose average is v4."""
    rng = torch.Generator().manual_seed(options.seed + 2)
    usable = complete_rows(data)
    n_models, size, device = options.seeds * options.members, options.latent_size, options.device
    start = () if init is None else init.members(init.variants[-1])  # its v4, where it has one
    net = make_agents(usable, False, n_models, options, rng, start)
    x_human = net.human.standardise(torch.tensor(usable.human, dtype=torch.float32, device=device))
    x_partner = net.partner.standardise(torch.tensor(usable.partner, dtype=torch.float32, device=device))
    conditioning = Conditioning(data, ContextLayout(options.lags, options.clock), rate, device)
    n_batches = len(batches(len(usable.trial), options.batch_size, rng))
    n_epochs = options.joint_epochs
    trainer = Trainer(net, options, n_epochs * n_batches, options.gradient_clip * n_models, rng)

    def refit(n_iterations: int) -> tuple[list[InteractionModel], list[StatePriors]]:
        models, alphas = fit_models(net, data, conditioning, options, n_iterations)
        conditioning.update(alphas, models)
        tables, active = [model.hmms for model in models], list(alphas.argmax(2))
        sides = (slice(0, size), slice(size, 2 * size))
        return models, [StatePriors(tables, usable, side, active, device) for side in sides]

    priors: list[StatePriors] = []
    first = 0
    if state is not None and (saved := state.load("joint")) is not None:
        first = trainer.restore(saved)
        if 0 < first < n_epochs:
            _, priors = refit(options.em_iterations)
    for epoch in range(first, n_epochs):
        totals = {"reconstruction": 0.0, "kl": 0.0, "conditional": 0.0}
        for rows in batches(len(usable.trial), options.batch_size, rng, device):
            human, partner = (x[rows].expand(n_models, -1, -1) for x in (x_human, x_partner))
            (mean_h, log_std_h), (mean_r, log_std_r) = net.human.encode(human), net.partner.encode(partner)
            newest = sampled(mean_h, log_std_h, rng)
            error = squared_error(net.human.decode(newest), human)
            error = error + squared_error(net.partner.decode(sampled(mean_r, log_std_r, rng)), partner)
            if priors:
                kl = (priors[0].kl(mean_h, log_std_h, rows) + priors[1].kl(mean_r, log_std_r, rows)).mean(1)
                said = net.partner.decode(conditioning.latent(net, newest, x_human, rows))
                reached = squared_error(said, partner)
            else:  # before the first EM there is no model: the prior is N(0, I), as Algorithm 1 starts
                kl = (standard_kl(mean_h, log_std_h) + standard_kl(mean_r, log_std_r)).mean(1)
                reached = torch.zeros(n_models, device=device)
            trainer.descend((error + options.beta * kl + reached).sum())
            totals["reconstruction"] += float(error.mean().detach()) / n_batches
            totals["kl"] += float(kl.mean().detach()) / n_batches
            totals["conditional"] += float(reached.mean().detach()) / n_batches
        if epoch + 1 < n_epochs and (epoch < 10 or epoch % 2 == 0):
            models, priors = refit(options.em_iterations)
            if state is not None and (epoch < 10 or epoch % options.em_every == 0):
                state.save("joint", trainer.state(epoch + 1))
            if held is not None:
                totals["held_out"] = held.error(models)
        progress("joint", epoch + 1, n_epochs, totals)
    if state is not None:
        state.save("joint", trainer.state(n_epochs))
    models, _ = fit_models(net, data, conditioning, options, options.final_em_iterations)
    return [models[seed * options.members : (seed + 1) * options.members] for seed in range(options.seeds)]
