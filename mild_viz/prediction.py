"""What a checkpoint predicts of the partner, over a whole trial: the one place where several models are averaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.latent.interaction import InteractionModel, ModelCarry, Prediction
from mild_viz.settings import VARIANTS, choose

UNKNOWN_RATE = 30.0
"""Where a checkpoint does not say at which rate it was trained; no variant that asks for it lacks it."""


def advance(
    models: Sequence[InteractionModel],
    variant: str,
    action: str,
    human: Float[np.ndarray, "N X"],
    carries: Sequence[ModelCarry],
    rate: float | None,
) -> tuple[Prediction, tuple[ModelCarry, ...]]:
    """Take N further windows with every model. Latents are the first model's, decoded windows the average of all."""
    covariance = VARIANTS[variant].posterior_covariance
    steps = [
        model.advance(action, human, carry, rate or UNKNOWN_RATE, covariance)
        for model, carry in zip(models, carries, strict=True)
    ]
    first = steps[0][0]
    if len(steps) > 1:
        first = first._replace(decoded=np.mean([prediction.decoded for prediction, _ in steps], axis=0))
    return first, tuple(carry for _, carry in steps)


def predict(checkpoint: Checkpoint, variant: str, action: str, human: Float[np.ndarray, "N X"]) -> Prediction:
    """Everything that a variant says about the human windows of one trial (Algorithm vae-HMM-test up to decoding).

    Raises:
        UserError: if the checkpoint does not know the variant or the action.
    """
    choose(f"checkpoint {checkpoint.name}: action", action, checkpoint.actions)
    models = checkpoint.members(variant)
    starts = [model.start() for model in models]
    return advance(models, variant, action, human, starts, checkpoint.rate)[0]
