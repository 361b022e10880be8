"""The handover as it is drawn: real recordings, the shipped model, the Panda as giver."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser
from scene_rollouts import scene_inference, scene_rollout
from scipy.spatial.transform import Rotation

from mild_viz.dashboard.recorder import private_server
from mild_viz.dashboard.scene.figure import make_figure, partner_figure
from mild_viz.dashboard.scene.ground import pedestal
from mild_viz.dashboard.scene.handed import GRIP, HEIGHT, RADIUS, bottle, hand_link, handed_frames
from mild_viz.dashboard.scene.layout import TITLE_GAP
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.tabs.view import ViewTab
from mild_viz.dashboard.view import ViewSettings
from mild_viz.data.load import load_dataset
from mild_viz.data.skeletons import to_world
from mild_viz.pipeline import NEWEST
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout
from mild_viz.run_options import RunOptions
from mild_viz.trial import ObjectTrack, Skeleton

TRIAL = 0

Handover = tuple[Rollout, RobotModel]


@pytest.fixture(scope="module")
def handover(data_root: Any) -> Handover:
    return RunOptions(dataset="handover", split="test", trial=TRIAL).run()


@pytest.fixture(autouse=True)
def _needs_recordings(dataset: Callable[[str], Any]) -> None:
    dataset("handover")


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with private_server() as server:
        yield server


def node(server: viser.ViserServer, name: str) -> Any:
    handle = server.scene.get_handle_by_name(name)
    assert handle is not None, f"no node {name}"
    return handle


def rotations(wxyzs: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyzs[..., [1, 2, 3, 0]])


def joint(skeleton: Skeleton | None, name: str) -> np.ndarray:
    assert skeleton is not None
    return skeleton.positions[:, skeleton.joint_names.index(name)]


def test_object_and_giver_stand_to_the_receiver_as_recorded(handover: Handover) -> None:
    """Every rollout frame shows one recorded frame, moved as a whole to where the robot is."""
    rollout, _ = handover
    trial = load_dataset("handover").trial("test", TRIAL)
    inference, track, T_giver = rollout.inference, rollout.object_track, rollout.T_world_partner
    assert track is not None and T_giver is not None and trial.object_track is not None
    assert trial.T_world_human is not None and trial.T_world_partner is not None
    rows = slice(NEWEST, NEWEST + inference.n_windows)
    drawn = np.stack(
        [
            track.positions,
            to_world(T_giver, joint(inference.partner_skeleton, "right_wrist")),
            to_world(rollout.T_world_human, joint(inference.human_skeleton, "right_wrist")),
        ]
    )
    recorded = np.stack(
        [
            to_world(trial.T_world_human, trial.object_track.positions[rows]),
            to_world(trial.T_world_partner, joint(trial.partner_skeleton, "right_wrist")[rows]),
            to_world(trial.T_world_human, joint(trial.human_skeleton, "right_wrist")[rows]),
        ]
    )
    for a, b in ((0, 1), (0, 2), (1, 2)):
        np.testing.assert_allclose(
            np.linalg.norm(drawn[a] - drawn[b], axis=1), np.linalg.norm(recorded[a] - recorded[b], axis=1), atol=1e-9
        )
    assert inference.transfer == np.linalg.norm(recorded[1] - recorded[2], axis=1).argmin()
    np.testing.assert_allclose(T_giver[:2, 3], 0.0, atol=0.5)  # in the robot's place
    moved = rotations(track.wxyzs) * rotations(trial.object_track.wxyzs[rows]).inv()
    np.testing.assert_allclose(moved.as_matrix(), np.tile(rollout.T_world_human[:3, :3], (len(drawn[0]), 1, 1)))


def test_the_object_is_in_the_robots_hand_until_the_transfer_then_as_recorded(handover: Handover) -> None:
    rollout, _ = handover
    frames, track, transfer = handed_frames(rollout), rollout.object_track, rollout.inference.transfer
    assert frames is not None and track is not None and transfer is not None and frames.transfer == transfer > 30
    before, after = slice(0, transfer), slice(transfer, None)
    down = rotations(frames.wxyzs[before]).apply([0.0, 0.0, -GRIP])
    np.testing.assert_allclose(frames.positions[before] + down, rollout.end_effector[before], atol=1e-9)
    hand = rotations(rollout.link_poses[before, hand_link(rollout), :4])
    in_hand = (hand.inv() * rotations(frames.wxyzs[before])).as_matrix()
    np.testing.assert_allclose(in_hand, np.tile(in_hand[0], (transfer, 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(frames.positions[after], track.positions[after])
    np.testing.assert_array_equal(frames.wxyzs[after], track.wxyzs[after])
    turn = rotations(frames.wxyzs[transfer - 1]).inv() * rotations(frames.wxyzs[transfer])
    assert turn.magnitude() < 0.15, "it stands at the transfer as it was recorded"
    wrist = joint(rollout.inference.human_skeleton, "right_wrist")[after]
    away = np.linalg.norm(to_world(rollout.T_world_human, wrist) - frames.positions[after], axis=1)
    assert np.median(away) < HEIGHT, "the receiver has it"

    alone = handed_frames(rollout, in_hand=False)
    assert alone is not None and alone.transfer == 0
    np.testing.assert_array_equal(alone.positions, track.positions)


def test_a_lost_object_is_hidden_and_a_recording_without_one_has_none(handover: Handover) -> None:
    rollout, _ = handover
    track = rollout.object_track
    assert track is not None
    lost = ObjectTrack(np.full_like(track.positions, np.nan), np.full_like(track.wxyzs, np.nan))
    assert handed_frames(replace(rollout, object_track=lost)) is None
    assert handed_frames(replace(rollout, object_track=None)) is None
    gaps = track.wxyzs.copy()
    gaps[-5:] = np.nan
    frames = handed_frames(replace(rollout, object_track=ObjectTrack(track.positions, gaps)))
    assert frames is not None and np.isnan(frames.wxyzs[-5:]).all() and np.isfinite(frames.wxyzs[:-5]).all()


def test_the_scene_draws_receiver_giver_and_object(server: viser.ViserServer, handover: Handover) -> None:
    rollout, robot = handover
    scene, transfer = Scene(server, robot, dark=False), rollout.inference.transfer
    frames = handed_frames(rollout)
    assert transfer is not None and frames is not None
    scene.show(rollout, ViewSettings())
    figure = make_figure(rollout.inference)
    assert figure.walks
    for n, text in ((0, "object, held until 3.8 s"), (transfer, "object, as recorded")):
        scene.set_frame(n)
        assert node(server, "/object").visible and node(server, "/object/label").text == text
        np.testing.assert_allclose(node(server, "/object").position, frames.positions[n], atol=1e-5)
        title = node(server, "/human/title").position
        np.testing.assert_allclose(title, figure.crowns[n] + [0.0, 0.0, TITLE_GAP], atol=1e-5)
        assert np.linalg.norm((title - figure.head_positions[n])[:2]) < 0.1, "it follows the head"
        giver = partner_figure(rollout.inference)
        assert giver is not None
        np.testing.assert_allclose(node(server, "/giver/joints").batched_positions, giver.ball_positions[n], atol=1e-5)
    assert node(server, "/giver").visible and node(server, "/giver/limbs").opacity < 0.5
    layout = scene.layout
    assert layout is not None
    legs = node(server, "/giver/legs").vertices @ np.array(rollout.T_world_partner)[:3, :3].T
    assert legs[:, 2].min() + np.array(rollout.T_world_partner)[2, 3] == pytest.approx(layout.floor, abs=0.03)

    scene.show(rollout, ViewSettings(show_giver=False, show_robot=False))
    assert not node(server, "/giver").visible
    assert node(server, "/object/label").text == "object, as recorded", "no robot has it"


def test_other_recordings_have_no_giver_and_no_object(server: viser.ViserServer) -> None:
    robot = load_robot("pepper")
    scene = Scene(server, robot, dark=False)
    scene.show(scene_rollout(robot, scene_inference()), ViewSettings())
    assert not node(server, "/giver").visible and not node(server, "/object").visible
    before = node(server, "/human/title").position
    scene.set_frame(60)
    np.testing.assert_array_equal(node(server, "/human/title").position, before)


@pytest.mark.parametrize("aspect", [1.3, 1.75, 2.4])
def test_the_picture_holds_the_whole_walk(server: viser.ViserServer, handover: Handover, aspect: float) -> None:
    rollout, robot = handover
    scene = Scene(server, robot, dark=False)
    scene.show(rollout, ViewSettings())
    layout, figure = scene.layout, make_figure(rollout.inference)
    assert layout is not None
    crowns = to_world(rollout.T_world_human, figure.crowns)
    feet = crowns * [1.0, 1.0, 0.0] + [0.0, 0.0, layout.floor]
    for name in ("both", "experimenter"):
        view = scene.camera(name, aspect)
        ahead = np.array(view.look_at) - view.position
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        offsets = np.concatenate([crowns + [0.0, 0.0, TITLE_GAP], feet]) - view.position
        slope = np.tan(view.fov / 2.0) * (offsets @ ahead)
        assert (np.abs(offsets @ right) <= aspect * slope).all()
        assert (np.abs(offsets @ np.cross(right, ahead)) <= slope).all()
    plot = layout.plot_centre @ layout.forward
    assert plot - (crowns @ layout.forward).max() > 1.0, "the plot is clear of the whole walk"


def test_a_bottle_has_its_stated_size_and_hangs_from_the_tracked_point() -> None:
    vertices, _ = bottle()
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[-RADIUS, -RADIUS, -HEIGHT], [RADIUS, RADIUS, 0.0]])


def test_a_narrow_robot_that_stands_high_gets_a_slim_stand() -> None:
    for top, footprint, slim in ((1.0, 0.15, True), (0.3, 0.15, False), (1.0, 0.4, False)):
        vertices, _ = pedestal(0.0, top, footprint)
        middle = np.abs(vertices[:, 2] - 0.5 * top) < 0.45 * top
        widest = np.hypot(*vertices[middle, :2].T).max(initial=0.0)
        assert (0.0 < widest < 0.25) == slim
        assert vertices[:, 2].min() == 0.0 and vertices[:, 2].max() == pytest.approx(top)


def test_the_giver_can_be_hidden_where_one_was_recorded(server: viser.ViserServer, handover: Handover) -> None:
    tab = ViewTab(server.gui, lambda: None, lambda *_: None)
    rollout, _ = handover
    tab.show(rollout)
    assert tab._giver.visible and tab.read().show_giver
    tab._giver.value = False
    assert not tab.read().show_giver
    robot = load_robot("pepper")
    tab.show(scene_rollout(robot, scene_inference()))
    assert not tab._giver.visible
