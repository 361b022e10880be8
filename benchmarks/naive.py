"""The reference's way of running MILD, written for comparison: one frame after the other.

PyTorch layers; a new `MultivariateNormal` for every state and frame, in the forward variable as in the conditioning,
as pbdlib builds them; ikpy's bounded optimiser with its regularisation in contact frames. The numbers of the model
are the checkpoint's, so that both ways can be checked against each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
import yourdfpy
from ikpy.chain import Chain
from torch.distributions import MultivariateNormal
from torch.nn import functional

from mild_viz.checkpoint import Checkpoint
from mild_viz.latent.vae import DECODER, ENCODER, LEAK, VAE
from mild_viz.robot.model import RobotModel
from mild_viz.settings import VARIANTS, WINDOW

REGULARISATION = 0.01
"""ikpy's `regularization_parameter` in the reference."""
SMOOTHING = 0.8


class Frame(NamedTuple):
    """What the reference computes for one window."""

    log_alpha: np.ndarray
    decoded: np.ndarray
    commanded: np.ndarray
    contact: bool


class NaiveMild:
    """The model as torch tensors in float64, and the arm as an ikpy chain."""

    def __init__(self, checkpoint: Checkpoint, variant: str, action: str, robot: RobotModel) -> None:
        hmm = checkpoint.hmm(action)
        self.human = {name: torch.tensor(value) for name, value in checkpoint.human_vae.weights.items()}
        vae: VAE = checkpoint.members(variant)[0].robot_vae
        self.robot = {name: torch.tensor(value) for name, value in vae.weights.items()}
        self.size = checkpoint.human_vae.latent_size
        self.initial, self.transition = torch.tensor(hmm.initial_probs), torch.tensor(hmm.transition_matrix)
        self.means, self.covariances = torch.tensor(hmm.emission_means), torch.tensor(hmm.emission_covariances)
        self.with_covariance = VARIANTS[variant].posterior_covariance
        self.n_joints = len(robot.chain.joint_names)
        self.chain, self.columns = ikpy_chain(robot)

    def frames(self, windows: np.ndarray, targets: np.ndarray, contact_states: frozenset[int]) -> Iterator[Frame]:
        """One `Frame` for each human window (N, 90) and target in the robot's base frame (N, 3)."""
        log_alpha, previous = None, None
        for window, target in zip(windows, targets, strict=True):
            with torch.no_grad():
                mean, std = self._encode(torch.from_numpy(window))
                log_alpha = self._filter(mean, log_alpha)
                latent = self._condition(mean, std, log_alpha)
                decoded = self._decode(latent)[: self.n_joints].numpy()
            contact = int(log_alpha.argmax()) in contact_states
            joints = self.inverse_kinematics(target, decoded) if contact else decoded
            previous = joints if previous is None else SMOOTHING * joints + (1 - SMOOTHING) * previous
            yield Frame(log_alpha.numpy(), decoded, previous, contact)

    def inverse_kinematics(self, target: np.ndarray, prior: np.ndarray) -> np.ndarray:
        start = np.zeros(len(self.chain.links))
        start[self.columns] = prior
        found = self.chain.inverse_kinematics(target, initial_position=start, regularization_parameter=REGULARISATION)
        return np.asarray(found)[self.columns]

    def forward_kinematics(self, joints: np.ndarray) -> np.ndarray:
        angles = np.zeros(len(self.chain.links))
        angles[self.columns] = joints
        return np.asarray(self.chain.forward_kinematics(list(angles)))[:3, 3]

    def _encode(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        for layer in ENCODER:
            x = functional.leaky_relu(self._affine(self.human, x, layer), LEAK)
        return self._affine(self.human, x, "posterior_mean"), self._affine(self.human, x, "posterior_log_std").exp()

    def _decode(self, z: torch.Tensor) -> torch.Tensor:
        for layer in DECODER:
            z = functional.leaky_relu(self._affine(self.robot, z, layer), LEAK)
        return self._affine(self.robot, z, "output")

    @staticmethod
    def _affine(weights: dict[str, torch.Tensor], x: torch.Tensor, layer: str) -> torch.Tensor:
        return functional.linear(x, weights[f"{layer}.weight"], weights[f"{layer}.bias"])

    def _filter(self, z: torch.Tensor, previous: torch.Tensor | None) -> torch.Tensor:
        size = self.size
        predicted = self.initial if previous is None else previous.exp() @ self.transition
        likelihood = torch.stack(
            [
                MultivariateNormal(mean[:size], covariance[:size, :size]).log_prob(z)
                for mean, covariance in zip(self.means, self.covariances, strict=True)
            ]
        )
        log_alpha = predicted.log() + likelihood
        return log_alpha - torch.logsumexp(log_alpha, 0)

    def _condition(self, z: torch.Tensor, std: torch.Tensor, log_alpha: torch.Tensor) -> torch.Tensor:
        size = self.size
        means, covariances = [], []
        for mean, covariance in zip(self.means, self.covariances, strict=True):
            observed = covariance[:size, :size] + (torch.diag(std**2) if self.with_covariance else 0.0)
            gain = covariance[size:, :size] @ torch.linalg.inv(observed)
            conditional = MultivariateNormal(
                mean[size:] + gain @ (z - mean[:size]),
                covariance[size:, size:] - gain @ covariance[:size, size:],
            )
            means.append(conditional.mean)
            covariances.append(conditional.covariance_matrix)
        weights = log_alpha.exp()
        mixed = (weights[:, None] * torch.stack(means)).sum(0)
        second = sum(
            weight * (covariance + torch.outer(mean, mean))
            for weight, mean, covariance in zip(weights, means, covariances, strict=True)
        )
        return MultivariateNormal(mixed, second - torch.outer(mixed, mixed)).mean


def ikpy_chain(robot: RobotModel) -> tuple[Chain, list[int]]:
    """The arm of a robot for ikpy, with only the controlled joints active, and where these are among its links."""
    urdf = yourdfpy.URDF.load(str(robot.urdf), build_scene_graph=False, load_meshes=False)
    parents = {joint.child: joint for joint in urdf.robot.joints}
    link, path = robot.chain.end_effector, [robot.chain.end_effector]
    while link in parents:
        link = parents[link].parent
        path = [link, parents[path[0]].name, *path]
    joints = path[1::2]
    active = [False, *(name in robot.chain.joint_names for name in joints)]
    chain = Chain.from_urdf_file(str(robot.urdf), base_elements=path, active_links_mask=active)
    return chain, [1 + joints.index(name) for name in robot.chain.joint_names]


def windows_of_frames(features: np.ndarray) -> np.ndarray:
    """Human windows, one after the other as the reference cuts them: (T, 18) -> (T - 4, 90)."""
    return np.stack([features[n : n + WINDOW].reshape(-1) for n in range(len(features) - WINDOW + 1)])
