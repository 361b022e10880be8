"""The scene of a real handover: object, giver, a receiver who walks, and a picture that holds all of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser

from mild_viz import paths
from mild_viz.checkpoint import load_checkpoint
from mild_viz.dashboard.recorder import private_server
from mild_viz.dashboard.scene.layout import TITLE_GAP, Camera, picture_axes
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.view import ViewSettings
from mild_viz.data.skeletons import to_world
from mild_viz.pipeline import control, infer
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout
from mild_viz.settings import ControlSettings


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("panda")


@pytest.fixture(scope="module")
def handover(data_root: object, robot: RobotModel) -> Callable[[int], Rollout]:
    """The rollout of a test trial with the shipped model."""
    from mild_viz.data.load import load_dataset

    checkpoint = load_checkpoint(paths.default_checkpoint("handover"))

    def make(index: int) -> Rollout:
        trial = load_dataset("handover").test[index]
        return control(infer(checkpoint, trial, "v3.1"), checkpoint, robot, trial, ControlSettings())

    return make


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with private_server() as server:
        yield server


def handle(server: viser.ViserServer, name: str) -> Any:
    found = server.scene.get_handle_by_name(name)
    assert found is not None, f"no node {name}"
    return found


def in_picture(view: Camera, points: np.ndarray, aspect: float) -> np.ndarray:
    """Whether each point is inside the camera's picture."""
    position, look_at = np.array(view.position), np.array(view.look_at)
    towards = (position - look_at) / np.linalg.norm(position - look_at)
    right, above = picture_axes(towards)
    offsets = points - position
    depth, slope = -offsets @ towards, np.tan(view.fov / 2.0)
    return (np.abs(offsets @ above) <= slope * depth) & (np.abs(offsets @ right) <= aspect * slope * depth)


@pytest.mark.parametrize("index", [0, 3, 10])
def test_the_whole_way_of_the_receiver_is_in_the_picture(
    handover: Callable[[int], Rollout], server: viser.ViserServer, robot: RobotModel, index: int
) -> None:
    rollout = handover(index)
    scene = Scene(server, robot, dark=False)
    scene.show(rollout, ViewSettings())
    layout, skeleton = scene.layout, rollout.inference.human_skeleton
    assert layout is not None and skeleton is not None
    body = to_world(rollout.T_world_human, skeleton.positions.reshape(-1, 3))
    body = body[np.isfinite(body).all(axis=1)]
    for aspect in (1.6, 2.2):
        for name in ("both", "experimenter"):
            view = scene.camera(name, aspect)
            # all but the fewest recorded points: a lost foot may be anywhere
            assert in_picture(view, body, aspect).mean() > 0.99, (name, aspect)
            assert in_picture(view, np.array([layout.plot_title, layout.robot_title]), aspect).all()
    # the robot looks to where the plot is, beyond the farthest place of the way
    np.testing.assert_allclose(layout.forward, [1.0, 0.0, 0.0])
    assert layout.plot_centre[0] - body[:, 0].max() > 0.65


def test_the_title_goes_along_with_one_who_walks(
    handover: Callable[[int], Rollout], server: viser.ViserServer, robot: RobotModel
) -> None:
    rollout = handover(1)
    skeleton = rollout.inference.human_skeleton
    assert skeleton is not None
    scene = Scene(server, robot, dark=False)
    scene.show(rollout, ViewSettings())
    head = skeleton.positions[:, skeleton.joint_names.index("head")]
    places = []
    for n in (0, rollout.inference.n_windows - 1):
        scene.set_frame(n)
        title = np.array(handle(server, "/human/title").position)
        np.testing.assert_allclose(title[:2], head[n, :2], atol=0.12)
        assert TITLE_GAP < title[2] - head[n, 2] < TITLE_GAP + 0.25
        places.append(title)
    assert np.linalg.norm(places[1] - places[0]) > 2.0


def test_object_and_giver_are_drawn_where_the_rollout_says(
    handover: Callable[[int], Rollout], server: viser.ViserServer, robot: RobotModel
) -> None:
    rollout = handover(0)
    poses, by_robot, giver = rollout.object_poses, rollout.object_by_robot, rollout.inference.partner_skeleton
    assert poses is not None and by_robot is not None and giver is not None
    scene = Scene(server, robot, dark=False)
    scene.show(rollout, ViewSettings())
    transfer = int(by_robot.argmin())
    for n, text in ((0, "object, carried"), (transfer - 1, "object, carried"), (transfer, "object, as recorded")):
        scene.set_frame(n)
        baton = handle(server, "/object/baton")
        assert baton.visible and handle(server, "/object/text").text == text
        np.testing.assert_allclose(baton.position, poses[n, 4:], atol=1e-5)
        np.testing.assert_allclose(abs(np.dot(baton.wxyz, poses[n, :4])), 1.0, atol=1e-6)
        joints = handle(server, "/giver/joints")
        np.testing.assert_allclose(joints.batched_positions, np.nan_to_num(giver.positions[n]), atol=1e-5)
        np.testing.assert_allclose(handle(server, "/giver").position, rollout.T_world_human[:3, 3], atol=1e-5)
    scene.show(rollout, ViewSettings(show_giver=False, show_human=False, show_robot=False))
    assert not handle(server, "/giver").visible and not handle(server, "/object/baton").visible


def test_a_high_robot_stands_on_a_slim_stand(
    handover: Callable[[int], Rollout], server: viser.ViserServer, robot: RobotModel
) -> None:
    scene = Scene(server, robot, dark=False)
    scene.show(handover(0), ViewSettings())
    assert scene.layout is not None
    stand = handle(server, "/ground/pedestal").vertices
    assert stand[:, 2].max() == pytest.approx(0.0, abs=1e-3)  # carries the robot's base ...
    assert stand[:, 2].min() == pytest.approx(scene.layout.floor, abs=1e-5)  # ... from the floor up
    radii = np.hypot(*stand[:, :2].T)
    column = stand[(radii > 0.01) & (radii < 0.08), 2]
    assert np.ptp(column) > 0.8 * abs(scene.layout.floor) and radii.max() > 0.2  # slim, on a broad foot
