"""What a person can choose: the variant table and the frozen settings of a rerun."""

from __future__ import annotations

from dataclasses import dataclass, field

from mild_viz.errors import UserError

WINDOW = 5
"""Observations in one window (Sec. V-B of the paper)."""

POINT_FEATURES = 6
"""Features of one point of a person in one frame: position and velocity."""

ARM_FEATURES = 3 * POINT_FEATURES
"""Those of an arm: shoulder, elbow, wrist."""

STATE_COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#8C8C8C")
"""Colour of each HMM state, after Okabe and Ito (safe for colour-blind readers)."""


@dataclass(frozen=True)
class Variant:
    """One row of the paper's Table 'Differences in conditioning and sampling strategies'; v4 is ours."""

    name: str
    conditional_training: str
    """What the robot decoder is trained on besides posterior samples: 'none', 'posterior-samples'
    (conditioned means of samples of the human posterior), 'conditional-samples' (samples of Eq. pz2z1) or 'joint'
    (human, HMM and robot together, on the conditional given the filtered forward variable and a short history)."""
    posterior_covariance: bool
    """Whether the human posterior's covariance enters the gain (Eq. conditioning-withcov-K-i)."""
    summary: str

    @property
    def own_models(self) -> bool:
        """Whether it has human VAEs and HMMs of its own, several of them; the others share one human side."""
        return self.conditional_training == "joint"


VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant("v1", "none", False, "HMM prior only, no conditional training"),
        Variant("v2.1", "posterior-samples", False, "decodes conditioned posterior samples"),
        Variant("v2.2", "posterior-samples", True, "as v2.1, with the posterior covariance"),
        Variant("v3.1", "conditional-samples", False, "decodes samples of the conditional"),
        Variant("v3.2", "conditional-samples", True, "as v3.1, with the posterior covariance"),
        Variant("v4", "joint", False, "trained jointly, conditioned on a short history, averaged over several models"),
    )
}

PAPER_VARIANTS = tuple(name for name, variant in VARIANTS.items() if not variant.own_models)
"""Those of the paper: one frozen human side, on which they train."""

MAX_PLACEMENT = 100
"""A human stands nearer than this to the robot, in each direction [m]."""

ALPHA_MODES = ("human", "joint", "unobserved")
CONTROLLERS = ("base-ik", "mild", "mild-ik", "task-space")
"""What makes a command: inverse kinematics to the human's hand, the decoded joints, those adapted by inverse kinematics
in contact, or inverse kinematics of all arms to the decoded hands."""

CONTROLLERS_OF = {
    "joints": ("base-ik", "mild", "mild-ik"),
    "arm": ("base-ik", "mild", "mild-ik"),
    "hands": ("task-space",),
}
"""Those that a model can have, by what it decodes of the partner (`Checkpoint.decodes`); the last is the default."""

OTHER_ARM = ("rest", "base-ik", "mild", "mild-ik")
"""What a robot's other arms do; see `pipeline.control`. In task space the model says."""


def choose(kind: str, value: str, valid: tuple[str, ...] | list[str]) -> str:
    """Return `value` if it is valid, else raise an error that lists what would be."""
    if value not in valid:
        raise UserError(f"{kind} '{value}' is unknown; valid: {', '.join(valid)}")
    return value


@dataclass(frozen=True)
class Placement:
    """Where the human stands seen from the robot: the human frame's origin from the robot's shoulder [m].

    The shoulder is the first controlled joint, so that descriptions with another base give the same place.
    The human faces the robot (yaw of pi about z) unless the recording says otherwise. `source` says in words
    where the numbers come from.
    """

    distance: float
    lateral: float
    height: float
    source: str = "chosen"
    estimated: bool = False

    def __post_init__(self) -> None:
        for name in ("distance", "lateral", "height"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < MAX_PLACEMENT:
                raise UserError(
                    f"placement: {name} is {value!r}; valid: a number of metres between -{MAX_PLACEMENT} "
                    f"and {MAX_PLACEMENT}"
                )


@dataclass(frozen=True)
class InferSettings:
    """What decides the inference: model, variant and trial. A change here reruns everything."""

    dataset: str = "demo"
    split: str = "test"
    trial: int = 0
    variant: str = "v3.1"

    def __post_init__(self) -> None:
        choose("variant", self.variant, list(VARIANTS))


@dataclass(frozen=True)
class Watch:
    """When an observation of the human is no longer one to go by, and when the human is gone."""

    max_age: float = 0.25
    """The robot stops where it is when the human was last seen longer ago than this [s]. A hand at 2 m/s is then
    somewhere else by half a metre."""
    max_speed: float = 15.0
    """A hand that moved faster than this between two observations has jumped [m/s]: more than anyone greets with, and
    more than the 14.4 m/s between two frames that the tracking noise of NuiSI makes of 4 m/s."""
    gone_after: float = 1.5
    """The robot returns to rest when the human was last seen longer ago than this [s]: longer than trackers lose
    someone who is still there."""

    def __post_init__(self) -> None:
        for name in ("max_age", "max_speed", "gone_after"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise UserError(f"{name} is {getattr(self, name)}; valid: a finite number above 0")
        if self.gone_after < self.max_age:
            raise UserError(f"gone_after is {self.gone_after}; valid: max_age, {self.max_age}, or more")


@dataclass(frozen=True)
class ControlSettings:
    """What decides the command that is sent to the robot. A change here reruns only `control`."""

    controller: str = "mild-ik"
    lambda_x: float = 1.0
    """Weight of reaching the target (Eq. ik-prior-simplified)."""
    lambda_q: float = 0.01
    """Weight of staying at the decoded joints (Eq. ik-prior-simplified)."""
    contact_states: frozenset[int] | None = None
    """HMM states in which the partners touch, for the trial's action; None: the checkpoint's own."""
    stiffness: bool = True
    """Lower the stiffness in contact (handshake)."""
    smoothing: float = 0.8
    """Weight of the new command in the moving average; 1 switches it off."""
    placement: Placement | None = None
    """None: the checkpoint's own, or the recording's where it has one world frame."""
    other_arm: str = "rest"
    """What the arms do that do not interact, one of `OTHER_ARM`: `mild` mirrors the decoded joints, `base-ik` follows
    the human's left hand, `mild-ik` does both."""
    watch: Watch = Watch()
    """What the safety filter expects of the observations."""

    def __post_init__(self) -> None:
        choose("controller", self.controller, CONTROLLERS)
        choose("other_arm", self.other_arm, OTHER_ARM)
        for name in ("lambda_x", "lambda_q"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise UserError(f"{name} is {getattr(self, name)}; valid: a finite number of 0 or more")
        if not 0.0 < self.smoothing <= 1.0:
            raise UserError(f"smoothing is {self.smoothing}; valid: above 0, up to 1")


@dataclass(frozen=True)
class Settings:
    """Everything that the pipeline needs to know besides the model and the data."""

    infer: InferSettings = field(default_factory=InferSettings)
    control: ControlSettings = field(default_factory=ControlSettings)
