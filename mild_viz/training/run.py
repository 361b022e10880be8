"""One training run from recordings to a checkpoint folder: what `mild-viz train` does."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from mild_viz.checkpoint import Checkpoint, RobotInterface, check_checkpoint_target, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows, stack_windows
from mild_viz.robot.control.rules import DEFAULT_RULES
from mild_viz.robot.robots import ROBOTS, robot_of
from mild_viz.settings import VARIANTS
from mild_viz.training.human_stage import HumanModel, train_human_stage
from mild_viz.training.joint_stage import train_joint_stage
from mild_viz.training.options import TrainingOptions, stage_variants
from mild_viz.training.outcome import Candidate, Made, save_best
from mild_viz.training.progress import HeldOut, shown
from mild_viz.training.recordings import check_trial, training_windows
from mild_viz.training.robot_stage import train_robot_stage
from mild_viz.training.state import RunState
from mild_viz.trial import ARM_POINTS, Dataset, Trial


def hold_out(trials: Sequence[Trial], n_held: int, fold: int = -1) -> tuple[list[Trial], list[Trial]]:
    """Split training trials into those to fit and `n_held` of every action, to choose a seed by.

    Held out are trial `fold` of the action (negative: from the last one on) and those before it, going round. An
    action with fewer than three trials keeps all of them.
    """
    held: set[int] = set()
    for action in dict.fromkeys(trial.action for trial in trials):
        of_action = [i for i, trial in enumerate(trials) if trial.action == action]
        if n_held and len(of_action) >= n_held + 2:
            held.update(of_action[(fold - k) % len(of_action)] for k in range(n_held))
    fit = [trial for i, trial in enumerate(trials) if i not in held]
    return fit, [trials[i] for i in sorted(held)]


@dataclass(frozen=True, eq=False)
class Plan:
    """What a run trains, on what: everything checked before anything is trained."""

    source: Dataset
    stage: str
    variants: tuple[str, ...]
    options: TrainingOptions
    robot: RobotInterface | None
    """None: the partner is the second human (stage hhi)."""
    fit: list[Trial]
    held: list[Trial]
    init: Checkpoint | None
    paired: Windows
    """Human windows with the partner's, of the trials to fit."""
    human: Windows
    """What the human stage learns from: windows of two humans where there are two, else the same."""
    joint: Windows
    """What v4 learns from: held-out trials, too, unless they are to be kept from it."""

    @property
    def rate(self) -> float:
        """Frames a second of the recordings [Hz]."""
        return self.source.train[0].rate

    @property
    def recorded_robot(self) -> bool:
        """Whether the partner is a robot throughout, without a second human to learn from first."""
        return self.source.train[0].partner_arm is None

    @property
    def joints(self) -> tuple[str, ...] | None:
        """The partner's columns: a robot's joints, or a second human's."""
        return None if self.robot is None else self.robot.joint_names

    @property
    def shared_variants(self) -> tuple[str, ...]:
        """Those that train on one frozen human side."""
        return tuple(name for name in self.variants if not VARIANTS[name].own_models)


def robot_interface(dataset: str) -> RobotInterface:
    """The robot that models of a dataset drive: the recorded one, or the one that its second human is retargeted to."""
    name = robot_of(dataset)
    return RobotInterface(name, ROBOTS[name].joint_names, ROBOTS[name].end_effector)


def plan_run(
    dataset: str, stage: str, variants: Sequence[str], options: TrainingOptions, init: Path | None = None
) -> Plan:
    """Read the recordings and check that they can be trained on.

    Raises:
        UserError: on an unknown name, recordings that lack what the stage needs or that differ among themselves, or an
            `init` of other sizes.
    """
    variants = stage_variants(stage, variants)
    if options.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device 'cuda' is not here: torch finds no GPU that it can use; valid here: cpu")
    source = load_dataset(dataset)
    for trial in source.train + source.test:
        check_trial(trial)
    known = {trial.action for trial in source.train}
    if not any(trial.action in known for trial in source.test):
        raise UserError(f"dataset '{dataset}' has no test trial of {', '.join(sorted(known))}; expected one or more")
    rates = sorted({trial.rate for trial in source.train + source.test})
    if len(rates) > 1:
        raise UserError(f"dataset '{dataset}' has trials of different rates: {rates} Hz; expected one rate")
    first = source.train[0]
    if stage == "hri" and first.points != ARM_POINTS:
        raise UserError(
            f"dataset '{dataset}' gives {', '.join(first.points)}, which a robot follows without a decoder of its own; "
            "valid for it: --stage hhi"
        )
    if stage == "hhi" and first.partner_points is None:
        raise UserError(f"dataset '{dataset}' has no second human; valid for it: --stage hri")
    robot = None
    if stage == "hri":
        robot = robot_interface(dataset)
    start = None if init is None else load_checkpoint(init)
    if start is not None:
        for name in ("hidden", "latent_size"):
            found = start.hidden if name == "hidden" else start.human_vae.latent_size
            if found != getattr(options, name):
                raise UserError(f"{init}: {name} is {found}, this run has {getattr(options, name)}; they must be equal")
    fit, held = hold_out(source.train, options.held_out, options.fold)
    joints = None if robot is None else robot.joint_names
    paired = human = joint = training_windows(fit, joints)
    if robot is not None and source.train[0].partner_arm is not None:
        human = training_windows(fit, None)
    if held and any(VARIANTS[name].own_models for name in variants) and not options.joint_held_out:
        joint = training_windows(source.train, joints)
    return Plan(source, stage, variants, options, robot, fit, held, start, paired, human, joint)


def train(
    dataset: str,
    stage: str = "hri",
    variants: Sequence[str] = tuple(VARIANTS),
    options: TrainingOptions | None = None,
    out: Path = Path("runs/model"),
    resume: bool | None = False,
    init: Path | None = None,
    tensorboard: Path | None = None,
    command: str | None = None,
    quiet: bool = False,
) -> Checkpoint:
    """Train a model and write its folder; the stages' state lives beside it until the folder is written.

    `init`: the folder of a checkpoint to go on from (fine-tuning). `command` is recorded as what made the model.
    `resume` None: go on if there is something to go on with. `quiet`: no progress bars, no word on Ctrl-C.

    Raises:
        UserError: on anything given that cannot be used, a run that cannot be resumed, or a folder that holds
            something else.
    """
    check_checkpoint_target(out)
    plan = plan_run(dataset, stage, variants, options or TrainingOptions(), init)
    unseen = [name for name in plan.source.actions if all(trial.action != name for trial in plan.source.train)]
    if unseen and not quiet:
        print(f"note: no training trial shows {', '.join(unseen)}: the model will not know it", file=sys.stderr)
    if plan.init is not None and plan.init.rate not in (None, plan.rate) and not quiet:
        print(
            f"note: {init} was trained at {plan.init.rate:g} Hz, these recordings have {plan.rate:g} Hz: velocities "
            "have another scale",
            file=sys.stderr,
        )
    command = command or shlex.join(["mild-viz", "train", "--dataset", dataset, "--stage", stage, "--out", str(out)])
    description = {
        "dataset": dataset,
        "checksum": plan.source.checksum,
        "stage": stage,
        "variants": list(plan.variants),
        "init": None if init is None else str(init),
    }
    started = time.monotonic()
    try:
        with RunState(out, description, plan.options, resume) as state:
            candidates = _train_stages(plan, state, out, quiet, tensorboard)
            made = Made(command, description, round(time.monotonic() - started, 1))
            saved = save_best(candidates, plan, made, out)
            state.finish()
            return saved
    except KeyboardInterrupt:
        if not quiet:
            print(f"interrupted; what is done is kept. Go on with:\n  {command} --resume", file=sys.stderr)
        raise


def _train_stages(plan: Plan, state: RunState, out: Path, quiet: bool, tensorboard: Path | None) -> list[Candidate]:
    """All stages of a plan with a progress bar each. Returns one candidate a seed."""
    options, human_human = plan.options, plan.robot is None
    own = [name for name in plan.variants if VARIANTS[name].own_models]
    held = held_human = None
    if plan.held:
        held = HeldOut(stack_windows(plan.held, plan.joints), human_human, plan.rate)
        shared = plan.human is plan.paired
        held_human = held if shared else HeldOut(stack_windows(plan.held, None), True, plan.rate)
    stages = {"human": options.human_epochs}
    if plan.robot is not None and plan.shared_variants:
        stages["robot"] = options.robot_epochs
    if own:
        stages["joint"] = options.joint_epochs
    # One thread: two are slower than one for networks of this size.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with shown(stages, quiet, tensorboard) as progress:
            humans = train_human_stage(
                plan.human, options, progress, state, not plan.recorded_robot, plan.init, held_human
            )
            robots: list[dict[str, VAE]] = [{} for _ in humans]
            if "robot" in stages:
                robots = train_robot_stage(
                    plan.paired, humans, plan.shared_variants, options, progress, state, plan.init, held
                )
            joint: list[list[InteractionModel]] = [[] for _ in humans]
            if own:
                watched = held if options.joint_held_out else None
                joint = train_joint_stage(plan.joint, plan.rate, options, progress, state, plan.init, watched)
    finally:
        torch.set_num_threads(threads)
    return [
        Candidate(_candidate(plan, out, human, robot, {own[0]: tuple(models)} if own else {}), human.as_interaction())
        for human, robot, models in zip(humans, robots, joint, strict=True)
    ]


def _candidate(
    plan: Plan,
    out: Path,
    human: HumanModel,
    robot_vaes: dict[str, VAE],
    own_models: dict[str, tuple[InteractionModel, ...]],
) -> Checkpoint:
    return Checkpoint(
        path=out,
        name=out.name,
        dataset=plan.source.name,
        dataset_checksum=plan.source.checksum,
        human_vae=human.vae,
        hmms=human.hmms,
        robot_vaes=robot_vaes,
        robot=plan.robot,
        own_models=own_models,
        points=plan.source.train[0].points,
        rate=plan.rate,
        contact_rules={action: DEFAULT_RULES[action] for action in human.hmms},
        hidden=plan.options.hidden,
    )
