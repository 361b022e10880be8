"""What a controller makes of a trial, in figures by which several can be compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from mild_viz.robot.chain import ArmChain
from mild_viz.rollout import Rollout


@dataclass(frozen=True)
class ControllerFigures:
    """One controller on one trial. Figures of contact are NaN where no frame is in a contact state."""

    controller: str
    n_contact: int
    """Frames in a contact state with the human's hand seen."""
    mean_distance: float
    """Between the hands in contact [m]."""
    smallest_distance: float
    ik_cost: float
    """Eq. ik-prior-simplified, mean over the frames in contact: lambda_x |x - f(q)|^2 + lambda_q |mu_q - q|^2."""
    limit_margin: float
    """Smallest distance of any joint from its limits over the whole trial [rad]."""


def controller_figures(rollout: Rollout, chain: ArmChain, lambda_x: float, lambda_q: float) -> ControllerFigures:
    """The figures of one rollout of the arm `chain`."""
    contact: Bool[np.ndarray, " N"] = rollout.contact & np.isfinite(rollout.hand_distance)
    contact &= rollout.inference.tracked
    joints = rollout.joints_commanded
    margin = np.minimum(joints - chain.lower, chain.upper - joints)
    distance = rollout.hand_distance[contact]
    stray = ((joints - rollout.inference.joints_decoded)[contact] ** 2).sum(axis=1)
    n_contact = int(contact.sum())
    cost = lambda_x * distance**2 + lambda_q * stray
    return ControllerFigures(
        controller=rollout.controller,
        n_contact=n_contact,
        mean_distance=float(distance.mean()) if n_contact else float("nan"),
        smallest_distance=float(distance.min()) if n_contact else float("nan"),
        ik_cost=float(cost.mean()) if n_contact else float("nan"),
        limit_margin=float(margin.min()),
    )
