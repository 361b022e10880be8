"""The four stages: human VAE, human dynamics, robot VAE, robot dynamics. All seeds train together.

Losses are weighed as the paper's authors do in their implementation (github.com/souljaboy764/buetepage-phri): means
over dimensions (in units of the recording) in all stages but the last, sums there. Where ours departs from it:
- Both LSTMs read the frame before the window that they predict. Theirs read its first frame, also the robot's while
  training, and so a frame later than the one that they get when they run on their own predictions.
- The robot starts from the rest pose; theirs starts from the true first frame.
- Inputs are standardised; posteriors are diagonal; where no second human was recorded (HRI-Yumi), the human dynamics
  train on the one human alone, theirs come from another data set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from mild_viz.evaluation.buetepage import LATENT_SIZE, VAE_HIDDEN
from mild_viz.pairs import Windows, stack_windows
from mild_viz.training.buetepage.networks import (
    Gaussian,
    HumanDynamics,
    RobotDynamics,
    human_inputs,
    jensen_shannon,
    with_code,
)
from mild_viz.training.buetepage.options import BuetepageOptions
from mild_viz.training.networks import BatchedVAE, standard_kl
from mild_viz.training.priors import batches, standardisation
from mild_viz.training.progress import Progress
from mild_viz.trial import Trial


@dataclass(frozen=True, eq=False)
class Examples:
    """What the stages learn from, row by row of the same windows.

    Rows with a gap are left out, so a recurrent network skips them, as it does when it predicts.
    """

    observed: Tensor
    """(A, R, 18): the newest frame of every agent's window. A is 2 where the partner is a human too, else 1."""
    next_window: Tensor
    """(A, R, 90): every agent's own next window."""
    partner_window: Tensor
    """(R, Y): the window to predict."""
    action: Tensor
    """(R, number of actions): one-hot."""
    rows: Tensor
    """(N, T): rows of every trial in the order of time; 0 where it is shorter."""
    mask: Tensor
    """(N, T): which of them are there."""


def make_examples(trials: Sequence[Trial], data: Windows, actions: Sequence[str]) -> Examples:
    """Examples from trials and their windows `data`, whose partner is the one to predict."""
    agents = [stack_windows([replace(trial, partner_arm=trial.human_arm) for trial in trials], None)]
    if all(trial.partner_arm is not None for trial in trials):
        swapped = [replace(trial, human_arm=trial.partner_arm) for trial in trials]
        agents.append(stack_windows(swapped, None))
    usable = np.logical_and.reduce([data.complete, *(agent.complete for agent in agents)])
    code = np.array([[float(of == action) for action in actions] for of in data.actions])[data.trial[usable]]
    trial = data.trial[usable]
    of_trial = [np.flatnonzero(trial == index) for index in np.unique(trial)]
    rows = np.zeros((len(of_trial), max(map(len, of_trial))), dtype=np.int64)
    mask = np.zeros(rows.shape, dtype=bool)
    for index, found in enumerate(of_trial):
        rows[index, : len(found)] = found
        mask[index, : len(found)] = True
    return Examples(
        observed=_tensor(np.stack([human_inputs(agent.human[usable]) for agent in agents])),
        next_window=_tensor(np.stack([agent.partner[usable] for agent in agents])),
        partner_window=_tensor(data.partner[usable]),
        action=_tensor(code),
        rows=torch.tensor(rows),
        mask=torch.tensor(mask),
    )


def _tensor(array: np.ndarray) -> Tensor:
    return torch.tensor(array, dtype=torch.float32)


def sequences(data: Examples, size: int, rng: torch.Generator) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and mask (B, T) of `size` trials at a time, in random order."""
    for trials in torch.randperm(len(data.rows), generator=rng).split(size):
        longest = int(data.mask[trials].sum(1).max())
        yield data.rows[trials, :longest], data.mask[trials, :longest]


def _descend(
    stage: str,
    net: nn.Module,
    options: BuetepageOptions,
    progress: Progress,
    losses: Callable[[], Iterator[dict[str, Tensor]]],
) -> None:
    """AdamW over epochs of `losses`, whose terms are added; they are sums over seeds, and reported as means."""
    optimizer = torch.optim.AdamW(net.parameters(), lr=options.learning_rate)
    for epoch in range(options.epochs):
        totals: dict[str, float] = {}
        n_batches = 0
        for terms in losses():
            optimizer.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            optimizer.step()
            n_batches += 1
            for name, term in terms.items():
                totals[name] = totals.get(name, 0.0) + float(term.detach()) / options.seeds
        progress(stage, epoch + 1, options.epochs, {name: total / n_batches for name, total in totals.items()})


def train_vae(
    stage: str, windows: Tensor, options: BuetepageOptions, progress: Progress, rng: torch.Generator
) -> BatchedVAE:
    """VAEs with prior N(0, I), one a seed, on windows (R, X)."""
    offset, scale = standardisation(windows.numpy().astype(np.float64))
    net = BatchedVAE(options.seeds, offset, scale, VAE_HIDDEN, LATENT_SIZE, rng)
    x, unit = net.standardise(windows), float(scale[0]) ** 2

    def losses() -> Iterator[dict[str, Tensor]]:
        for rows in batches(len(x), options.batch_size, rng):
            target = x[rows].expand(options.seeds, -1, -1)
            mean, log_std = net.encode(target)
            sample = Gaussian(mean, log_std.exp()).sample(rng)
            error = unit * ((net.decode(sample) - target) ** 2).mean((1, 2)).sum()
            kl = standard_kl(mean, log_std).mean(1).sum() / LATENT_SIZE
            yield {"reconstruction": error, "kl": options.beta * kl}

    _descend(stage, net, options, progress, losses)
    return net.requires_grad_(False)


def posterior(vae: BatchedVAE, windows: Tensor) -> Gaussian:
    """q(z | x) of windows (R, X): (S, R, D)."""
    with torch.no_grad():
        mean, log_std = vae.encode(vae.standardise(windows).expand(len(vae.weights["output/bias"]), -1, -1))
    return Gaussian(mean, log_std.exp())


def train_human_dynamics(
    data: Examples, vae: BatchedVAE, options: BuetepageOptions, progress: Progress, rng: torch.Generator
) -> HumanDynamics:
    """Dynamics of every agent (model a * seeds + s), which share d where there are two humans.

    Each predicts z of its own next window; the Jensen-Shannon divergence draws the two humans' d together, so that
    one's d foretells the other's window.
    """
    n_agents, n_seeds = len(data.observed), options.seeds
    offset, scale = standardisation(data.observed.flatten(0, 1).numpy().astype(np.float64))
    net = HumanDynamics(n_agents * n_seeds, *with_code(offset, scale, data.action.shape[1]), rng)
    targets = [posterior(vae, windows) for windows in data.next_window]
    target = Gaussian(*(torch.cat(parts) for parts in zip(*targets, strict=True)))

    def losses() -> Iterator[dict[str, Tensor]]:
        for rows, mask in sequences(data, options.batch_trials, rng):
            d = net.observe(_human_steps(data, rows, n_seeds))
            sample = d.sample(rng)
            kl = net.head(sample).kl(Gaussian(target.mean[:, rows], target.std[:, rows]))[:, mask]
            terms = {"kl": kl.mean((1, 2)).sum()}
            if n_agents == 2:
                first, second = (Gaussian(*part) for part in zip(*(t.chunk(2) for t in d), strict=True))
                divergence = jensen_shannon(first, second, *sample.chunk(2))[:, mask]
                terms["jsd"] = divergence.mean((1, 2)).sum()
            yield terms

    _descend("human dynamics", net, options, progress, losses)
    return net.requires_grad_(False)


def _human_steps(data: Examples, rows: Tensor, n_seeds: int) -> Tensor:
    """Inputs of every agent's and seed's LSTM (A * S, B, T, 18 + actions)."""
    action = data.action[rows].expand(len(data.observed), *rows.shape, -1)
    return torch.cat([data.observed[:, rows], action], dim=-1).repeat_interleave(n_seeds, dim=0)


def train_robot_dynamics(
    data: Examples,
    human: HumanDynamics,
    vae: BatchedVAE,
    rest: Tensor,
    options: BuetepageOptions,
    progress: Progress,
    rng: torch.Generator,
) -> RobotDynamics:
    """Robot dynamics of every seed on the true robot: each step reads the first frame of the window before.

    The loss is the squared error of the decoded window and beta KL to the robot's posterior, on frozen VAEs.
    """
    n_seeds, n_joints = options.seeds, len(rest)
    joints = data.partner_window[:, :n_joints]
    offset, scale = standardisation(joints.numpy().astype(np.float64))
    with torch.no_grad():  # the mean of the first agent's d, row by row
        d = human.observe(_human_steps(data, data.rows, n_seeds)).mean[:n_seeds]
    latent = torch.empty(n_seeds, len(joints), d.shape[-1])
    latent[:, data.rows[data.mask]] = d[:, data.mask]
    net = RobotDynamics(n_seeds, *with_code(offset, scale, data.action.shape[1] + d.shape[-1]), rng)
    target, truth, unit = posterior(vae, data.partner_window), vae.standardise(data.partner_window), vae.scale[0] ** 2

    def losses() -> Iterator[dict[str, Tensor]]:
        for rows, mask in sequences(data, options.batch_trials, rng):
            before = torch.cat([rest.expand(len(rows), 1, -1), joints[rows[:, :-1]]], dim=1)
            given = torch.cat([before, data.action[rows]], dim=-1).expand(n_seeds, *rows.shape, -1)
            z = net(torch.cat([given, latent[:, rows]], dim=-1))
            valid = rows[mask]
            decoded = vae.decode(z.sample(rng)[:, mask])
            error = unit * ((decoded - truth[valid]) ** 2).sum(-1).mean(1).sum()
            kl = Gaussian(z.mean[:, mask], z.std[:, mask]).kl(Gaussian(target.mean[:, valid], target.std[:, valid]))
            yield {"reconstruction": error, "kl": options.beta * kl.sum(-1).mean(1).sum()}

    _descend("robot dynamics", net, options, progress, losses)
    return net.requires_grad_(False)
