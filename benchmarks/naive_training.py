"""The authors' way of training MILD (Algorithms 1 and 2, Sec. V-A), written for comparison: one trial after the other.

A PyTorch network for every variant and seed; one trial a batch; ten Monte-Carlo samples; AdamW. After every epoch the
HMMs are fitted anew from the equal split in time, with recursions that run over the steps of a trial in PyTorch, as
pbdlib's do. The forward variable and the conditional of a trial are computed whenever the trial comes up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import MultivariateNormal, kl_divergence

from mild_viz.latent.em import TRANSITION_FLOOR
from mild_viz.latent.vae import LEAK, LOG_STD_RANGE
from mild_viz.settings import Variant
from mild_viz.training.options import TrainingOptions

SAMPLES = 10
"""Monte-Carlo samples of every input (Sec. V-A)."""

CHOLESKY_FLOOR = (9.1e-5, 1e-4)
"""Added to a conditional covariance before it is factored: to the first and the last of its diagonal (Sec. V-A)."""


class TrialWindows(NamedTuple):
    """The complete windows of one trial, standardised, and where in the trial they lie."""

    action: str
    human: Tensor
    partner: Tensor
    step: Tensor


class NaiveVAE(nn.Module):
    """x -> 40 -> 20 -> z -> 20 -> 40 -> x, for one variant and seed."""

    def __init__(self, input_size: int, options: TrainingOptions, rng: torch.Generator) -> None:
        super().__init__()
        first, second = options.hidden
        self.encoder = nn.Sequential(
            nn.Linear(input_size, first), nn.LeakyReLU(LEAK), nn.Linear(first, second), nn.LeakyReLU(LEAK)
        )
        self.posterior_mean, self.posterior_log_std = (nn.Linear(second, options.latent_size) for _ in range(2))
        self.decoder = nn.Sequential(
            nn.Linear(options.latent_size, second), nn.LeakyReLU(LEAK), nn.Linear(second, first), nn.LeakyReLU(LEAK),
            nn.Linear(first, input_size),
        )  # fmt: skip
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight, generator=rng)
                nn.init.zeros_(module.bias)

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the posterior, both (T, D)."""
        x = self.encoder(x)
        return self.posterior_mean(x), self.posterior_log_std(x).clamp(*LOG_STD_RANGE).exp()


class NaiveHMM:
    """Full-covariance Gaussian HMM of one interaction, fitted to sequences (T, D) from the equal split in time."""

    def __init__(self, sequences: Sequence[Tensor], options: TrainingOptions) -> None:
        self.n_states, self.floor = options.n_states, options.covariance_floor
        parts = zip(*(sequence.tensor_split(self.n_states) for sequence in sequences), strict=True)
        pooled = [torch.cat(part) for part in parts]
        self.floor_matrix = self.floor * torch.eye(sequences[0].shape[1], dtype=torch.float64)
        self.means = torch.stack([part.mean(0) for part in pooled])
        self.covariances = torch.stack([torch.cov(part.T, correction=0) + self.floor_matrix for part in pooled])
        stay = 1.0 - self.n_states * len(sequences) / sum(map(len, sequences))
        transition = torch.full((self.n_states, self.n_states), TRANSITION_FLOOR, dtype=torch.float64)
        for state in range(self.n_states - 1):
            transition[state, state], transition[state, state + 1] = stay, 1.0 - stay
        transition[-1, -1] = 1.0
        self.transition = transition / transition.sum(1, keepdim=True)
        initial = torch.full((self.n_states,), TRANSITION_FLOOR, dtype=torch.float64)
        initial[0] = 1.0
        self.initial = initial / initial.sum()

    def smooth(self, z: Tensor) -> tuple[Tensor, Tensor, float]:
        """Forward-backward over one sequence: gamma (T, S), expected transitions (S, S), log p(z)."""
        log_density = torch.stack(
            [MultivariateNormal(m, c).log_prob(z) for m, c in zip(self.means, self.covariances, strict=True)], dim=1
        )
        top = log_density.max(1, keepdim=True).values
        density = (log_density - top).exp()
        alpha, beta, scale = torch.empty_like(density), torch.ones_like(density), torch.empty(len(z)).double()
        for t in range(len(z)):
            predicted = self.initial if t == 0 else alpha[t - 1] @ self.transition
            joint = predicted * density[t]
            scale[t] = joint.sum()
            alpha[t] = joint / scale[t]
        for t in range(len(z) - 2, -1, -1):
            beta[t] = self.transition @ (density[t + 1] * beta[t + 1]) / scale[t + 1]
        ahead = density[1:] * beta[1:] / scale[1:, None]
        gamma, counts = alpha * beta, self.transition * (alpha[:-1].T @ ahead)
        return gamma, counts, float((top[:, 0] + scale.log()).sum())

    def em(self, sequences: Sequence[Tensor], n_iterations: int, tolerance: float = 1e-3) -> list[float]:
        """At most so many iterations; the log-likelihood before every one. Stops as `mild_viz.latent.em.fit` does."""
        history: list[float] = []
        stacked = torch.cat(list(sequences))
        for _ in range(n_iterations):
            gammas, counts, totals = zip(*(self.smooth(sequence) for sequence in sequences), strict=True)
            gamma = torch.cat(gammas)
            mass = gamma.sum(0)
            self.means = gamma.T @ stacked / mass[:, None]
            deviation = stacked[:, None] - self.means
            second = torch.einsum("ns,nsd,nse->sde", gamma, deviation, deviation)
            self.covariances = second / mass[:, None, None] + self.floor_matrix
            transition = torch.stack(counts).sum(0)
            transition = (transition / transition.sum(1, keepdim=True)).clamp(min=TRANSITION_FLOOR)
            self.transition = transition / transition.sum(1, keepdim=True)
            initial = (torch.stack([g[0] for g in gammas]).mean(0)).clamp(min=TRANSITION_FLOOR)
            self.initial = initial / initial.sum()
            history.append(sum(totals))
            if len(history) > 1 and abs(history[-1] - history[-2]) < tolerance * len(stacked):
                break
        return history

    def unobserved(self, step: Tensor) -> Tensor:
        """The unobserved forward variable (Eq. vaeHMM-prior) at the given steps: (T, S)."""
        alpha = [self.initial]
        for _ in range(int(step[-1])):
            alpha.append(alpha[-1] @ self.transition)
        return torch.stack(alpha)[step]

    def prior(self, step: Tensor, agent: slice) -> MultivariateNormal:
        """The marginal of the most likely state at each step, for one agent."""
        state = self.unobserved(step).argmax(1)
        return MultivariateNormal(self.means[state][:, agent].float(), self.covariances[state][:, agent, agent].float())

    def condition(self, z: Tensor, alpha: Tensor, std: Tensor | None) -> tuple[Tensor, Tensor]:
        """Mean (T, D) and covariance (T, D, D) of the robot's latent given the human's z (T, D)."""
        gains, means = self._conditional_means(z, std)
        mixed = torch.einsum("ts,std->td", alpha, means)
        size, second = z.shape[-1], torch.zeros(*z.shape, z.shape[-1]).double()
        for state, (covariance, gain, mean) in enumerate(zip(self.covariances, gains, means, strict=True)):
            within = covariance[size:, size:] - gain @ covariance[:size, size:]
            second += alpha[:, state, None, None] * (within + mean[:, :, None] * mean[:, None, :])
        return mixed, second - mixed[:, :, None] * mixed[:, None, :]

    def condition_samples(self, z: Tensor, alpha: Tensor, std: Tensor | None) -> Tensor:
        """Means of the robot's latent given samples of the human's (K, T, D)."""
        return torch.einsum("ts,sktd->ktd", alpha, self._conditional_means(z, std)[1])

    def _conditional_means(self, z: Tensor, std: Tensor | None) -> tuple[list[Tensor], Tensor]:
        """Per state the gain (with `std`, one a step) and the conditional mean, with the shape of z."""
        size, gains, means = z.shape[-1], [], []
        for mean, covariance in zip(self.means, self.covariances, strict=True):
            observed = covariance[:size, :size] + (0.0 if std is None else torch.diag_embed(std**2))
            gains.append(covariance[size:, :size] @ torch.linalg.inv(observed))
            means.append(mean[size:] + (gains[-1] @ (z - mean[:size])[..., None])[..., 0])
        return gains, torch.stack(means)


def reconstruction(net: NaiveVAE, samples: Tensor, target: Tensor) -> Tensor:
    """Squared error of decoded samples (K, T, D), summed over a window and averaged."""
    return ((net.decoder(samples) - target) ** 2).sum(-1).mean()


def posterior_loss(net: NaiveVAE, x: Tensor, prior: MultivariateNormal | None, beta: float) -> Tensor:
    """Reconstruction of posterior samples plus beta KL, of one trial and agent (Eq. vaeHMM-ELBO)."""
    mean, std = net.encode(x)
    posterior = MultivariateNormal(mean, scale_tril=torch.diag_embed(std))
    if prior is None:
        prior = MultivariateNormal(torch.zeros_like(mean), torch.eye(mean.shape[1]))
    return reconstruction(net, posterior.rsample((SAMPLES,)), x) + beta * kl_divergence(posterior, prior).mean()


class NaiveHuman:
    """Algorithm 1 for one seed."""

    def __init__(self, trials: Sequence[TrialWindows], options: TrainingOptions, rng: torch.Generator) -> None:
        self.trials, self.options, self.rng = trials, options, rng
        self.net = NaiveVAE(trials[0].human.shape[1], options, rng)
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=options.learning_rate)
        self.hmms: dict[str, NaiveHMM] = {}

    def epoch(self) -> None:
        """One pass over the trials; then the HMMs anew."""
        size = self.options.latent_size
        for index in torch.randperm(len(self.trials), generator=self.rng).tolist():
            trial = self.trials[index]
            loss = torch.zeros(())
            for x, agent in ((trial.human, slice(0, size)), (trial.partner, slice(size, 2 * size))):
                prior = self.hmms[trial.action].prior(trial.step, agent) if self.hmms else None
                loss = loss + posterior_loss(self.net, x, prior, self.options.beta)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        self.fit_hmms()

    @torch.no_grad()
    def fit_hmms(self) -> None:
        # Posterior means, as our own way takes them; the authors take samples, which is no other work.
        for action in dict.fromkeys(trial.action for trial in self.trials):
            of_action = [trial for trial in self.trials if trial.action == action]
            latents = [torch.cat([self.net.encode(x)[0] for x in (t.human, t.partner)], 1).double() for t in of_action]
            self.hmms[action] = NaiveHMM(latents, self.options)
            self.hmms[action].em(latents, self.options.em_iterations)


class NaiveRobot:
    """Algorithm 2 for one variant and seed. The trials' partner is the robot."""

    def __init__(
        self, trials: Sequence[TrialWindows], human: NaiveHuman, variant: Variant, rng: torch.Generator
    ) -> None:
        self.trials, self.human, self.variant, self.rng = trials, human, variant, rng
        self.options = human.options
        self.net = NaiveVAE(trials[0].partner.shape[1], self.options, rng)
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=self.options.learning_rate)

    def epoch(self) -> None:
        """One pass over the trials."""
        size = self.options.latent_size
        for index in torch.randperm(len(self.trials), generator=self.rng).tolist():
            trial = self.trials[index]
            prior = self.human.hmms[trial.action].prior(trial.step, slice(size, 2 * size))
            loss = posterior_loss(self.net, trial.partner, prior, self.options.beta)
            if self.variant.conditional_training != "none":
                loss = loss + reconstruction(self.net, self.conditional_samples(trial), trial.partner)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()

    @torch.no_grad()
    def conditional_samples(self, trial: TrialWindows) -> Tensor:
        """What the decoder is trained on besides posterior samples: (K, T, D)."""
        hmm = self.human.hmms[trial.action]
        mean, std = (value.double() for value in self.human.net.encode(trial.human))
        alpha = hmm.unobserved(trial.step)
        posterior = std if self.variant.posterior_covariance else None
        if self.variant.conditional_training == "posterior-samples":
            samples = mean + std * torch.randn(SAMPLES, *mean.shape, generator=self.rng).double()
            return hmm.condition_samples(samples, alpha, posterior).float()
        centre, covariance = hmm.condition(mean, alpha, posterior)
        lowest = float(torch.linalg.eigvalsh(covariance).min())  # the nearest positive definite one, as the authors
        floor = torch.linspace(*CHOLESKY_FLOOR, mean.shape[1]).double() + max(-lowest, 0.0)
        return MultivariateNormal(centre, covariance + torch.diag(floor)).sample((SAMPLES,)).float()
