"""The robots that are known by name: the folders below `assets/urdf`. Any other is given by its folder or its URDF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mild_viz.errors import UserError
from mild_viz.paths import assets
from mild_viz.robot.spec import SPEC, RobotSpec, read_spec


def shipped_robots() -> dict[str, RobotSpec]:
    """The robots that ship, by the names of their folders; Pepper, for whom most models are made, first."""
    folders = sorted(file.parent for file in (assets() / "urdf").glob(f"*/{SPEC}"))
    specs = {folder.name: read_spec(folder) for folder in folders}
    return {name: specs[name] for name in sorted(specs, key=lambda name: (name != "pepper", name))}


ROBOTS = shipped_robots()
"""What `--robot NAME` stands for."""

DATASET_ROBOTS = {
    "demo": "pepper",
    "nuisi": "pepper",
    "buetepage": "pepper",
    "yumi": "yumi",
    "handover": "panda",
    "handover-hands": "kobo",
    "bimanual": "kobo",
}
"""The robot that a dataset's models are trained for: the recorded one, else the one that the partner's arm suits."""


def robot_title(name: str) -> str:
    """A robot's name as its maker writes it; one that is not known by name is only capitalised."""
    return ROBOTS[name].title if name in ROBOTS else f"{name[:1].upper()}{name[1:]}"


def robot_of(dataset: str) -> str:
    """Name in `ROBOTS` of the robot that models of a dataset are trained for. `UserError` for an unknown dataset."""
    if dataset not in DATASET_ROBOTS:
        raise UserError(f"no robot is known for dataset '{dataset}'; valid: {', '.join(DATASET_ROBOTS)}")
    return DATASET_ROBOTS[dataset]


def find_robot(name_or_path: str) -> RobotSpec:
    """A robot by a name in `ROBOTS`, by its folder (with a robot.toml), or by the path of a .urdf file.

    Of a bare description only the joints of Pepper's right arm are known, in Pepper's resting posture: it is meant for
    other descriptions of the same robot.

    Raises `UserError` where it is none of these, or something of it does not exist.
    """
    if name_or_path in ROBOTS:
        return ROBOTS[name_or_path]
    path = Path(name_or_path).expanduser()
    if (path / SPEC).is_file():
        return read_spec(path)
    if path.suffix.lower() != ".urdf":
        raise UserError(
            f"robot '{name_or_path}' is unknown; valid: {', '.join(ROBOTS)}, a folder with a {SPEC}, or the path of a "
            ".urdf file"
        )
    if not path.is_file():
        raise UserError(f"robot '{name_or_path}': {path} is not a file; expected a URDF description")
    pepper = ROBOTS["pepper"]
    arms = {pepper.main.name: pepper.main}
    return replace(
        pepper,
        name=path.stem,
        title=robot_title(path.stem),
        urdf=path,
        arms=arms,
        robot_descriptions=None,
        file=None,
    )
