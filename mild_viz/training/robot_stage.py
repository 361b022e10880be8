"""Algorithm 2: robot VAEs of all variants and seeds on the frozen human side, in one batched network.

The human side is frozen, so the conditional of every training window is computed once. Each variant then
decodes z = c + L eps: v2 has c and L of a conditioned posterior sample (L = A diag(s)), v3 those of the
conditional distribution (L its Cholesky factor).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from mild_viz.checkpoint import Checkpoint
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import unobserved_forward
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows
from mild_viz.settings import VARIANTS, Variant
from mild_viz.training.human_stage import HumanModel
from mild_viz.training.networks import BatchedVAE, noise_like, sampled, squared_error
from mild_viz.training.options import TrainingOptions
from mild_viz.training.priors import StatePriors, batches, complete_rows, standardisation
from mild_viz.training.progress import HeldOut, Progress
from mild_viz.training.state import RunState, Trainer


def conditional_factors(model: HumanModel, data: Windows, variant: Variant) -> tuple[np.ndarray, np.ndarray]:
    """c (R, D) and L (R, D, D) of a variant's training samples z = c + L eps, for every row of `data`.

    Weighted by the unobserved forward variable, as Eq. conditioning-withcov-mu-t has it.
    """
    mean, std = model.vae.encode(data.human)
    size = mean.shape[1]
    centre, factor = np.empty_like(mean), np.empty((len(mean), size, size))
    n_steps = int(data.step.max()) + 1
    for trial, action in enumerate(data.actions):
        rows = data.rows(trial)
        hmm = model.hmms[action]
        log_alpha = unobserved_forward(hmm, n_steps)[data.step[rows]]
        posterior = std[rows] if variant.posterior_covariance else None
        centre[rows], covariance = condition(hmm, mean[rows], log_alpha, posterior)
        if variant.conditional_training == "posterior-samples":
            # The conditioned mean is affine in the human's latent: A is its slope, found exactly by a unit step.
            for d in range(size):
                step = np.zeros(size)
                step[d] = 1.0
                moved, _ = condition(hmm, mean[rows] + step, log_alpha, posterior)
                factor[rows, :, d] = (moved - centre[rows]) * std[rows, d, None]
        else:
            factor[rows] = np.linalg.cholesky(covariance + 1e-6 * np.eye(size))
    return centre, factor


def train_robot_stage(
    data: Windows,
    humans: Sequence[HumanModel],
    variants: Sequence[str],
    options: TrainingOptions,
    progress: Progress,
    state: RunState | None = None,
    init: Checkpoint | None = None,
    held: HeldOut | None = None,
) -> list[dict[str, VAE]]:
    """Algorithm 2 for every variant on every frozen human model. Returns, per human model, the robot VAEs.

    The networks start at random; at the robot VAE of `init` where that drives as many joints; or, where the human
    stage had the robot for a partner, at the VAE that the HMMs were fitted to.
    """
    rng = torch.Generator().manual_seed(options.seed + 1)
    usable = complete_rows(data)
    size, device = options.latent_size, options.device
    table = [(VARIANTS[name], human) for name in variants for human in humans]
    n_models = len(table)
    offset, scale = standardisation(usable.partner)
    net = BatchedVAE(n_models, offset, scale, options.hidden, size, rng)
    for m, (variant, human) in enumerate(table):
        if human.partner_vae is not human.vae:
            net.load(human.partner_vae, m)
        elif init is not None and variant.name in init.robot_vaes:
            start = init.robot_vaes[variant.name]
            if start.input_size == usable.partner.shape[1]:
                net.load(start, m)
    net = net.to(device)
    x = net.standardise(torch.tensor(usable.partner, dtype=torch.float32, device=device))
    prior = StatePriors([human.hmms for _, human in table], usable, slice(size, 2 * size), device=device)

    conditional = [m for m, (variant, _) in enumerate(table) if variant.conditional_training != "none"]
    factors = [conditional_factors(table[m][1], usable, table[m][0]) for m in conditional]
    use = torch.zeros(n_models)
    use[conditional] = 1.0
    centre = torch.zeros(n_models, len(x), size)
    factor = torch.zeros(n_models, len(x), size, size)
    for m, (c, f) in zip(conditional, factors, strict=True):
        centre[m], factor[m] = torch.tensor(c, dtype=torch.float32), torch.tensor(f, dtype=torch.float32)
    use, centre, factor = use.to(device), centre.to(device), factor.to(device)

    n_batches = len(batches(len(x), options.batch_size, rng))
    n_steps = options.robot_epochs * n_batches
    trainer = Trainer(net, options, n_steps, options.gradient_clip * n_models, rng)
    saved = state.load("robot") if state is not None else None
    first = trainer.restore(saved) if saved is not None else 0
    for epoch in range(first, options.robot_epochs):
        totals = {"reconstruction": 0.0, "kl": 0.0, "conditional": 0.0}
        for rows in batches(len(x), options.batch_size, rng, device):
            target = x[rows].expand(n_models, -1, -1)
            mean, log_std = net.encode(target)
            error = squared_error(net.decode(sampled(mean, log_std, rng)), target)
            kl = prior.kl(mean, log_std, rows).mean(1)
            c = centre.index_select(1, rows)
            spread = (factor.index_select(1, rows) @ noise_like(c, rng)[..., None])[..., 0]
            # One Monte-Carlo sample and the mean itself, which is what is decoded at test time.
            decoded = net.decode(torch.cat([c + spread, c], dim=1))
            reached = squared_error(decoded, target.repeat(1, 2, 1)) * use
            trainer.descend((error + options.beta * kl + reached).sum())
            totals["reconstruction"] += float(error.mean().detach()) / n_batches
            totals["kl"] += float(kl.mean().detach()) / n_batches
            totals["conditional"] += float(reached.sum().detach() / use.sum().clamp(min=1)) / n_batches
        if epoch % options.em_every == 0 or epoch + 1 == options.robot_epochs:
            if state is not None:
                state.save("robot", trainer.state(epoch + 1))
            if held is not None and conditional:
                models = [InteractionModel(table[m][1].vae, table[m][1].hmms, net.export(m)) for m in conditional]
                totals["held_out"] = held.error(models, [table[m][0].posterior_covariance for m in conditional])
        progress("robot", epoch + 1, options.robot_epochs, totals)
    return [{name: net.export(v * len(humans) + h) for v, name in enumerate(variants)} for h in range(len(humans))]
