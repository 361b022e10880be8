"""What decides a training run of the baseline."""

from __future__ import annotations

from dataclasses import dataclass

from mild_viz.errors import UserError


@dataclass(frozen=True)
class BuetepageOptions:
    """Schedule and weights, as the paper's authors configured them. Saved with every model."""

    seed: int = 0
    seeds: int = 4
    """How many models are trained together; the best by held-out trials is kept."""
    epochs: int = 400
    """Of every stage."""
    learning_rate: float = 5e-4
    beta: float = 5e-4
    """Weight of the KL terms of the VAEs and of the robot dynamics."""
    batch_size: int = 256
    """Windows in a step of a VAE."""
    batch_trials: int = 1
    """Trials in a step of the dynamics; one, as the authors have it."""

    def __post_init__(self) -> None:
        for name, most in (("seeds", 256), ("epochs", 100_000)):
            if not 1 <= getattr(self, name) <= most:
                raise UserError(f"{name} is {getattr(self, name)}; valid: 1 to {most}")
        if not 0 <= self.seed < 2**31:
            raise UserError(f"seed is {self.seed}; valid: 0 to {2**31 - 1}")
