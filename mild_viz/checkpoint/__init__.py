"""Our checkpoint format: a folder with weights.safetensors, config.json, README.md and contact_states.json."""

from mild_viz.checkpoint.folder import (
    CONFIG,
    check_checkpoint_target,
    load_checkpoint,
    save_checkpoint,
    save_contact_states,
)
from mild_viz.checkpoint.model import Checkpoint, RobotInterface

__all__ = [
    "CONFIG",
    "Checkpoint",
    "RobotInterface",
    "check_checkpoint_target",
    "load_checkpoint",
    "save_checkpoint",
    "save_contact_states",
]
