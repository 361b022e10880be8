"""Two-handed handovers: small files in the layout of the authors' preprocessing (the real set is not at hand)."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mild_viz.data.bimanual import BONES_AS, FOLDER, JOINTS, PAIRS, read_file
from mild_viz.data.load import load_dataset
from mild_viz.data.skeletons import to_world
from mild_viz.errors import UserError
from mild_viz.pairs import stack_windows
from mild_viz.robot.contact import contact_frames
from mild_viz.robot.workspace import measure_workspace
from mild_viz.trial import HAND_POINTS, PHASES

N = 120
LABELS = ["reach"] * 40 + ["transfer"] * 40 + ["retreat"] * 30 + [""] * 10
STANDING = {
    "Hip": (0.0, 0.0, 1.0), "Ab": (0.0, 0.0, 1.1), "Chest": (0.0, 0.0, 1.3), "Neck": (0.0, 0.0, 1.5),
    "Head": (0.0, 0.0, 1.6), "LShoulder": (0.0, 0.05, 1.45), "LUArm": (0.0, 0.2, 1.45), "LFArm": (0.05, 0.2, 1.17),
    "LHand": (0.3, 0.2, 1.1), "RShoulder": (0.0, -0.05, 1.45), "RUArm": (0.0, -0.2, 1.45), "RFArm": (0.05, -0.2, 1.17),
    "RHand": (0.3, -0.2, 1.1),
}  # fmt: skip
"""A person in the own frame, x forward, y left, z up, but with the floor as origin [m]."""


def people() -> dict[str, np.ndarray]:
    """Giver P08 at x = 0 and receiver P07 at x = 1.4 facing each other; both stretch their hands. World, z up."""
    body = np.array([STANDING[bone] for bone in BONES_AS])
    out = np.sin(np.linspace(0.0, np.pi, N))[:, None, None] * (0.2, 0.0, 0.1)
    moving = np.tile(body, (N, 1, 1))
    hands = [list(BONES_AS).index(bone) for bone in ("LHand", "RHand")]
    moving[:, hands] += out
    return {"P08": moving, "P07": moving * (-1.0, -1.0, 1.0) + (1.4, 0.0, 0.0)}


def write(path: Path, change: Callable[[list[list[str]]], None] = lambda table: None) -> Path:
    """An export: OptiTrack's X, Y, Z are -x, z, y."""
    bodies = people()
    header = [f"Bone:{who}:{bone}:Position:{axis}" for who in bodies for bone in BONES_AS for axis in "XYZ"]
    rows = [np.stack([-b[..., 0], b[..., 2], b[..., 1]], axis=-1).reshape(N, -1) for b in bodies.values()]
    table = [["Frame", *header, "Rigid Body:object:Position:X", "Giver"]]
    for n, row in enumerate(np.concatenate(rows, axis=1)):
        table.append([str(n), *(f"{value:.9f}" for value in row), "0", LABELS[n]])
    change(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows(table)
    return path


@pytest.fixture
def export(tmp_path: Path) -> Path:
    return write(tmp_path / "P08_P07_box_double_1.csv")


def test_the_receiver_is_the_human_each_in_an_own_frame(export: Path) -> None:
    trial, bodies = read_file(export), people()
    assert (trial.rate, trial.n_frames, trial.points) == (30.0, N // 4, HAND_POINTS)
    assert trial.human_skeleton is not None and trial.partner_skeleton is not None
    for skeleton, T, who in (
        (trial.human_skeleton, trial.T_world_human, "P07"),
        (trial.partner_skeleton, trial.T_world_partner, "P08"),
    ):
        assert T is not None and skeleton.joint_names == JOINTS
        np.testing.assert_allclose(to_world(T, skeleton.positions), bodies[who][::4], atol=1e-8)
        np.testing.assert_allclose(T[:3, 3], bodies[who][0, JOINTS.index("neck")], atol=1e-8)
    assert trial.partner_points is not None
    # forward is forward, left is left: the giver's hands, seen from the giver's neck
    np.testing.assert_allclose(trial.partner_points[0], [[0.3, -0.2, -0.4], [0.3, 0.2, -0.4]], atol=1e-8)
    np.testing.assert_allclose(trial.human_points, trial.partner_points, atol=1e-8)  # they mirror each other
    assert [PHASES[phase] for phase in trial.phase[[0, 10, 20, -1]]] == ["reach", "contact", "return", "rest"]  # pyright: ignore[reportOptionalSubscript]
    assert contact_frames(trial).sum() == 10
    assert stack_windows([trial], None).partner.shape == (N // 4 - 9, 60)
    assert len(measure_workspace([trial])) == 2


def test_the_set_is_read_by_pairs_and_one_handed_files_are_left_out(tmp_path: Path) -> None:
    for number, pair in enumerate((*PAIRS["train"], *PAIRS["test"])):
        folder = tmp_path / FOLDER / pair / "OptiTrack_Global_Frame"
        write(folder / "P08_P07_box_double_1.csv")
        if number == 0:
            write(folder / "P08_P07_pan_double_2.csv")
            (folder / "P08_P07_cup_single_1.csv").write_text("not read")
    data = load_dataset("bimanual", tmp_path)
    assert (len(data.train), len(data.test), data.actions) == (11, 2, ("handover",))
    assert [trial.index for trial in data.train] == list(range(11))
    (tmp_path / FOLDER / "P29_P30" / "OptiTrack_Global_Frame" / "P08_P07_box_double_1.csv").unlink()
    other = tmp_path / "moved"
    (tmp_path / "bimanual").rename(other)
    (tmp_path / "again").mkdir()
    other.rename(tmp_path / "again" / "bimanual")
    with pytest.raises(UserError, match=r"P29_P30.OptiTrack_Global_Frame has no file named \*double\*\.csv"):
        load_dataset("bimanual", tmp_path / "again")
    with pytest.raises(UserError, match="dataset 'bimanual' is not present: .*Bimanual Handovers Dataset"):
        load_dataset("bimanual", tmp_path / "nowhere")


def test_a_lost_bone_is_a_gap(tmp_path: Path) -> None:
    def lose(table: list[list[str]]) -> None:
        for row in table[9:14]:  # frames 8 to 12, of which 8 and 12 are kept
            row[1 + 3 * list(BONES_AS).index("RHand")] = ""

    trial = read_file(write(tmp_path / "P08_P07_double.csv", lose))
    assert trial.partner_points is not None
    np.testing.assert_array_equal(np.isnan(trial.partner_points).any(axis=(1, 2)).nonzero()[0], [2, 3])
    assert np.isfinite(trial.human_points).all()


def unlabel(table: list[list[str]]) -> None:
    table[5][-1] = "grasp"


def rename(table: list[list[str]]) -> None:
    table[0][1] = "Bone:P01:Hip:Position:X"


def spoil(table: list[list[str]]) -> None:
    table[7][4] = "much"


def in_millimetres(table: list[list[str]]) -> None:
    for row in table[1:]:
        row[1:-2] = [str(1000.0 * float(value)) for value in row[1:-2]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (unlabel, "line 6: the giver's phase is 'grasp'; valid: reach, transfer, retreat"),
        (rename, "has no column 'Bone:P08:Hip:Position:X' and lacks 1 in all"),
        (spoil, "line 8: could not convert string to float: 'much'"),
        (lambda table: table[9].pop(), "line 10 has 80 fields, the header 81"),
        (lambda table: table.__setitem__(slice(20, None), []), "has 19 frames; expected at least 40"),
        (lambda table: table.clear(), "has no column .* expected a header line"),
        (lambda table: table[3].__setitem__(2, "inf"), "holds an infinite number"),
        (in_millimetres, r"the right arm of P07 is \d+ long; expected metres"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, change: Callable[[list[list[str]]], None], message: str) -> None:
    path = write(tmp_path / "P08_P07_box_double_1.csv", change)
    with pytest.raises(UserError, match=message) as caught:
        read_file(path)
    assert str(path) in str(caught.value)


def test_a_name_without_participants_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"begins with no two participants; expected GIVER_RECEIVER_\*\.csv"):
        read_file(write(tmp_path / "double.csv"))
