"""What decides a training run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mild_viz.errors import UserError
from mild_viz.latent.context import MAX_LAG, ContextLayout
from mild_viz.latent.state_models import STATE_MODELS
from mild_viz.settings import VARIANTS, choose

WHOLE_NUMBERS = {
    "seeds": 256, "human_epochs": 100_000, "robot_epochs": 100_000, "hidden": 10_000, "latent_size": 1000,
    "n_states": 1000, "batch_size": 1_000_000, "em_every": 100_000, "em_iterations": 100_000,
    "final_em_iterations": 100_000, "joint_epochs": 100_000, "members": 64, "lags": MAX_LAG,
}  # fmt: skip
"""Options that count something, and the most that each may be."""
POSITIVE_NUMBERS = (
    "learning_rate",
    "peak_learning_rate",
    "covariance_floor",
    "gradient_clip",
    "joint_floor",
    "context_noise",
)
DEVICES = ("cpu", "cuda")


STAGES = ("hhi", "hri")


def stage_variants(stage: str, variants: Sequence[str]) -> tuple[str, ...]:
    """The variants that a stage trains of those asked for, each once.

    A human-human model is v1 by construction, since its one VAE serves both and there is no robot; v4 has its own.
    """
    choose("stage", stage, STAGES)
    names = tuple(dict.fromkeys(choose("variant", name, list(VARIANTS)) for name in variants))
    if not names:
        raise UserError(f"no variant is given; valid: {', '.join(VARIANTS)}")
    if stage == "hhi":
        names = tuple(name for name in names if VARIANTS[name].own_models or name == "v1") or ("v1",)
    return names


@dataclass(frozen=True)
class TrainingOptions:
    """Sizes, schedule and weights of both stages. Saved with every checkpoint."""

    seed: int = 0
    seeds: int = 4
    """How many models are trained together; the best by held-out trials is kept."""
    hidden: tuple[int, int] = (40, 20)
    latent_size: int = 5
    n_states: int = 6
    state_model: str = "hmm"
    """Kind of the hidden-state model, a name in `STATE_MODELS`."""
    human_epochs: int = 60
    robot_epochs: int = 60
    batch_size: int = 256
    learning_rate: float = 5e-4
    peak_learning_rate: float = 4e-3
    """Top of the one-cycle schedule."""
    beta: float = 5e-3
    """Weight of the KL term (Eq. elbo)."""
    covariance_floor: float = 1e-3
    """Added to the diagonal of every HMM covariance [latent units squared]."""
    em_every: int = 5
    """The HMMs are fitted anew after every epoch of the first ten, then every so many epochs."""
    em_iterations: int = 10
    final_em_iterations: int = 50
    gradient_clip: float = 10.0
    held_out: int = 1
    """Trials of every action that are kept from training, to choose among the seeds."""
    fold: int = -1
    """Which trials those are: from this one of the action backwards. All folds in turn are a cross-validation."""
    device: str = "cpu"
    """Where the networks train: cpu, or cuda. Random numbers are the CPU's, so that both see the same."""
    joint_epochs: int = 40
    """v4: passes over the training trials."""
    members: int = 4
    """v4: models whose predictions are averaged."""
    lags: tuple[int, ...] = (10, 20)
    """v4: how many frames ago the further human latents of the context are taken."""
    clock: float = 6.0
    """v4: height of the bumps of the context that tell the time since the trial began; 0: none."""
    context_noise: float = 3.0
    """v4: variance of the noise on every number of the context [latent units squared]."""
    joint_floor: float = 1e-2
    """v4: what stands for `covariance_floor`."""
    joint_held_out: bool = False
    """v4: keep the held-out trials from its training, too. It is not chosen among seeds, so that it need not."""

    def __post_init__(self) -> None:
        for name, most in WHOLE_NUMBERS.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                least = 0 if name.endswith("em_iterations") else 1  # none: the equal split in time itself
                if not least <= number <= most:
                    raise UserError(f"{name} is {value}; valid: {least} to {most}")
        for name in POSITIVE_NUMBERS:
            if not 0 < getattr(self, name) < float("inf"):
                raise UserError(f"{name} is {getattr(self, name)}; valid: a finite number above 0")
        for name in ("beta", "held_out", "clock"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise UserError(f"{name} is {getattr(self, name)}; valid: 0 or more")
        choose("state_model", self.state_model, list(STATE_MODELS))
        choose("device", self.device, DEVICES)
        ContextLayout(self.lags, self.clock)  # refuses what a context cannot hold
        if not 0 <= self.seed < 2**31:
            raise UserError(f"seed is {self.seed}; valid: 0 to {2**31 - 1}")
