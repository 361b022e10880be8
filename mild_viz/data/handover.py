"""Real one-handed handovers between two people, whole bodies (ZED body-34) in one world frame.

The receiver is the human, the giver the partner. Arms are right shoulder, elbow and wrist: of the four pairs
of wrists it is the two right ones that come closest, in each of the 200 trials. The receiver walks up to the
giver during a trial, so that the receiver's own frame, which the first tracked frame sets, stays behind;
`T_world_human` and `T_world_partner` say where the frames are.

The object is a rigid body with markers, one tracked point and a quaternion (w, x, y, z) in the same world as the
bodies: read so, it turns with the hands that hold it (`tests/test_data_handover.py`). Its own axes are the world's at
the start of each trial, and the hands are below its point: the giver's some 26 cm, the receiver's some 10 cm. Which
object it is, and its shape, was not recorded.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.data.checks import file_checksum
from mild_viz.data.npz import load_npz
from mild_viz.data.skeletons import ARM_JOINTS, ZED_BONES, ZED_JOINTS, joint_indices, own_frame, to_frame
from mild_viz.data.windows import MIN_FRAMES
from mild_viz.errors import UserError
from mild_viz.trial import HAND_POINTS, Dataset, ObjectTrack, Trial

FILES = {split: Path(f"handover/{split}.npz") for split in ("train", "test")}
ARRAYS = ("receiver", "giver", "offsets", "rate_hz")
OBJECT_ARRAYS = ("object_position", "object_quaternion")
"""Read where they are there: (N, 3) [m] and (N, 4), wxyz."""

MIN_UPRIGHT = 0.8
"""Least mean share of the direction from pelvis to head that must lie along one axis for it to be 'up'."""


def read_handover(root: Path) -> Dataset:
    """The handovers from `root`. The world is turned so that z is up, if it is not already."""
    paths = {split: Path(root) / file for split, file in FILES.items()}
    return Dataset(
        name="handover",
        title="Handovers: one person hands an object to another (ZED body-34, 30 Hz)",
        train=tuple(read_file(paths["train"], "train")),
        test=tuple(read_file(paths["test"], "test")),
        checksum=file_checksum(*paths.values()),
    )


def read_handover_hands(root: Path) -> Dataset:
    """The same recordings, of which a model reads both hands of both people: the robot gives with two arms.

    (Sec. Bimanual Robot-to-Human Handovers; there on recordings of two-handed handovers.)
    """
    source = read_handover(root)
    train, test = (
        tuple(replace(trial, dataset="handover-hands", points=HAND_POINTS) for trial in trials)
        for trials in (source.train, source.test)
    )
    return replace(source, name="handover-hands", title=f"{source.title}: both hands", train=train, test=test)


def read_file(path: Path, split: str) -> list[Trial]:
    """The trials of one file: bodies (N, 34, 3) [m], trial after trial; trial i begins at frame `offsets[i]`."""
    arrays = load_npz(path, ARRAYS)
    receiver, giver = (_check_body(path, name, arrays[name]) for name in ("receiver", "giver"))
    offsets, rate = _check_layout(path, arrays["offsets"], arrays["rate_hz"], len(receiver), len(giver))
    turn = _turn_upright(path, np.concatenate([receiver, giver]))
    receiver, giver = receiver @ turn.T, giver @ turn.T
    carried = _check_object(path, arrays, len(receiver), turn)
    trials = []
    for index, (first, last) in enumerate(zip(offsets[:-1], offsets[1:], strict=True)):
        try:
            T_world_human, human = own_frame(receiver[first:last], ZED_JOINTS, ZED_BONES)
            T_world_partner, partner = own_frame(giver[first:last], ZED_JOINTS, ZED_BONES)
        except UserError as error:
            raise UserError(f"{path}: {split} trial {index}: {error}") from error
        arm = joint_indices(ZED_JOINTS, ARM_JOINTS)
        trials.append(
            Trial(
                dataset="handover",
                split=split,
                index=index,
                action="handover",
                rate=rate,
                human_arm=human.positions[:, arm],
                partner_arm=partner.positions[:, arm],
                human_skeleton=human,
                partner_skeleton=partner,
                T_world_human=T_world_human,
                T_world_partner=T_world_partner,
                object_track=None if carried is None else _own_track(T_world_human, *(x[first:last] for x in carried)),
            )
        )
    return trials


def _check_body(path: Path, name: str, body: np.ndarray) -> Float[np.ndarray, "N 34 3"]:
    if body.ndim != 3 or body.shape[1:] != (len(ZED_JOINTS), 3) or body.dtype.kind != "f":
        raise UserError(f"{path}: {name} is {body.dtype} of shape {body.shape}; expected (N, {len(ZED_JOINTS)}, 3)")
    if np.isinf(body).any():
        raise UserError(f"{path}: {name} has an infinite coordinate; expected finite or NaN (a gap)")
    return body.astype(np.float64)


def _check_layout(path: Path, offsets: np.ndarray, rate: np.ndarray, *lengths: int) -> tuple[list[int], float]:
    n_frames = lengths[0]
    if any(length != n_frames for length in lengths):
        raise UserError(f"{path}: receiver and giver have {lengths} frames; expected equal numbers")
    if offsets.ndim != 1 or offsets.dtype.kind not in "iu" or len(offsets) < 2:
        raise UserError(f"{path}: offsets is {offsets.dtype} of shape {offsets.shape}; expected trial limits, integers")
    limits: list[int] = offsets.tolist()  # Python's integers: NumPy's differences wrap around
    steps = [last - first for first, last in zip(limits[:-1], limits[1:], strict=True)]
    if limits[0] != 0 or limits[-1] != n_frames or min(steps) < MIN_FRAMES:
        raise UserError(
            f"{path}: offsets run from {limits[0]} to {limits[-1]}; expected 0 to {n_frames} "
            f"in steps of at least {MIN_FRAMES} frames"
        )
    if rate.ndim != 0 or rate.dtype.kind not in "fiu" or not 0.0 < float(rate) < np.inf:
        raise UserError(f"{path}: rate_hz is {rate}; expected one number above 0")
    return limits, float(rate)


def _check_object(
    path: Path, arrays: dict[str, np.ndarray], n_frames: int, turn: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 3"]] | None:
    """The object's point [m] and rotation in the upright world; None where the file has no object."""
    present = [name for name in OBJECT_ARRAYS if name in arrays]
    if not present:
        return None
    for name, width in zip(OBJECT_ARRAYS, (3, 4), strict=True):
        array = arrays.get(name)
        if array is None:
            raise UserError(f"{path} has {present[0]} but no {name}; expected both, or none")
        if array.shape != (n_frames, width) or array.dtype.kind != "f":
            raise UserError(f"{path}: {name} is {array.dtype} of shape {array.shape}; expected ({n_frames}, {width})")
        if np.isinf(array).any():
            raise UserError(f"{path}: {name} has an infinite value; expected finite or NaN (a gap)")
    position, wxyz = (arrays[name].astype(np.float64) for name in OBJECT_ARRAYS)
    length = np.linalg.norm(wxyz, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 1e-3)  # a gap is NaN, and not wrong
    if len(wrong):
        raise UserError(
            f"{path}: object_quaternion of frame {wrong[0]} has length {length[wrong[0]]:.3g}; "
            "expected unit quaternions"
        )
    from scipy.spatial.transform import Rotation  # slow to import, and only this source needs it

    rotation = np.full((n_frames, 3, 3), np.nan)
    known = np.isfinite(wxyz).all(axis=1)
    rotation[known] = Rotation.from_quat(wxyz[known][:, [1, 2, 3, 0]]).as_matrix()
    # Its own axes are the recording's at the start: they turn with the world, so that its up stays its up.
    return position @ turn.T, turn @ rotation @ turn.T


def _own_track(
    T_world_human: Float[np.ndarray, "4 4"], positions: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T 3 3"]
) -> ObjectTrack:
    """The object in the human's own frame."""
    from scipy.spatial.transform import Rotation

    wxyzs = np.full((len(positions), 4), np.nan)
    known = np.isfinite(rotations).all(axis=(1, 2))
    wxyzs[known] = Rotation.from_matrix(T_world_human[:3, :3].T @ rotations[known]).as_quat()[:, [3, 0, 1, 2]]
    return ObjectTrack(to_frame(T_world_human, positions), wxyzs)


def _turn_upright(path: Path, bodies: Float[np.ndarray, "N 34 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that brings the recording's up axis, along which people stand, to z."""
    head, pelvis = joint_indices(ZED_JOINTS, ("head", "pelvis"))
    upright = bodies[:, head] - bodies[:, pelvis]
    upright = upright[np.isfinite(upright).all(axis=1)]
    if len(upright) == 0:
        raise UserError(f"{path}: head and pelvis are tracked in no frame; expected them, to know which way is up")
    upward = upright.mean(axis=0)
    upward /= max(float(np.linalg.norm(upward)), np.finfo(float).tiny)
    axis = int(np.abs(upward).argmax())
    if not abs(upward[axis]) > MIN_UPRIGHT:
        raise UserError(
            f"{path}: heads are above pelvises along {np.round(upward, 2)}; expected mostly one axis of the world"
        )
    turn = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3, axis]]
    return turn if upward[axis] > 0 else np.diag([-1.0, 1.0, -1.0]) @ turn
