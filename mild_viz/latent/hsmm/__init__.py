"""The hidden semi-Markov model: states that last for explicit durations."""

from mild_viz.latent.hsmm.model import HSMM, check_hsmm

__all__ = ["HSMM", "check_hsmm"]
