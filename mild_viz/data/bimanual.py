"""Two-handed handovers between two people (Zenodo record 7767535, Kshirsagar et al. 2023), as OptiTrack exported them.

The set is not at hand: the layout is that of the authors' preprocessing (`data_raw/alap_preproc.py` of the GitHub
repository souljaboy764/phd_utils). A pair of participants has a folder, such as P07_P08, and in it
`OptiTrack_Global_Frame/GIVER_RECEIVER_*double*.csv`, one file a handover (those named `single` are one-handed, and left
out here). A row is a frame at 120 Hz; columns `Bone:PERSON:JOINT:Position:X` and so on are where a bone begins, and
`Giver` is the giver's phase: reach, transfer or retreat. OptiTrack's axes (X, Y, Z) become (-X, Z, Y), z up. Lengths
are taken to be metres, as that script's own offsets (1 m, 0.3 m) say, and refused where an arm's are not.

As there, every fourth frame is kept (30 Hz), and the pairs are split. The receiver is the human, the giver the partner.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mild_viz.data.checks import file_checksum
from mild_viz.data.skeletons import ARM_JOINTS, bones_along, joint_indices, own_frame
from mild_viz.data.windows import MIN_FRAMES
from mild_viz.errors import UserError
from mild_viz.robot.contact import arm_length
from mild_viz.trial import HAND_POINTS, PHASES, Dataset, Skeleton, Trial

FOLDER = Path("bimanual/Bimanual Handovers Dataset")
PAIRS = {
    "train": tuple(f"P{first:02d}_P{first + 1:02d}" for first in range(7, 27, 2)),
    "test": ("P27_P28", "P29_P30"),
}
"""Folders of each split."""

LOG_RATE, KEEP_EVERY = 120.0, 4
"""Frames a second of the export [Hz], and which of them are kept."""

BONES_AS = {
    "Hip": "pelvis", "Ab": "naval_spine", "Chest": "chest_spine", "Neck": "neck", "Head": "head",
    "LShoulder": "left_clavicle", "LUArm": "left_shoulder", "LFArm": "left_elbow", "LHand": "left_wrist",
    "RShoulder": "right_clavicle", "RUArm": "right_shoulder", "RFArm": "right_elbow", "RHand": "right_wrist",
}  # fmt: skip
"""The joint at which each of OptiTrack's bones begins."""

JOINTS = tuple(BONES_AS.values())
BODY = bones_along(
    JOINTS,
    "pelvis naval_spine chest_spine neck head",
    "neck left_clavicle left_shoulder left_elbow left_wrist",
    "neck right_clavicle right_shoulder right_elbow right_wrist",
)
PHASE_OF = {"": "rest", "reach": "reach", "transfer": "contact", "retreat": "return"}

ARM_LENGTHS = (0.3, 1.0)
"""Upper arm and forearm of an adult are between these [m]; outside, the file is in another unit."""


def read_bimanual(root: Path) -> Dataset:
    """The two-handed handovers from `root`. `UserError` where a folder has no recordings, or one cannot be used."""
    folder = Path(root) / FOLDER
    splits, read = {}, []
    for split, pairs in PAIRS.items():
        files = [file for pair in pairs for file in _files(folder / pair)]
        splits[split] = tuple(read_file(file, split, index) for index, file in enumerate(files))
        read += files
    return Dataset(
        name="bimanual",
        title="Bimanual handovers: one person hands an object to another with both hands (OptiTrack, 30 Hz)",
        train=splits["train"],
        test=splits["test"],
        checksum=file_checksum(*read),
    )


def _files(pair: Path) -> list[Path]:
    files = sorted((pair / "OptiTrack_Global_Frame").glob("*double*.csv"))
    if not files:
        raise UserError(f"{pair / 'OptiTrack_Global_Frame'} has no file named *double*.csv; expected one a handover")
    return files


def read_file(path: Path, split: str = "train", index: int = 0) -> Trial:
    """The trial of one export; an empty cell is a bone that was not tracked.

    Raises:
        UserError: naming the file, and what it lacks or holds.
    """
    people = path.name.split("_")[:2]
    if len(people) < 2:
        raise UserError(f"{path}: the name begins with no two participants; expected GIVER_RECEIVER_*.csv")
    (giver, receiver), phase = _read_export(path, people)
    rows = slice(None, None, KEEP_EVERY)
    (T_world_human, human), (T_world_partner, partner) = (
        _own_frame(path, person, positions[rows])
        for person, positions in zip(people[::-1], (receiver, giver), strict=True)
    )
    arm = joint_indices(JOINTS, ARM_JOINTS)
    return Trial(
        dataset="bimanual",
        split=split,
        index=index,
        action="handover",
        rate=LOG_RATE / KEEP_EVERY,
        human_arm=human.positions[:, arm],
        partner_arm=partner.positions[:, arm],
        human_skeleton=human,
        partner_skeleton=partner,
        T_world_human=T_world_human,
        T_world_partner=T_world_partner,
        phase=phase[rows],
        points=HAND_POINTS,
    )


def _read_export(path: Path, people: list[str]) -> tuple[list[Float[np.ndarray, "F 13 3"]], Int[np.ndarray, " F"]]:
    """Positions [m] of both people's joints in the world, z up, and the phase, by frame of the export."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} cannot be read as comma-separated text: {error}") from error
    header = {name: column for column, name in enumerate(rows[0])} if rows else {}
    wanted = [f"Bone:{person}:{bone}:Position:{axis}" for person in people for bone in BONES_AS for axis in "XZY"]
    missing = [name for name in (*wanted, "Giver") if name not in header]
    if missing:
        raise UserError(f"{path} has no column '{missing[0]}' and lacks {len(missing)} in all; expected a header line")
    frames = rows[1:]
    if len(frames) < KEEP_EVERY * MIN_FRAMES:
        raise UserError(f"{path} has {len(frames)} frames; expected at least {KEEP_EVERY * MIN_FRAMES}")
    columns, phases = [header[name] for name in wanted], []
    values = np.full((len(frames), len(columns)), np.nan)
    for number, row in enumerate(frames):
        where = f"{path}, line {number + 2}"
        if len(row) != len(rows[0]):
            raise UserError(f"{where} has {len(row)} fields, the header {len(rows[0])}")
        try:
            values[number] = [float(row[column] or "nan") for column in columns]
        except ValueError as error:
            raise UserError(f"{where}: {error}") from None
        label = row[header["Giver"]].strip()
        if label not in PHASE_OF:
            raise UserError(f"{where}: the giver's phase is '{label}'; valid: reach, transfer, retreat, or nothing")
        phases.append(PHASES.index(PHASE_OF[label]))
    if np.isinf(values).any():
        raise UserError(f"{path} holds an infinite number; expected finite ones, or nothing where a bone was lost")
    positions = values.reshape(len(frames), len(people), len(BONES_AS), 3) * (-1.0, 1.0, 1.0)
    return [positions[:, person] for person in range(len(people))], np.array(phases)


def _own_frame(path: Path, person: str, body: Float[np.ndarray, "T 13 3"]) -> tuple[Float[np.ndarray, "4 4"], Skeleton]:
    """T_world_person from the first frame in which the person is tracked, and the body in it."""
    length = arm_length(body[:, joint_indices(JOINTS, ARM_JOINTS)])
    if not ARM_LENGTHS[0] <= length <= ARM_LENGTHS[1]:
        raise UserError(
            f"{path}: the right arm of {person} is {length:.3g} long; expected metres, {ARM_LENGTHS[0]} to "
            f"{ARM_LENGTHS[1]} of them, and an arm that is tracked"
        )
    return own_frame(body, JOINTS, BODY)
