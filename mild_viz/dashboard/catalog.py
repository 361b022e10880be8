"""What the page can offer: the datasets that are here, the models that fit them, and their trials."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from mild_viz import paths
from mild_viz.checkpoint import CONFIG, Checkpoint, load_checkpoint
from mild_viz.data.load import DATASETS, data_root, load_dataset, missing_files
from mild_viz.decoding import decoding_of
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.robot.robots import ROBOTS, robot_of
from mild_viz.robot.source import RobotSource
from mild_viz.settings import choose
from mild_viz.trial import Dataset, Trial


class Catalog:
    """Datasets, models and robots by name. Each is read when it is first asked for, and then kept."""

    def __init__(
        self, robot: RobotModel, chosen: Path | None = None, source: RobotSource = "own",
        recorded: Dataset | None = None,
    ) -> None:  # fmt: skip
        known = ROBOTS.get(robot.name)
        # another description of a robot that is known by name has its file for a name
        self.robot_name = robot.name if known is None or known.urdf == robot.spec.urdf else str(robot.spec.urdf)
        """Name on the page of the robot that is shown first."""
        self._robots = {self.robot_name: robot}
        self._checkpoints: dict[Path, Checkpoint] = {}
        self._problems: dict[tuple[str, str, str], str | None] = {}
        self.chosen = None if chosen is None else chosen.resolve()
        self._source: RobotSource = source
        self._recorded = recorded
        """A live session, beside the datasets."""

    @cached_property
    def model_paths(self) -> dict[str, Path]:
        """Folder of each model by its name on the page: those that ship, and the one that was asked for."""
        try:
            shipped = sorted(path.parent for path in paths.checkpoints().glob(f"*/{CONFIG}"))
        except UserError:
            shipped = []
        found = {path.name: path.resolve() for path in shipped}
        if self.chosen is not None and self.chosen not in found.values():
            name = self.chosen.name if self.chosen.name not in found else str(self.chosen)
            found = {name: self.chosen, **found}
        return found

    def name_of(self, path: Path) -> str:
        """The name on the page of the model in a folder."""
        return next(name for name, folder in self.model_paths.items() if folder == path.resolve())

    def present(self) -> tuple[str, ...]:
        """The datasets whose files are here."""
        root = data_root()
        return tuple(name for name in DATASETS if not missing_files(name, root))

    def absent(self) -> tuple[str, ...]:
        """The datasets that would have to be fetched first."""
        present = self.present()
        return tuple(name for name in DATASETS if name not in present)

    @cached_property
    def robot_titles(self) -> dict[str, str]:
        """The robots by their names here, and what they are called on the page."""
        others = {name: spec.title for name, spec in ROBOTS.items() if name != self.robot_name}
        title = self._robots[self.robot_name].title  # its own folder's, which ROBOTS may not know
        return {self.robot_name: f"{title} ({self.robot_name})" if title in others.values() else title, **others}

    def robot(self, name: str) -> RobotModel:
        """The robot of that name."""
        if name not in self._robots:
            self._robots[name] = load_robot(choose("robot", name, list(self.robot_titles)), source=self._source)
        return self._robots[name]

    def dataset(self, name: str) -> Dataset:
        return self._recorded if self._recorded is not None and name == self._recorded.name else load_dataset(name)

    def checkpoint(self, model: str) -> Checkpoint:
        """The model of that name on the page."""
        if model not in self.model_paths:
            raise UserError(f"model '{model}' is unknown; valid: {', '.join(self.model_paths)}")
        path = self.model_paths[model]
        if path not in self._checkpoints:
            self._checkpoints[path] = load_checkpoint(path)
        return self._checkpoints[path]

    def current(self, checkpoint: Checkpoint) -> Checkpoint:
        """The latest state of a checkpoint, with the contact states saved since it was loaded."""
        return self._checkpoints.get(checkpoint.path.resolve(), checkpoint)

    def replace_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Use this one from now on: its default contact states were changed."""
        self._checkpoints[checkpoint.path.resolve()] = checkpoint

    def problem(self, model: str, dataset: str, robot: str) -> str | None:
        """Why a model cannot be used on a dataset with a robot; None if it can."""
        key = (model, dataset, robot)
        if key not in self._problems:
            self._problems[key] = self._find_problem(*key)
        return self._problems[key]

    def _find_problem(self, model: str, dataset: str, robot: str) -> str | None:
        try:
            checkpoint, recordings = self.checkpoint(model), self.dataset(dataset)
            trials = recordings.train + recordings.test
            decoding_of(checkpoint, self.robot(robot), trials[0].rate)
        except UserError as error:
            return str(error)
        if not set(checkpoint.actions) & set(recordings.actions):
            return (
                f"model '{model}' knows {', '.join(checkpoint.actions)}; "
                f"dataset '{dataset}' holds {', '.join(recordings.actions)}"
            )
        if checkpoint.robot is None:
            people = dataset not in DATASETS or any(trial.partner_arm is not None for trial in trials)
            return None if people else f"model '{model}' predicts a second human; dataset '{dataset}' shows none"
        recorded = next((trial for trial in trials if trial.robot_joints is not None), None)
        if recorded is not None and recorded.robot_joint_names != checkpoint.robot.joint_names:
            return (
                f"dataset '{dataset}' recorded the joints {', '.join(recorded.robot_joint_names)}, "
                f"model '{model}' drives {', '.join(checkpoint.robot.joint_names)}"
            )
        return None

    def models(self, dataset: str, robot: str) -> tuple[str, ...]:
        """The models that can be used on a dataset with a robot, those made for it first."""
        fitting = [model for model in self.model_paths if self.problem(model, dataset, robot) is None]
        return tuple(sorted(fitting, key=lambda model: self._rank(model, dataset)))

    def _rank(self, model: str, dataset: str) -> tuple[bool, bool, bool, str]:
        made_for_it = self.checkpoint(model).dataset == dataset
        asked_for = self.model_paths[model] == self.chosen
        return not made_for_it, not asked_for, paths.SHIPPED_MODELS.get(dataset) != model, model

    def offers(self) -> tuple[tuple[str, ...], dict[str, str]]:
        """The datasets that can be shown, and why each other one cannot. Reads them all: this may take seconds."""
        usable, others = [], {name: f"get it with: mild-viz data fetch {name}" for name in self.absent()}
        for name in self.present():
            try:
                self.dataset(name)
            except UserError as error:
                others[name] = str(error)
                continue
            if self.robot_for(name, self.robot_name) is not None:
                usable.append(name)
            else:
                others[name] = "no model here fits it"
        return tuple(usable), others

    def robot_for(self, dataset: str, robot: str) -> str | None:
        """`robot` if a model drives it on this dataset, else the one that the dataset's models are made for, if any."""
        own = [robot_of(dataset)] if dataset in DATASETS else []
        names = dict.fromkeys([robot, *own, *self.robot_titles])
        return next((name for name in names if name in self.robot_titles and self.models(dataset, name)), None)

    def dataset_for(self, robot: str, dataset: str) -> str | None:
        """`dataset` if a model drives this robot on it, else the robot's own, else any that is here; None without."""
        own = [name for name in self.present() if robot_of(name) == robot]
        names = dict.fromkeys([dataset, *own, *self.present()])
        return next((name for name in names if self.models(name, robot)), None)

    def actions(self, model: str, dataset: str) -> tuple[str, ...]:
        """The interactions that both know."""
        known = self.checkpoint(model).actions
        return tuple(action for action in self.dataset(dataset).actions if action in known)

    def trials(self, dataset: str, action: str) -> dict[str, Trial]:
        """The trials of an action by their names on the page, those of the test set first."""
        recordings = self.dataset(dataset)
        return {
            f"{trial.split} {trial.index}": trial
            for trial in recordings.test + recordings.train
            if trial.action == action
        }
