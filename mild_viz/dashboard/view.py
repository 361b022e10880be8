"""What a person can choose about the picture. A change here never reruns the pipeline."""

from __future__ import annotations

from dataclasses import dataclass

from mild_viz.errors import UserError
from mild_viz.settings import ALPHA_MODES, CONTROLLERS, choose
from mild_viz.simulation.compare import SCENARIOS, STIFFNESSES


@dataclass(frozen=True)
class ComplianceSettings:
    """What is shown of the simulation of how the arm gives way (`mild_viz.simulation`)."""

    scenario: str = "commanded"
    """One of `SCENARIOS`."""
    stiffness: str = "schedule"
    """Which arm is drawn, one of `STIFFNESSES`."""

    def __post_init__(self) -> None:
        choose("scenario", self.scenario, SCENARIOS)
        choose("stiffness", self.stiffness, STIFFNESSES)


@dataclass(frozen=True)
class ViewSettings:
    """How one rollout is drawn."""

    alpha_mode: str = "human"
    """Which forward variable sets the opacity of the ellipsoids, one of `ALPHA_MODES`."""
    latent_axes: tuple[int, int, int] | str = "pca"
    """Latent dimensions on the three axes, or 'pca': the principal components of all trajectories."""
    sigma: float = 2.0
    """Radius of the ellipsoids in standard deviations. In five dimensions one deviation holds 4 % of a Gaussian's
    mass, two hold 45 %: with the smaller, the current point would mostly lie outside its state."""
    ghost: bool = True
    """Draw the decoded motion, before inverse kinematics, as a translucent arm."""
    show_reach: bool = False
    """Draw where the robot's hand can be."""
    compared: tuple[str, ...] = ()
    """Controllers that are run too, and drawn as ghosts beside the commanded arm."""
    compliance: ComplianceSettings | None = None
    """None: nothing is simulated."""
    show_human: bool = True
    show_giver: bool = True
    """Draw the recorded giver of a handover, faint, in the robot's place."""
    show_robot: bool = True
    show_latent: bool = True
    dark: bool = False

    def __post_init__(self) -> None:
        choose("alpha mode", self.alpha_mode, ALPHA_MODES)
        for name in self.compared:
            choose("compared controller", name, CONTROLLERS)
        if not 0.0 < self.sigma < float("inf"):
            raise UserError(f"sigma is {self.sigma}; valid: a finite number above 0")
        axes = self.latent_axes
        if axes == "pca":
            return
        if isinstance(axes, str) or len(axes) != 3 or len(set(axes)) != 3 or min(axes) < 0:
            raise UserError(f"latent axes are {axes!r}; valid: 'pca' or three different dimensions")
