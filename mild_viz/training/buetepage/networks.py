"""The recurrent networks of the baseline, M models at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mild_viz.evaluation.buetepage import (
    DYNAMICS_LATENT_SIZE,
    HUMAN_LAYERS,
    LATENT_SIZE,
    LSTM_SIZE,
    ROBOT_LAYERS,
)
from mild_viz.settings import ARM_FEATURES

MIN_STD = 1e-4
"""Added to every standard deviation."""


class Gaussian(NamedTuple):
    """A diagonal Gaussian."""

    mean: Tensor
    std: Tensor

    def sample(self, rng: torch.Generator) -> Tensor:
        return self.mean + self.std * torch.randn(self.mean.shape, generator=rng)

    def log_prob(self, x: Tensor) -> Tensor:
        """Of every dimension for itself."""
        return -0.5 * ((x - self.mean) / self.std) ** 2 - torch.log(self.std) - 0.5 * math.log(2 * math.pi)

    def kl(self, other: Gaussian) -> Tensor:
        """KL(self || other) of every dimension for itself."""
        ratio = (self.std / other.std) ** 2
        return 0.5 * (ratio + ((self.mean - other.mean) / other.std) ** 2 - 1 - torch.log(ratio))


def jensen_shannon(p: Gaussian, q: Gaussian, x_p: Tensor, x_q: Tensor) -> Tensor:
    """Jensen-Shannon divergence of every dimension for itself, estimated from a sample of each."""
    total = torch.zeros(())
    for own, other, x in ((p, q, x_p), (q, p, x_q)):
        log_own = own.log_prob(x)
        total = total + 0.5 * (log_own - torch.logaddexp(log_own, other.log_prob(x)) + math.log(2))
    return total


class BatchedAffine(nn.Module):
    """M affine layers: (M, B, T, I) -> (M, B, T, O)."""

    def __init__(self, n_models: int, n_inputs: int, n_outputs: int, rng: torch.Generator) -> None:
        super().__init__()
        bound = math.sqrt(6.0 / (n_inputs + n_outputs))  # Xavier, as the VAEs
        self.weight = nn.Parameter(torch.empty(n_models, n_outputs, n_inputs).uniform_(-bound, bound, generator=rng))
        self.bias = nn.Parameter(torch.zeros(n_models, 1, n_outputs))

    def forward(self, x: Tensor) -> Tensor:
        flat = torch.baddbmm(self.bias, x.flatten(1, 2), self.weight.transpose(1, 2))
        return flat.unflatten(1, x.shape[1:3])

    def export(self, model: int, name: str) -> dict[str, np.ndarray]:
        return {f"{name}.weight": _array(self.weight[model]), f"{name}.bias": _array(self.bias[model, 0])}


class BatchedLSTM(nn.Module):
    """M LSTMs: (M, B, T, I) -> hidden vectors (M, B, T, H). Inputs are standardised by `offset` and `scale` (I,).

    One fused call a model: on a CPU that is an order faster than one batched matmul a step.
    """

    def __init__(self, n_models: int, offset: Tensor, scale: Tensor, rng: torch.Generator) -> None:
        super().__init__()
        self.offset, self.scale = offset, scale
        bound = 1 / math.sqrt(LSTM_SIZE)  # torch's own, from our generator
        self.models = nn.ModuleList(nn.LSTM(len(offset), LSTM_SIZE, batch_first=True) for _ in range(n_models))
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound, generator=rng)

    def forward(self, x: Tensor) -> Tensor:
        x = (x - self.offset) / self.scale
        return torch.stack([lstm(of_model)[0] for lstm, of_model in zip(self.models, x, strict=True)])

    def export(self, model: int, name: str) -> dict[str, np.ndarray]:
        """Arrays that act on the inputs as recorded: the standardisation is folded into them."""
        tensors = {key: _array(value) for key, value in self.models[model].named_parameters()}
        weight = tensors["weight_ih_l0"] / _array(self.scale)
        return {
            f"{name}.input_weight": weight,
            f"{name}.recurrent_weight": tensors["weight_hh_l0"],
            f"{name}.bias": tensors["bias_ih_l0"] + tensors["bias_hh_l0"] - weight @ _array(self.offset),
        }


class GaussianHead(nn.Module):
    """tanh layers, then the mean and the standard deviation (softplus) of a Gaussian."""

    def __init__(
        self, n_models: int, n_inputs: int, layers: tuple[int, ...], n_outputs: int, rng: torch.Generator
    ) -> None:
        super().__init__()
        widths = (n_inputs, *layers)
        self.layers = nn.ModuleList(
            BatchedAffine(n_models, before, after, rng) for before, after in zip(widths, layers, strict=False)
        )
        self.mean = BatchedAffine(n_models, widths[-1], n_outputs, rng)
        self.std = BatchedAffine(n_models, widths[-1], n_outputs, rng)

    def forward(self, x: Tensor) -> Gaussian:
        for layer in self.layers:
            x = torch.tanh(layer(x))
        return Gaussian(self.mean(x), nn.functional.softplus(self.std(x)) + MIN_STD)

    def export(self, model: int) -> dict[str, np.ndarray]:
        tensors = self.mean.export(model, "z_mean")
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, BatchedAffine)
            tensors |= layer.export(model, f"head.{index}")
        return tensors


class HumanDynamics(nn.Module):
    """Human frames and action -> Gaussian d, and a sample of d -> Gaussian z of the human's next window."""

    def __init__(self, n_models: int, offset: Tensor, scale: Tensor, rng: torch.Generator) -> None:
        super().__init__()
        self.lstm = BatchedLSTM(n_models, offset, scale, rng)
        self.latent = GaussianHead(n_models, LSTM_SIZE, (), DYNAMICS_LATENT_SIZE, rng)
        self.head = GaussianHead(n_models, DYNAMICS_LATENT_SIZE, HUMAN_LAYERS, LATENT_SIZE, rng)

    def observe(self, x: Tensor) -> Gaussian:
        """d after every frame (M, B, T, 18 + actions)."""
        return self.latent(self.lstm(x))

    def export(self, model: int) -> dict[str, np.ndarray]:
        """What observes the human: the LSTM and the mean of d."""
        return self.lstm.export(model, "human_lstm") | self.latent.mean.export(model, "latent_mean")


class RobotDynamics(nn.Module):
    """Robot joints, action and mean of d -> Gaussian z of the robot's next window."""

    def __init__(self, n_models: int, offset: Tensor, scale: Tensor, rng: torch.Generator) -> None:
        super().__init__()
        self.lstm = BatchedLSTM(n_models, offset, scale, rng)
        self.head = GaussianHead(n_models, LSTM_SIZE, ROBOT_LAYERS, LATENT_SIZE, rng)

    def forward(self, x: Tensor) -> Gaussian:
        """z after every step (M, B, T, joints + actions + size of d)."""
        return self.head(self.lstm(x))

    def export(self, model: int) -> dict[str, np.ndarray]:
        return self.lstm.export(model, "robot_lstm") | self.head.export(model)


def with_code(offset: Tensor, scale: Tensor, n_others: int) -> tuple[Tensor, Tensor]:
    """Standardisation of inputs of which the last `n_others` (one-hot code, d) are left as they are."""
    return torch.cat([offset, torch.zeros(n_others)]), torch.cat([scale, torch.ones(n_others)])


def human_inputs(windows: np.ndarray) -> np.ndarray:
    """The newest frame of every human window (R, 90): (R, 18)."""
    return windows[:, -ARM_FEATURES:]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)
