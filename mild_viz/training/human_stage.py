"""Algorithm 1: one VAE for both humans, and one HMM per interaction as its prior. All seeds train together.

Where the partner was recorded as a robot (HRI-Yumi) it has a VAE of its own, and the HMMs are over human and robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mild_viz.checkpoint import Checkpoint
from mild_viz.latent.hmm import HMM
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows
from mild_viz.training.networks import BatchedVAE, sampled, squared_error, standard_kl
from mild_viz.training.options import TrainingOptions
from mild_viz.training.priors import StatePriors, batches, complete_rows, fit_hmms, joint_latents, standardisation
from mild_viz.training.progress import HeldOut, Progress
from mild_viz.training.state import RunState, Trainer


@dataclass(frozen=True, eq=False)
class HumanModel:
    """What one seed of the human stage leaves: frozen from here on."""

    vae: VAE
    hmms: dict[str, HMM]
    partner_vae: VAE
    """The same as `vae` where the partner is a human."""

    def as_interaction(self) -> InteractionModel:
        """The model that the HMMs were fitted to."""
        return InteractionModel(self.vae, self.hmms, self.partner_vae)


class Agents(nn.Module):
    """The VAEs of human and partner: one for both where both are human."""

    def __init__(self, human: BatchedVAE, partner: BatchedVAE) -> None:
        super().__init__()
        self.human, self.partner = human, partner


def make_agents(
    data: Windows,
    shared: bool,
    n_models: int,
    options: TrainingOptions,
    rng: torch.Generator,
    start: Sequence[InteractionModel] = (),
) -> Agents:
    """Fresh VAEs in the units of the data, or with the weights of `start`, in turn (the partner's where it fits)."""

    def fresh(offset: Tensor, scale: Tensor) -> BatchedVAE:
        return BatchedVAE(n_models, offset, scale, options.hidden, options.latent_size, rng)

    if shared:
        human = partner = fresh(*standardisation(np.concatenate([data.human, data.partner])))
    else:
        human, partner = fresh(*standardisation(data.human)), fresh(*standardisation(data.partner))
    for m in range(n_models if start else 0):
        model = start[m % len(start)]
        human.load(model.human_vae, m)
        if not shared and model.robot_vae.input_size == data.partner.shape[1]:
            partner.load(model.robot_vae, m)
    return Agents(human, partner).to(options.device)


def train_human_stage(
    data: Windows,
    options: TrainingOptions,
    progress: Progress,
    state: RunState | None = None,
    shared: bool = True,
    init: Checkpoint | None = None,
    held: HeldOut | None = None,
) -> list[HumanModel]:
    """Algorithm 1 for `options.seeds` seeds together: alternate VAE epochs and EM.

    `data` pairs human windows with windows of the second human, or of a recorded robot with `shared` False. `init`: a
    model to go on from (fine-tuning). `held`: what to tell the error on held-out trials by. Returns one frozen model
    a seed.
    """
    rng = torch.Generator().manual_seed(options.seed)
    usable = complete_rows(data)
    # v4's own models have seen the trials that seeds are chosen by: the shared ones start from the shared ones
    names = () if init is None else [name for name in init.variants if name not in init.own_models]
    start = init.members(names[-1]) if init is not None and names else ()
    net = make_agents(usable, shared, options.seeds, options, rng, start)
    x_human = net.human.standardise(torch.tensor(usable.human, dtype=torch.float32, device=options.device))
    x_partner = net.partner.standardise(torch.tensor(usable.partner, dtype=torch.float32, device=options.device))
    n_batches = len(batches(len(usable.trial), options.batch_size, rng))
    n_epochs = options.human_epochs
    trainer = Trainer(net, options, n_epochs * n_batches, options.gradient_clip * options.seeds, rng)

    def fit_models(n_iterations: int) -> tuple[list[HumanModel], list[StatePriors]]:
        models = []
        for seed in range(options.seeds):
            vae = net.human.export(seed)
            partner = vae if shared else net.partner.export(seed)
            latents = joint_latents(vae, partner, data)
            hmms = fit_hmms(latents, data.actions, options, options.covariance_floor, n_iterations)
            models.append(HumanModel(vae, hmms, partner))
        size, tables = options.latent_size, [model.hmms for model in models]
        sides = (slice(0, size), slice(size, 2 * size))
        return models, [StatePriors(tables, usable, side, device=options.device) for side in sides]

    # Before the first EM there is no model: the prior is N(0, I), as Algorithm 1 starts.
    models: list[HumanModel] = []
    priors: list[StatePriors | None] = [None, None]
    first = 0
    if state is not None and (saved := state.load("human")) is not None:
        first = trainer.restore(saved)
        if 0 < first < n_epochs:
            models, priors[:] = fit_models(options.em_iterations)
    for epoch in range(first, n_epochs):
        totals = {"reconstruction": 0.0, "kl": 0.0}
        for rows in batches(len(usable.trial), options.batch_size, rng, options.device):
            loss = torch.zeros((), device=options.device)
            for vae, x, prior in zip((net.human, net.partner), (x_human, x_partner), priors, strict=True):
                target = x[rows].expand(options.seeds, -1, -1)
                mean, log_std = vae.encode(target)
                error = squared_error(vae.decode(sampled(mean, log_std, rng)), target)
                kl = (prior.kl(mean, log_std, rows) if prior else standard_kl(mean, log_std)).mean(1)
                loss = loss + (error + options.beta * kl).sum()
                totals["reconstruction"] += float(error.mean().detach()) / (2 * n_batches)
                totals["kl"] += float(kl.mean().detach()) / (2 * n_batches)
            trainer.descend(loss)
        if epoch + 1 < n_epochs and (epoch < 10 or epoch % options.em_every == 0):
            models, priors[:] = fit_models(options.em_iterations)
            if state is not None:
                state.save("human", trainer.state(epoch + 1))
            if held is not None:
                totals["held_out"] = held.error([model.as_interaction() for model in models])
        progress("human", epoch + 1, n_epochs, totals)
    if state is not None:
        state.save("human", trainer.state(n_epochs))
    return fit_models(options.final_em_iterations)[0]
