"""The variational autoencoder as plain arrays: what inference, the page and the checkpoint need of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError

LEAK = 0.01
"""Negative slope of the leaky ReLU (Sec. V-A of the paper)."""

LOG_STD_RANGE = (-12.0, 0.0)
"""Bounds of the posterior's log standard deviation: latents have about unit scale, and an unbounded exponential
of a rare input can swamp a whole training batch."""

ENCODER = ("encoder.0", "encoder.1")
DECODER = ("decoder.0", "decoder.1")
LAYERS = (*ENCODER, "posterior_mean", "posterior_log_std", *DECODER, "output")
"""Affine layers of a VAE, in the order in which they act."""


@dataclass(frozen=True, eq=False)
class VAE:
    """A VAE with two hidden layers each way: x -> 40 -> 20 -> z -> 20 -> 40 -> x by default.

    `weights` holds `<layer>.weight` (out, in) and `<layer>.bias` (out,) for every layer in `LAYERS`.
    """

    weights: Mapping[str, Float[np.ndarray, "..."]]

    @property
    def input_size(self) -> int:
        return self.weights["encoder.0.weight"].shape[1]

    @property
    def latent_size(self) -> int:
        return self.weights["posterior_mean.weight"].shape[0]

    @cached_property
    def _layers(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Transposed weight and bias of every layer, laid out as the product reads them."""
        return {
            layer: (np.ascontiguousarray(self.weights[f"{layer}.weight"].T), self.weights[f"{layer}.bias"])
            for layer in LAYERS
        }

    def _affine(self, x: np.ndarray, layer: str) -> np.ndarray:
        weight, bias = self._layers[layer]
        return x @ weight + bias

    def encode(self, x: Float[np.ndarray, "N X"]) -> tuple[Float[np.ndarray, "N D"], Float[np.ndarray, "N D"]]:
        """Mean and standard deviation of the posterior q(z | x)."""
        for layer in ENCODER:
            x = self._affine(x, layer)
            x = np.maximum(x, LEAK * x)
        return self._affine(x, "posterior_mean"), np.exp(np.clip(self._affine(x, "posterior_log_std"), *LOG_STD_RANGE))

    def decode(self, z: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N X"]:
        """Mean of p(x | z)."""
        for layer in DECODER:
            z = self._affine(z, layer)
            z = np.maximum(z, LEAK * z)
        return self._affine(z, "output")


def layer_shapes(input_size: int, hidden: tuple[int, int], latent_size: int) -> dict[str, tuple[int, ...]]:
    """Shape of every weight and bias of a VAE with the given sizes, by name."""
    first, second = hidden
    sizes = {
        "encoder.0": (first, input_size), "encoder.1": (second, first),
        "posterior_mean": (latent_size, second), "posterior_log_std": (latent_size, second),
        "decoder.0": (second, latent_size), "decoder.1": (first, second), "output": (input_size, first),
    }  # fmt: skip
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, (rows, columns) in sizes.items():
        shapes[f"{layer}.weight"] = (rows, columns)
        shapes[f"{layer}.bias"] = (rows,)
    return shapes


def make_vae(
    tensors: Mapping[str, np.ndarray], input_size: int, hidden: tuple[int, int], latent_size: int, where: str
) -> VAE:
    """A VAE from named tensors, each checked; an error names the tensor, its shape and the expected one."""
    return VAE(checked_tensors(tensors, layer_shapes(input_size, hidden, latent_size), where))


def checked_tensors(
    tensors: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], where: str
) -> dict[str, np.ndarray]:
    """The tensors of the given names, read-only and in double precision.

    Raises:
        UserError: if one is missing, has another shape than the given one, or values that are not finite.
    """
    checked = {}
    for name, shape in shapes.items():
        if name not in tensors:
            raise UserError(f"{where}: tensor '{name}' is missing")
        tensor = np.array(tensors[name], dtype=np.float64)
        if tensor.shape != shape:
            raise UserError(f"{where}: tensor '{name}' has shape {tensor.shape}, expected {shape}")
        if not np.isfinite(tensor).all():
            raise UserError(f"{where}: tensor '{name}' has values that are not finite")
        tensor.flags.writeable = False
        checked[name] = tensor
    return checked
