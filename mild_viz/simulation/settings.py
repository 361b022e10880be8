"""What the simulation assumes: the joints' stiffness, the human's hand. All are choices; here is why."""

from __future__ import annotations

from dataclasses import dataclass, fields

from mild_viz.errors import UserError


def _check(record: object, positive: tuple[str, ...]) -> None:
    """`UserError` naming the first field that is no number in its range."""
    for field in fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, field.name)
        if isinstance(value, bool):
            continue
        above = value > 0.0 if field.name in positive else value >= 0.0
        if not (above and value < float("inf")):
            least = "above 0" if field.name in positive else "of 0 or more"
            raise UserError(f"simulation: {field.name} is {value}; valid: a finite number {least}")


@dataclass(frozen=True)
class Impedance:
    """How the joints hold on to their command: torque = s K (command - angle) + D (its velocity - velocity) + weight.

    s is the scheduled stiffness (0 to 1), K the full stiffness, D the damping; the sum never exceeds the effort.
    """

    saturation: float = 0.1
    """Deviation at which a joint of full stiffness gives its whole effort [rad]: K = effort / saturation.

    No stiffness of Pepper is published. 0.1 rad gives 54 N m/rad in the strong joints and 27 in the weak ones: 430 N/m
    at the straight arm's hand, about a person's arm; natural frequencies of 4.4 and 3.1 Hz of the straight arm about
    the shoulder; and 2.3 degrees of sag there, if deviation alone carried its weight (no gravity compensation).
    """
    damping_ratio: float = 1.0
    """D = 2 ratio sqrt(s K M), M being the joint's inertia in its posture: 1 is critical, so that nothing swings."""
    gravity_compensation: bool = True
    """Whether the motors carry the arm's weight, so that lowering the stiffness does not lower the arm."""
    timestep: float = 0.001
    """Longest step of the simulation [s]; a frame is a whole number of steps."""

    def __post_init__(self) -> None:
        _check(self, ("saturation", "timestep"))


@dataclass(frozen=True)
class HumanHand:
    """A person's hand that holds the robot's: a point that follows the recorded wrist, behind a spring and a damper.

    Spring and damper stand for the whole arm behind the hand; the recorded wrist is where that arm wants to be.
    """

    stiffness: float = 300.0
    """Of the arm, felt at the hand [N/m]. Measured arms have some tens to some hundreds of N/m, by posture and
    direction (Mussa-Ivaldi, Hogan and Bizzi 1985, J. Neurosci. 5:2732; in movement, Gomi and Kawato 1997, Biol.
    Cybern. 76:163): one round value of that order, the same in all directions."""
    damping: float = 20.0
    """Of the arm, felt at the hand [N s/m]: about 0.5 of critical for a hand and forearm of 1.5 kg."""
    grasp_distance: float = 0.05
    """The hands take hold of each other when they are commanded this near [m], or else where they come nearest."""
    grip_time: float = 0.1
    """The grip closes, and opens, within this time [s], so that no force jumps."""
    patience: float = 0.5
    """A grip outlasts shorter gaps of contact [s]: hands do not let go because a segmentation wavers."""

    def __post_init__(self) -> None:
        _check(self, ("stiffness",))
