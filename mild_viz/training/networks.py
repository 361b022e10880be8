"""Many small VAEs trained at once: every weight has a leading axis over models, every layer is one batched matmul."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from mild_viz.latent.vae import DECODER, ENCODER, LAYERS, LEAK, LOG_STD_RANGE, VAE, layer_shapes


class BatchedVAE(nn.Module):
    """M VAEs of equal sizes. Inputs are (M, B, X) in the standardised units of `offset` and `scale`."""

    def __init__(
        self,
        n_models: int,
        offset: Tensor,
        scale: Tensor,
        hidden: tuple[int, int],
        latent_size: int,
        rng: torch.Generator,
    ) -> None:
        super().__init__()
        self.offset: Tensor
        self.scale: Tensor
        self.register_buffer("offset", offset, persistent=False)  # given by the data: a restart has them again
        self.register_buffer("scale", scale, persistent=False)
        self.weights = nn.ParameterDict()
        for name, shape in layer_shapes(len(offset), hidden, latent_size).items():
            value = torch.zeros(n_models, *shape)
            if name.endswith("weight"):
                bound = math.sqrt(6.0 / sum(shape))  # Xavier, as in Sec. V-A
                value.uniform_(-bound, bound, generator=rng)
            self.weights[name.replace(".", "/")] = nn.Parameter(value)

    @torch.no_grad()
    def load(self, vae: VAE, model: int | slice = slice(None)) -> None:
        """Give a model (default: all) the weights of `vae`, in the units of these data: where fine-tuning starts."""
        offset, scale = self.offset.cpu().numpy().astype(np.float64), self.scale.cpu().numpy().astype(np.float64)
        own = dict(vae.weights)
        own["encoder.0.bias"] = own["encoder.0.bias"] + own["encoder.0.weight"] @ offset
        own["encoder.0.weight"] = own["encoder.0.weight"] * scale
        own["output.bias"] = (own["output.bias"] - offset) / scale
        own["output.weight"] = own["output.weight"] / scale[:, None]
        for name, value in own.items():
            weight = self.weights[name.replace(".", "/")][model]
            weight.copy_(torch.tensor(value, dtype=torch.float32).expand_as(weight))

    def _affine(self, x: Tensor, layer: str) -> Tensor:
        key = layer.replace(".", "/")
        return torch.baddbmm(self.weights[f"{key}/bias"][:, None], x, self.weights[f"{key}/weight"].transpose(1, 2))

    def standardise(self, x: Tensor) -> Tensor:
        return (x - self.offset) / self.scale

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of q(z | x), both (M, B, D), of standardised input (M, B, X)."""
        for layer in ENCODER:
            x = nn.functional.leaky_relu(self._affine(x, layer), LEAK)
        return self._affine(x, "posterior_mean"), self._affine(x, "posterior_log_std").clamp(*LOG_STD_RANGE)

    def decode(self, z: Tensor) -> Tensor:
        """Standardised mean (M, B, X) of p(x | z) for z (M, B, D)."""
        for layer in DECODER:
            z = nn.functional.leaky_relu(self._affine(z, layer), LEAK)
        return self._affine(z, "output")

    def export(self, model: int) -> VAE:
        """Model `model` as plain arrays; the standardisation is folded into the first and the last layer."""
        weights = {}
        for layer in LAYERS:
            for kind in ("weight", "bias"):
                name = f"{layer}.{kind}"
                weights[name] = self.weights[name.replace(".", "/")][model].detach().cpu().numpy().astype(np.float64)
        offset, scale = self.offset.cpu().numpy().astype(np.float64), self.scale.cpu().numpy().astype(np.float64)
        weights["encoder.0.weight"] = weights["encoder.0.weight"] / scale
        weights["encoder.0.bias"] = weights["encoder.0.bias"] - weights["encoder.0.weight"] @ offset
        weights["output.weight"] = weights["output.weight"] * scale[:, None]
        weights["output.bias"] = weights["output.bias"] * scale + offset
        return VAE(weights)


def gaussian_kl(mean: Tensor, log_std: Tensor, prior_mean: Tensor, precision: Tensor, log_det: Tensor) -> Tensor:
    """KL(N(mean, diag std^2) || N(prior_mean, precision^-1)), summed over D; shapes (..., D) and (..., D, D).

    `log_det` (...) is the log determinant of the prior's covariance. Term KL_t of Eq. vaeHMM-prior.
    """
    deviation = mean - prior_mean
    trace = (precision.diagonal(dim1=-2, dim2=-1) * torch.exp(2 * log_std)).sum(-1)
    distance = (deviation * (precision @ deviation[..., None])[..., 0]).sum(-1)
    return 0.5 * (trace + distance - mean.shape[-1] + log_det - 2 * log_std.sum(-1))


def standard_kl(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL(N(mean, diag std^2) || N(0, I)), summed over D."""
    return 0.5 * (mean**2 + torch.exp(2 * log_std) - 1 - 2 * log_std).sum(-1)


def noise_like(x: Tensor, rng: torch.Generator) -> Tensor:
    """Standard normal numbers of the shape of `x`: drawn on the CPU, so that every device sees the same ones."""
    return torch.randn(x.shape, generator=rng).to(x.device)


def sampled(mean: Tensor, log_std: Tensor, rng: torch.Generator) -> Tensor:
    """One sample of every posterior."""
    return mean + torch.exp(log_std) * noise_like(mean, rng)


def squared_error(decoded: Tensor, target: Tensor) -> Tensor:
    """Squared error (M,) summed over the window and averaged over the batch, of (M, B, X)."""
    return ((decoded - target) ** 2).sum(-1).mean(1)
