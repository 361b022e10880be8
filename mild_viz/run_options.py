"""What the commands `rollout`, `record` and `live` run, and how the options of any command are documented."""

from __future__ import annotations

import inspect
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from mild_viz import paths
from mild_viz.errors import UserError

if TYPE_CHECKING:
    from mild_viz.checkpoint import Checkpoint
    from mild_viz.robot.model import RobotModel
    from mild_viz.rollout import Rollout
    from mild_viz.settings import ControlSettings

# Written out so that --help lists them and a shell completes them; a test holds them equal to the tables.
VariantName = Literal["v1", "v2.1", "v2.2", "v3.1", "v3.2", "v4"]
ControllerName = Literal["base-ik", "mild", "mild-ik", "task-space"]
OtherArmName = Literal["rest", "base-ik", "mild", "mild-ik"]
SplitName = Literal["train", "test"]
SourceName = Literal["own", "robot_descriptions"]

# Options whose default depends on others: their text says what it is, so that no "{None}" and "default: None" is shown.
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalPaths = Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="PATH [PATH ...]", help_behavior_hint="")]
OptionalNames = Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
OptionalVariant = Annotated[
    VariantName | None, tyro.conf.arg(metavar="{v1,v2.1,v2.2,v3.1,v3.2,v4}", help_behavior_hint="")
]
OptionalController = Annotated[
    ControllerName | None, tyro.conf.arg(metavar="{base-ik,mild,mild-ik,task-space}", help_behavior_hint="")
]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
OptionalStates = Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="INT [INT ...]", help_behavior_hint="")]
OptionalPosition = Annotated[
    tuple[float, float, float] | None, tyro.conf.arg(metavar="FLOAT FLOAT FLOAT", help_behavior_hint="")
]

T = TypeVar("T")


def documented(command: T) -> T:
    """Join the broken lines of each option's description: tyro would print the breaks of the source."""
    command.__doc__ = re.sub(r"\n {8,}", " ", inspect.cleandoc(command.__doc__ or ""))
    return command


def leave(status: int | None) -> None:
    """End the program with a status that is not 0."""
    if status:
        raise SystemExit(status)


def check_output(path: Path, suffix: str) -> None:
    """Refuse a file that cannot be written before the work is done, not after."""
    if path.suffix.lower() != suffix:
        raise UserError(f"{path}: the name must end in {suffix}")
    if path.is_dir():
        raise UserError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise UserError(f"{path} cannot be written: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK):
        raise UserError(f"{path} cannot be written: the folder {path.parent} is read-only")


@documented
@dataclass(frozen=True)
class ModelOptions:
    """What to run: model, robot and controller.

    Attributes:
        checkpoint: Folder of a trained model. Default: the shipped model of the dataset.
        variant: Variant of MILD. Default: v3.1, or the first one of a model without it. Example: --variant v2.1
        controller: What makes the command: mild (decoded joints), mild-ik (decoded joints, adapted by inverse
            kinematics in contact states) or base-ik (inverse kinematics to the hand at every frame, without the
            model); for a model of two hands task-space (inverse kinematics of both arms to the decoded hands).
            Default: mild-ik, or task-space. Example: --controller mild
        other_arm: What the robot's other arm does: rest, mild (the decoded joints, mirrored), base-ik (it follows the
            human's left hand, where that was recorded) or mild-ik (both). Example: --other-arm mild
        contact_states: States of the HMM in which the partners touch. Default: the model's own, as saved from
            the dashboard. Example: --contact-states 2 3
        lambda_x: Weight of reaching the hand [1/m^2], 0 or more. Example: --lambda-x 2
        lambda_q: Weight of staying at the decoded joints [1/rad^2], 0 or more. Example: --lambda-q 0.1
        smoothing: Weight of the new command in the moving average, above 0 and up to 1 (1: no smoothing).
            Example: --smoothing 1
        stiffness: Lower the joints' stiffness in the contact states of a handshake.
        placement: Where the human stands, seen from the robot: distance, lateral, height [m]. Default: the
            recording's where it has one world frame, else the model's estimate. Example: --placement 0.9 0.0
            0.8
        robot: Robot to control: pepper, panda, yumi, kobo, a folder with a robot.toml, or the path of a URDF file. A
            model of a second human (nuisi-human, handover-human) moves any of them. Default: the robot that the model
            was trained for, or that of its dataset. Example: --robot ~/pepper.urdf
        robot_source: Where the robot's looks come from: own, or robot_descriptions, the Python package that downloads
            the manufacturer's meshes (needs: pip install 'mild-viz[robots]'). Without network ours are shown.
            Example: --robot-source robot_descriptions
    """

    checkpoint: OptionalPath = None
    variant: OptionalVariant = None
    controller: OptionalController = None
    other_arm: OtherArmName = "rest"
    contact_states: OptionalStates = None
    lambda_x: float = 1.0
    lambda_q: float = 0.01
    smoothing: float = 0.8
    stiffness: bool = True
    placement: OptionalPosition = None
    robot: OptionalText = None
    robot_source: SourceName = "own"

    def settings(self, checkpoint: Checkpoint) -> ControlSettings:
        """The settings of the controller, where none is chosen the default one for what the model decodes."""
        from mild_viz.settings import CONTROLLERS_OF, ControlSettings, Placement

        return ControlSettings(
            controller=self.controller or CONTROLLERS_OF[checkpoint.decodes][-1],
            other_arm=self.other_arm,
            lambda_x=self.lambda_x,
            lambda_q=self.lambda_q,
            contact_states=None if self.contact_states is None else frozenset(self.contact_states),
            stiffness=self.stiffness,
            smoothing=self.smoothing,
            placement=None if self.placement is None else Placement(*self.placement),
        )

    def load(self, dataset: str) -> tuple[Checkpoint, RobotModel]:
        """The model, by default the one that ships for a dataset, and its robot, or the chosen one."""
        from mild_viz.checkpoint import load_checkpoint
        from mild_viz.decoding import open_robot

        checkpoint = load_checkpoint(self.checkpoint or paths.default_checkpoint(dataset))
        return checkpoint, open_robot(checkpoint, self.robot, self.robot_source)


@documented
@dataclass(frozen=True)
class RunOptions(ModelOptions):
    """What to run the pipeline on: model, trial and controller.

    Attributes:
        dataset: Recordings: demo, nuisi, yumi, handover, handover-hands, bimanual, buetepage. Example: --dataset nuisi
        split: Part of the dataset. Example: --split train
        trial: Trial of the split, from 0. Example: --trial 3
    """

    dataset: str = "demo"
    split: SplitName = "test"
    trial: int = 0

    def run(self) -> tuple[Rollout, RobotModel]:
        """Load model, trial and robot, and run the pipeline. Raises UserError."""
        from mild_viz.data.load import load_dataset
        from mild_viz.pipeline import control, infer

        trial = load_dataset(self.dataset).trial(self.split, self.trial)
        checkpoint, robot = self.load(self.dataset)
        inference = infer(checkpoint, trial, self.variant or checkpoint.default_variant, robot)
        return control(inference, checkpoint, robot, trial, self.settings(checkpoint)), robot
