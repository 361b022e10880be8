"""From latent space to the box of the plot: axes, scale, and ellipsoids of the states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mild_viz.dashboard.scene.layout import PLOT_SIZE
from mild_viz.dashboard.scene.shapes import quaternion_from_matrix
from mild_viz.errors import UserError
from mild_viz.rollout import Inference

FLATTEST = 0.35
"""An axis along which little happens is stretched to no more than 1 / FLATTEST of the longest one's scale."""

LARGEST_RADIUS = 0.45 * PLOT_SIZE
"""Ellipsoids are cut off at this half-axis [m]: a state that the data hardly visited may have any size."""

SMALLEST_RADIUS = 0.006


@dataclass(frozen=True, eq=False)
class Projection:
    """box = matrix @ (z - origin): latent vectors to metres about the middle of the plot's box."""

    matrix: Float[np.ndarray, "3 D"]
    origin: Float[np.ndarray, " D"]
    labels: tuple[str, str, str]
    scale: Float[np.ndarray, " 3"]
    """Metres per latent unit along each axis."""
    low: Float[np.ndarray, " 3"]
    """Latent coordinate at the low end of each axis."""

    def points(self, latent: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N 3"]:
        """Positions in the box [m]; NaN stays NaN."""
        return (latent - self.origin) @ self.matrix.T

    def ellipsoids(
        self, means: Float[np.ndarray, "S D"], covariances: Float[np.ndarray, "S D D"], sigma: float
    ) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 4"], Float[np.ndarray, "S 3"]]:
        """Centres [m], orientations (wxyz) and half-axes [m] of the `sigma` surfaces, as the box shows them.

        A linear map takes the Gaussian to one with covariance M S M^T. Centres outside the box are drawn on
        its surface, and half-axes are bounded, so that an outlier never hides the rest.
        """
        half = 0.5 * PLOT_SIZE
        centres = np.clip(self.points(means), -half, half)
        values, vectors = np.linalg.eigh(self.matrix @ covariances @ self.matrix.T)
        vectors[np.linalg.det(vectors) < 0.0, :, 0] *= -1.0
        radii = sigma * np.sqrt(np.maximum(values, 0.0))
        return centres, quaternion_from_matrix(vectors), np.clip(radii, SMALLEST_RADIUS, LARGEST_RADIUS)

    def ticks(self) -> tuple[float, list[Float[np.ndarray, " _"]]]:
        """The spacing of the grid in latent units, and the box coordinates [m] of its lines along each axis."""
        half = 0.5 * PLOT_SIZE
        step = nice_step(PLOT_SIZE / float(self.scale.min()) / 5.0)
        lines = []
        for low, scale in zip(self.low, self.scale, strict=True):
            first, last = np.ceil(low / step), np.floor((low + PLOT_SIZE / scale) / step)
            lines.append((np.arange(first, last + 1.0) * step - low) * scale - half)
        return step, lines


def magnified(inference: Inference) -> tuple[Inference, float]:
    """The robot's latents enlarged about their middle until they spread about as far as the human's, and how often.

    The two live in latent spaces of their own, so that their spreads need not agree (in v4 the human's is up to
    fifteen times wider, and the robot would be a dot). A spread of a similar size is left alone.
    """
    human, robot = (
        # The Gaussians count too: enlarged ones must not hide the human's.
        np.sqrt(finite(latent).var(0).sum() + np.trace(covariances, axis1=1, axis2=2).mean())
        for latent, covariances in (
            (inference.human_latent_mean, inference.human_state_covariances),
            (inference.robot_latent_mean, inference.robot_state_covariances),
        )
    )
    ratio = float(human / max(robot, 1e-9))
    factor = min(nice_step(ratio), 100.0) if ratio >= 3.0 else 1.0
    middle = inference.robot_state_means.mean(0)
    names = ("robot_latent_mean", "robot_latent_truth", "robot_state_means")
    changes = {name: middle + factor * (getattr(inference, name) - middle) for name in names}
    covariances = factor**2 * inference.robot_state_covariances
    return (inference if factor == 1.0 else replace(inference, **changes, robot_state_covariances=covariances)), factor


def make_projection(inference: Inference, axes: tuple[int, int, int] | str) -> Projection:
    """Three latent dimensions, or the three principal components, scaled so that everything fits the box.

    The components are those of the human's and the true partner's trajectories and of the states, so that they
    stay put when only the variant changes.
    """
    means = np.concatenate([inference.human_state_means, inference.robot_state_means])
    latent = finite(np.concatenate([inference.human_latent_mean, inference.robot_latent_truth]))
    n_dimensions = means.shape[1]
    if isinstance(axes, str):
        basis, shares = principal_components(np.concatenate([latent, means]))
        labels = tuple(f"PC{i + 1} · {share:.0%}" for i, share in enumerate(shares))
    else:
        if max(axes) >= n_dimensions:
            raise UserError(f"latent dimension {max(axes)} does not exist; valid: 0 to {n_dimensions - 1}")
        basis, labels = np.eye(n_dimensions)[list(axes)], tuple(f"z{axis}" for axis in axes)
    # Each agent by its own quartiles: beside a robot that hardly moves, the human's whole way would be an outlier.
    human = finite(np.concatenate([inference.human_latent_mean, inference.human_state_means]))
    robot = np.concatenate([inference.robot_latent_truth, inference.robot_latent_mean, inference.robot_state_means])
    extents = np.array([extent(points @ basis.T) for points in (human, finite(robot))])
    low, high = extents[:, 0].min(0), extents[:, 1].max(0)
    half = np.maximum(0.5 * (high - low), FLATTEST * 0.5 * float((high - low).max())) * 1.06
    middle = 0.5 * (low + high)
    scale = 0.5 * PLOT_SIZE / half
    origin = np.linalg.pinv(basis) @ middle
    return Projection(basis * scale[:, None], origin, (labels[0], labels[1], labels[2]), scale, middle - half)


def principal_components(
    points: Float[np.ndarray, "N D"],
) -> tuple[Float[np.ndarray, "3 D"], Float[np.ndarray, " 3"]]:
    """The three main directions and their shares of the variance; missing ones are zero."""
    centred = points - points.mean(0)
    _, singular, directions = np.linalg.svd(centred, full_matrices=False)
    count = min(3, len(directions))
    basis, shares = np.zeros((3, points.shape[1])), np.zeros(3)
    basis[:count] = directions[:count]
    shares[:count] = (singular**2 / max(float((singular**2).sum()), 1e-300))[:count]
    # A direction's sign is arbitrary: let its largest entry be positive, so that a rerun does not mirror the plot.
    signs = np.sign(basis[np.arange(3), np.abs(basis).argmax(1)])
    return basis * np.where(signs == 0.0, 1.0, signs)[:, None], shares


def extent(points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Bounds of the bulk of the points: those far beyond the quartiles do not shrink the plot."""
    first, third = np.percentile(points, [25, 75], axis=0)
    reach = 4.0 * np.maximum(third - first, 1e-3)
    inside = np.clip(points, first - reach, third + reach)
    return inside.min(0), inside.max(0)


def finite(points: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "M D"]:
    """The rows without NaN; one row of zeros where there is none."""
    rows = points[np.isfinite(points).all(1)]
    return rows if len(rows) else np.zeros((1, points.shape[1]))


def nice_step(step: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `step`."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * max(m for m in (1.0, 2.0, 5.0) if m * power <= step * (1.0 + 1e-9)))
