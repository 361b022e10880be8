"""Where the shipped folders are: robot descriptions (`assets/`) and trained models (`checkpoints/`)."""

from __future__ import annotations

from pathlib import Path

from mild_viz.errors import UserError

SHIPPED_MODELS = {
    "demo": "demo",
    "nuisi": "nuisi-pepper",
    "yumi": "yumi",
    "handover": "handover-panda",
    "handover-hands": "handover-hands",
}
"""Folder under `checkpoints/` that holds the model for a dataset."""

PACKAGE = Path(__file__).resolve().parent


def assets() -> Path:
    """The folder that holds `urdf/<robot>/`. Raises UserError where the installation lacks it."""
    return _shipped("assets")


def checkpoints() -> Path:
    """The folder that holds the shipped models. Raises UserError where the installation lacks it."""
    return _shipped("checkpoints")


def default_checkpoint(dataset: str) -> Path:
    """The shipped model for a dataset. Raises UserError where none ships for it."""
    if dataset not in SHIPPED_MODELS:
        raise UserError(
            f"no model ships for dataset '{dataset}' (models ship for {', '.join(SHIPPED_MODELS)}); give one with "
            "--checkpoint, or see the datasets with: mild-viz data list"
        )
    return checkpoints() / SHIPPED_MODELS[dataset]


def _shipped(folder: str) -> Path:
    """In a checkout the folder stands beside the package, in an installed wheel inside it (see setup.py)."""
    places = (PACKAGE.parent / folder, PACKAGE / folder)
    if (PACKAGE.parent / "pyproject.toml").is_file() and places[0].is_dir():
        return places[0]
    if places[1].is_dir():
        return places[1]
    raise UserError(
        f"the folder {folder}/ that ships with mild_viz is missing: looked at {places[0]} and {places[1]}; "
        "install from a complete clone of the repository with: pip install -e . -c constraints.txt"
    )
