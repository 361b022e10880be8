"""The scene's state on a server without a browser: what the handles hold after `show` and `set_frame`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from scene_rollouts import N_STATES, scene_inference, scene_rollout, without_truth

from mild_viz.dashboard.recorder import private_server
from mild_viz.dashboard.scene.figure import make_figure
from mild_viz.dashboard.scene.latent import (
    OPACITY_FLOOR,
    OPACITY_RANGE,
    TEXT_SIZE,
    dashed,
    segments,
    spread,
    towards_viewer,
)
from mild_viz.dashboard.scene.layout import CAMERAS, FIELD_OF_VIEW, PLOT_SIZE, Camera, picture_axes
from mild_viz.dashboard.scene.palette import CONTROLLER_COLORS, DARK, LIGHT, linear, state_color
from mild_viz.dashboard.scene.projection import LARGEST_RADIUS, magnified, make_projection, nice_step
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.scene.shapes import ball, limb, limb_poses, quaternion_from_matrix, rotate
from mild_viz.dashboard.view import ViewSettings
from mild_viz.errors import UserError
from mild_viz.robot.control.rules import OUT_OF_REACH
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout

VECTORS, MATRICES = ("latent_mean", "state_means"), ("latent_covariance", "state_covariances")


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("pepper")


@pytest.fixture(scope="module")
def rollout(robot: RobotModel) -> Rollout:
    return scene_rollout(robot, scene_inference())


@pytest.fixture(scope="module")
def arm_rollout(robot: RobotModel) -> Rollout:
    return scene_rollout(robot, scene_inference(whole=False))


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with private_server() as server:
        yield server


@pytest.fixture
def scene(server: viser.ViserServer, robot: RobotModel) -> Scene:
    return Scene(server, robot, dark=False)


def node(server: viser.ViserServer, name: str) -> Any:
    handle = server.scene.get_handle_by_name(name)
    assert handle is not None, f"no node {name}"
    return handle


def node_names(server: viser.ViserServer) -> set[str]:
    return set(server.scene._handle_from_node_name)


def test_the_opacity_of_every_ellipsoid_follows_alpha_above_a_floor(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    for n in (0, 40, rollout.inference.n_windows - 1):
        scene.set_frame(n)
        alpha = np.exp(rollout.inference.log_alpha_human[n])
        for agent in ("human", "robot"):
            opacity = [node(server, f"/latent/{agent}/state{s}").opacity for s in range(N_STATES)]
            np.testing.assert_allclose(opacity, OPACITY_FLOOR + OPACITY_RANGE * alpha, atol=0.006)
    assert min(opacity) >= OPACITY_FLOOR


def test_alpha_mode_and_state_colours_come_from_the_settings(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings(alpha_mode="unobserved"))
    states = [node(server, f"/latent/human/state{s}") for s in range(N_STATES)]
    assert len({state.opacity for state in states}) == 1
    assert [state.color for state in states] == [state_color(s) for s in range(N_STATES)]


def test_links_stand_where_the_rollout_says(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings())
    for n in (0, 33, 90):
        scene.set_frame(n)
        for i, name in enumerate(rollout.link_names):
            handle = node(server, f"/robot/solid/{name}")
            np.testing.assert_allclose(handle.position, rollout.link_poses[n, i, 4:], atol=2e-5)
            np.testing.assert_allclose(np.abs(handle.wxyz @ rollout.link_poses[n, i, :4]), 1.0, atol=1e-6)


def test_the_ghost_shows_the_decoded_arm_only_where_it_differs(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    apart = int(np.flatnonzero(rollout.contact)[5])
    scene.show(rollout, ViewSettings())
    scene.set_frame(apart)
    assert node(server, "/robot/ghost").visible
    i = rollout.link_names.index("RForeArm")
    np.testing.assert_allclose(
        node(server, "/robot/ghost/RForeArm").position, rollout.link_poses_decoded[apart, i, 4:], atol=2e-5
    )
    assert "/robot/ghost/torso" not in node_names(server), "links that stand still need no ghost"
    scene.set_frame(0)
    assert not node(server, "/robot/ghost").visible, "decoded and commanded coincide"
    assert node(server, "/robot/caption").text == "mild-ik command · pale: decoded, before IK"
    scene.show(rollout, ViewSettings(ghost=False))
    scene.set_frame(apart)
    assert not node(server, "/robot/ghost").visible and node(server, "/robot/caption").text == "mild-ik command"


def test_compared_controllers_are_ghosts_in_their_colours(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    other = replace(rollout, controller="mild", link_poses=rollout.link_poses_decoded)
    scene.show(rollout, ViewSettings(compared=("mild", "mild-ik")), (other, rollout))
    scene.set_frame(50)
    assert node(server, "/compared/mild").visible
    assert not node(server, "/compared/mild-ik").visible, "the one that is shown solid needs no ghost"
    i = rollout.link_names.index("RForeArm")
    handle = node(server, "/compared/mild/RForeArm")
    np.testing.assert_allclose(handle.position, rollout.link_poses_decoded[50, i, 4:], atol=2e-5)
    assert handle.color == CONTROLLER_COLORS["mild"] and not node(server, "/robot/ghost").visible
    scene.show(rollout, ViewSettings())
    assert not node(server, "/compared/mild").visible


def test_the_reach_volume_is_drawn_when_it_is_asked_for(
    server: viser.ViserServer, scene: Scene, rollout: Rollout, robot: RobotModel
) -> None:
    scene.show(rollout, ViewSettings())
    assert "/reach_volume" not in node_names(server), "it takes time to compute"
    scene.show(rollout, ViewSettings(show_reach=True))
    surface = node(server, "/reach_volume")
    far = np.linalg.norm(surface.vertices - robot.chain.shoulder, axis=1).max()
    assert surface.visible and far == pytest.approx(robot.chain.reach, abs=5e-3)
    scene.show(rollout, ViewSettings())
    assert not node(server, "/reach_volume").visible


def test_recorded_joints_are_drawn_where_they_were_seen_and_gaps_are_hidden(
    server: viser.ViserServer, scene: Scene, arm_rollout: Rollout
) -> None:
    arm = arm_rollout.inference.human_arm.copy()
    arm[50:60] = np.nan
    inference = replace(arm_rollout.inference, human_arm=arm, tracked=np.isfinite(arm).all((1, 2)))
    scene.show(replace(arm_rollout, inference=inference), ViewSettings())
    scene.set_frame(20)
    joints = node(server, "/human/joints")
    np.testing.assert_allclose(joints.batched_positions, arm[20], atol=1e-6)
    assert (joints.batched_scales > 0.02).all() and not node(server, "/human/lost").visible
    scene.set_frame(55)
    assert not joints.batched_scales.any() and not node(server, "/human/limbs").batched_scales.any()
    assert np.isfinite(joints.batched_positions).all() and node(server, "/human/lost").visible
    assert not node(server, "/reach/line").visible and not node(server, "/reach/distance").visible


def test_limbs_reach_from_joint_to_joint() -> None:
    rng = np.random.default_rng(0)
    start, end = rng.normal(size=(2, 20, 3))
    end[0] = start[0] - [0.0, 0.0, 0.5]
    wxyz, scale = limb_poses(start, end, np.full(20, 0.04))
    for i in range(20):
        np.testing.assert_allclose(
            rotate(wxyz[i], np.array([[0.0, 0.0, scale[i, 2]]]))[0] + start[i], end[i], atol=1e-12
        )
    _, hidden = limb_poses(np.full((1, 3), np.nan), end[:1], np.array([0.04]))
    assert not hidden.any()


def test_what_was_not_observed_is_schematic_and_says_so(
    server: viser.ViserServer, scene: Scene, rollout: Rollout, arm_rollout: Rollout
) -> None:
    scene.show(arm_rollout, ViewSettings())
    assert node(server, "/human/caption").text == "right arm observed, rest schematic"
    parts = ("torso", "head", "left_arm", "support")
    assert all(0.0 < node(server, f"/human/schematic/{part}").opacity < 0.5 for part in parts)
    shoulder = np.nanmedian(arm_rollout.inference.human_arm[:, 0], axis=0)
    torso = node(server, "/human/schematic/torso").position
    assert torso[1] > shoulder[1] and abs(torso[2] - shoulder[2]) < 1e-6, "the trunk hangs from the recorded shoulder"
    assert len(node(server, "/human/joints").batched_positions) == 3

    scene.show(rollout, ViewSettings())
    skeleton = rollout.inference.human_skeleton
    assert skeleton is not None
    assert len(node(server, "/human/joints").batched_positions) == len(skeleton.joint_names)
    assert len(node(server, "/human/limbs").batched_positions) == len(skeleton.bones)
    assert node(server, "/human/caption").text == "red arm: model input", "the demo set tracks the legs too"
    assert not {"/human/schematic/left_arm", "/human/schematic/support"} & node_names(server)


def test_only_the_arm_that_feeds_the_model_is_red(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings())
    colors = node(server, "/human/joints").batched_colors
    red = linear(np.array(LIGHT.human, dtype=np.uint8))
    skeleton = rollout.inference.human_skeleton
    assert skeleton is not None
    names = [name for name, color in zip(skeleton.joint_names, colors, strict=True) if (color == red).all()]
    assert names == ["right_shoulder", "right_elbow", "right_wrist"]


def test_the_gap_between_the_hands_is_drawn_and_written(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    for n in (3, int(np.flatnonzero(rollout.contact)[3])):
        scene.set_frame(n)
        ends = node(server, "/reach/line").points[0]
        np.testing.assert_allclose(ends, [rollout.end_effector[n], rollout.target[n]], atol=1e-6)
        assert node(server, "/reach/line").colors.tolist() == list(
            LIGHT.contact if rollout.contact[n] else LIGHT.distance
        )
        text = node(server, "/reach/distance").text
        assert text.startswith(f"{100.0 * rollout.hand_distance[n]:.1f} cm")
        assert text.endswith("contact state") == rollout.contact[n]
        assert not text.endswith("out of reach") and node(server, "/reach/target").color == LIGHT.distance
        np.testing.assert_allclose(node(server, "/reach/target").position, rollout.target[n], atol=1e-6)
    fired = rollout.fired.copy()
    fired[n] |= 1 << OUT_OF_REACH
    scene.show(replace(rollout, fired=fired), ViewSettings())
    assert node(server, "/reach/distance").text.endswith("contact state · out of reach")
    assert node(server, "/reach/target").color == LIGHT.unreachable
    scene.set_frame(n + 1)
    assert node(server, "/reach/target").color == LIGHT.distance
    scene.set_frame(n)
    for distance, marked in ((0.049, True), (0.11, False)):
        scene.show(replace(rollout, hand_distance=np.full_like(rollout.hand_distance, distance)), ViewSettings())
        assert node(server, "/reach/contact").visible == marked, "a contact state alone is not a touch"
    far = replace(rollout, hand_distance=np.full_like(rollout.hand_distance, np.nan))
    scene.show(far, ViewSettings())
    assert not node(server, "/reach/line").visible and not node(server, "/reach/distance").visible
    lost = replace(rollout, inference=replace(rollout.inference, tracked=np.zeros_like(rollout.inference.tracked)))
    scene.show(lost, ViewSettings())
    assert node(server, "/reach/target").visible, "the controller holds on to where the hand was seen last"
    scene.show(replace(rollout, target=np.full_like(rollout.target, np.nan)), ViewSettings())
    assert not node(server, "/reach/target").visible


def test_human_and_robot_face_each_other_in_true_scale(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    human = node(server, "/human")
    np.testing.assert_allclose(human.position, rollout.T_world_human[:3, 3])
    np.testing.assert_allclose(rotate(human.wxyz, np.array([[1.0, 0.0, 0.0]]))[0], [-1.0, 0.0, 0.0], atol=1e-9)
    n = 40
    scene.set_frame(n)
    wrist = node(server, "/human/joints").batched_positions[
        rollout.inference.human_skeleton.joint_names.index("right_wrist")  # pyright: ignore
    ]
    world = rotate(human.wxyz, wrist[None].astype(float))[0] + human.position
    if rollout.inference.observed[n]:
        np.testing.assert_allclose(world, rollout.target[n], atol=0.03)


def test_a_robot_that_must_stand_higher_gets_a_pedestal(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    layout = scene.layout
    assert layout is not None
    top = node(server, "/ground/pedestal").vertices[:, 2]
    assert top.min() == pytest.approx(layout.floor, abs=1e-5) and top.max() > layout.floor + 0.1
    scene.show(rollout, ViewSettings(show_robot=False))
    assert "/ground/pedestal" not in node_names(server), "it goes with the robot"
    scene.show(rollout, ViewSettings())
    assert "/ground/pedestal" in node_names(server)
    raised = rollout.T_world_human.copy()
    raised[2, 3] += 1.2
    scene.show(replace(rollout, T_world_human=raised), ViewSettings())
    assert "/ground/pedestal" not in node_names(server)


def test_the_current_points_and_the_trail_end_at_the_frame(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    axes = (0, 2, 4)
    scene.show(rollout, ViewSettings(latent_axes=axes))
    projection = make_projection(rollout.inference, axes)
    for n in (0, 12, 80):
        scene.set_frame(n)
        expected = projection.points(rollout.inference.human_latent_mean[n : n + 1])[0]
        np.testing.assert_allclose(node(server, "/latent/now_human").position, expected, atol=1e-6)
        np.testing.assert_allclose(node(server, "/latent/trail_human").points[-1, 1], expected, atol=1e-6)
    assert [node(server, f"/latent/axis{i}").text for i in range(3)] == ["z0", "z2", "z4"]
    assert np.abs(node(server, "/latent/path_human").points).max() <= 0.5 * PLOT_SIZE + 1e-6


def test_an_unknown_truth_is_left_out(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(replace(rollout, inference=without_truth(rollout.inference)), ViewSettings())
    scene.set_frame(30)
    assert not node(server, "/latent/now_truth").visible and not node(server, "/latent/trail_truth").visible
    assert node(server, "/latent/now_prediction").visible and len(node(server, "/latent/path_truth").points) == 0


def test_ellipsoids_are_the_sigma_surface_of_the_projected_gaussian(rollout: Rollout) -> None:
    inference, sigma = rollout.inference, 1.5
    projection = make_projection(inference, (1, 3, 0))
    covariance = 1e-2 * inference.human_state_covariances
    centres, wxyzs, radii = projection.ellipsoids(inference.human_state_means, covariance, sigma)
    rng = np.random.default_rng(1)
    for state in range(N_STATES):
        directions = rng.normal(size=(50, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        surface = rotate(wxyzs[state], directions * radii[state])
        projected = projection.matrix @ covariance[state] @ projection.matrix.T
        mahalanobis = np.einsum("ni,ij,nj->n", surface, np.linalg.inv(projected), surface)
        np.testing.assert_allclose(mahalanobis, sigma**2, rtol=1e-6)
    assert (np.abs(centres) <= 0.5 * PLOT_SIZE).all()


def test_outliers_are_cut_off(rollout: Rollout) -> None:
    inference = rollout.inference
    far = inference.human_state_means.copy()
    far[0] += 1e3
    huge = inference.human_state_covariances.copy()
    huge[1] *= 1e8
    wild = replace(inference, human_state_means=far, human_state_covariances=huge)
    projection = make_projection(wild, (0, 1, 2))
    centres, _, radii = projection.ellipsoids(far, huge, 3.0)
    assert np.isfinite(centres).all() and (np.abs(centres) <= 0.5 * PLOT_SIZE).all() and radii.max() <= LARGEST_RADIUS
    spread_of_path = np.ptp(projection.points(inference.human_latent_mean), axis=0)
    assert spread_of_path.max() > 0.2 * PLOT_SIZE, "one lost state must not shrink the rest to a dot"


def test_a_robot_whose_latents_hardly_spread_is_enlarged_and_the_plot_says_so(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    """As in v4, whose human latents spread fifteen times as far: its whole way was cut off, the robot's was a dot."""
    plain = rollout.inference
    scene.show(rollout, ViewSettings())
    assert "×" not in node(server, "/latent/caption").text
    names = ("human_latent_mean", "human_state_means")
    wide: dict[str, Any] = {name: 15.0 * getattr(plain, name) for name in names}
    inference = replace(plain, **wide, human_state_covariances=225.0 * plain.human_state_covariances)
    enlarged, factor = magnified(inference)
    assert factor in (5.0, 10.0, 20.0)
    spread = (inference.robot_state_means - inference.robot_state_means.mean(0)) * factor
    np.testing.assert_allclose(enlarged.robot_state_means - enlarged.robot_state_means.mean(0), spread, atol=1e-9)
    np.testing.assert_allclose(enlarged.robot_state_covariances, factor**2 * plain.robot_state_covariances)
    points = make_projection(inference, "pca").points(inference.human_latent_mean)
    assert (np.abs(points[np.isfinite(points).all(1)]) <= 0.5 * PLOT_SIZE).mean() > 0.99, "the way is not cut off"
    scene.show(replace(rollout, inference=inference), ViewSettings())
    assert node(server, "/latent/caption").text.endswith(f"robot ×{factor:g}")


def test_principal_components_are_ordered_and_labelled(rollout: Rollout) -> None:
    projection = make_projection(rollout.inference, "pca")
    shares = [int(label.split("· ")[1].rstrip("%")) for label in projection.labels]
    assert shares == sorted(shares, reverse=True) and sum(shares) <= 101
    directions = projection.matrix / projection.scale[:, None]
    np.testing.assert_allclose(directions @ directions.T, np.eye(3), atol=1e-9)
    other = make_projection(
        replace(rollout.inference, variant="v1", robot_latent_mean=rollout.inference.robot_latent_mean), "pca"
    )
    np.testing.assert_allclose(other.matrix, projection.matrix)


def test_a_latent_space_of_two_dimensions_still_has_a_plot(rollout: Rollout) -> None:
    inference = rollout.inference
    sides = ("human", "robot")
    flat = {f"{side}_{name}": getattr(inference, f"{side}_{name}")[..., :2] for side in sides for name in VECTORS}
    flat |= {f"{side}_{name}": getattr(inference, f"{side}_{name}")[:, :2, :2] for side in sides for name in MATRICES}
    flat["robot_latent_truth"] = inference.robot_latent_truth[:, :2]
    projection = make_projection(replace(inference, **flat), "pca")
    assert np.isfinite(projection.points(flat["human_latent_mean"])).all() and projection.labels[2] == "PC3 · 0%"


@pytest.mark.parametrize("axes", [(0, 1, 5), (0, 0, 1), (-1, 0, 1), "umap"])
def test_axes_that_do_not_exist_are_refused(rollout: Rollout, axes: Any) -> None:
    with pytest.raises(UserError, match="latent (axes|dimension)"):
        make_projection(rollout.inference, ViewSettings(latent_axes=axes).latent_axes)


def test_bad_view_settings_are_refused() -> None:
    with pytest.raises(UserError, match="sigma"):
        ViewSettings(sigma=0.0)
    with pytest.raises(UserError, match="alpha mode 'x' is unknown; valid: human, joint, unobserved"):
        ViewSettings(alpha_mode="x")


def test_sigma_scales_the_ellipsoids(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings(sigma=0.5))
    small = np.array(node(server, "/latent/robot/state2").scale)
    scene.show(rollout, ViewSettings(sigma=1.0))
    np.testing.assert_allclose(node(server, "/latent/robot/state2").scale, 2.0 * small, rtol=1e-6)


def test_visibility_is_per_group(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings(show_human=False))
    assert [node(server, name).visible for name in ("/human", "/robot", "/latent", "/reach")] == [
        False,
        True,
        True,
        False,
    ]
    scene.show(rollout, ViewSettings(show_robot=False, show_latent=False))
    assert [node(server, name).visible for name in ("/human", "/robot", "/latent")] == [True, False, False]


def test_the_theme_changes_colours_in_place(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings())
    before = node_names(server)
    scene.show(rollout, ViewSettings(dark=True))
    assert node_names(server) == before
    assert node(server, "/human/schematic/torso").color == DARK.schematic
    assert node(server, "/latent/now_human").color == DARK.human


def test_a_frame_only_assigns(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings())
    before = node_names(server)
    started = time.thread_time()
    for n in range(rollout.inference.n_windows):
        scene.set_frame(n)
    cost = (time.thread_time() - started) / rollout.inference.n_windows
    assert node_names(server) == before
    assert cost < 6e-3, f"{1e3 * cost:.1f} ms of CPU time a frame"


def test_a_control_only_rerun_keeps_figure_and_latent_arrays(
    server: viser.ViserServer, scene: Scene, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    figure, latent, names = scene._figure, scene._latent_frames, node_names(server)
    scene.set_frame(25)
    scene.show(replace(rollout, controller="mild"), ViewSettings())
    assert scene._figure is figure and scene._latent_frames is latent and node_names(server) == names
    assert node(server, "/robot/caption").text.startswith("mild command")
    i = rollout.link_names.index("RForeArm")
    np.testing.assert_allclose(node(server, "/robot/solid/RForeArm").position, rollout.link_poses[25, i, 4:], atol=2e-5)


def test_only_states_that_are_ever_active_are_named(server: viser.ViserServer, scene: Scene, rollout: Rollout) -> None:
    active = np.where(rollout.inference.active_state == 2, 1, rollout.inference.active_state)
    scene.show(replace(rollout, inference=replace(rollout.inference, active_state=active)), ViewSettings())
    for agent in ("human", "robot"):
        named = [node(server, f"/latent/{agent}/label{state}").visible for state in range(N_STATES)]
        assert named == [True, True, False, True]
    scene.show(rollout, ViewSettings())
    assert node(server, "/latent/human/label2").visible


def test_a_model_with_fewer_states_takes_the_others_away(
    server: viser.ViserServer, scene: Scene, robot: RobotModel, rollout: Rollout
) -> None:
    scene.show(rollout, ViewSettings())
    scene.set_frame(rollout.inference.n_windows + 50)
    short = scene_rollout(robot, scene_inference("wave", n_states=2))
    scene.show(short, ViewSettings())
    names = node_names(server)
    assert "/latent/human/state1" in names and not {"/latent/human/state2", "/latent/robot/label3"} & names


@pytest.mark.parametrize("aspect", [1.0, 1.3, 1.75, 2.4])
def test_every_preset_sees_what_it_is_for(scene: Scene, rollout: Rollout, aspect: float) -> None:
    scene.show(rollout, ViewSettings())
    layout = scene.layout
    assert layout is not None
    signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(-1, 3)
    turn = np.array([np.cos(0.5 * layout.plot_yaw), 0.0, 0.0, np.sin(0.5 * layout.plot_yaw)])
    plot = list(layout.plot_centre + rotate(turn, 0.5 * PLOT_SIZE * signs))
    dyad = [layout.robot_top, layout.human_top, layout.hand, np.array([0.0, 0.0, layout.floor])]
    wanted = {"both": dyad + plot, "experimenter": dyad, "latent": plot, "participant": [layout.robot_top, layout.hand]}
    assert set(wanted) == set(CAMERAS)
    for name, points in wanted.items():
        view = scene.camera(name, aspect)
        across, high, ahead = seen_from(view, np.array(points))
        slope = np.tan(view.fov / 2.0)
        assert (ahead > 0.1).all()
        assert (np.abs(high) <= slope * ahead).all() and (np.abs(across) <= aspect * slope * ahead).all(), name
    assert scene.camera("both", aspect).fov == pytest.approx(FIELD_OF_VIEW)
    with pytest.raises(UserError, match="camera 'top' is unknown; valid: both, participant, experimenter, latent"):
        scene.camera("top")


class Client(viser.ClientHandle):
    """What the scene needs of a browser: a camera and its canvas."""

    def __init__(self, client_id: int) -> None:
        self.client_id = client_id
        self.camera: Any = SimpleNamespace(
            image_width=930,
            image_height=430,
            position=np.ones(3),
            look_at=np.zeros(3),
            fov=1.0,
            up_direction=np.zeros(3),
        )

    def atomic(self) -> AbstractContextManager[None]:
        return nullcontext()


def stands_at(client: Client, view: Camera) -> bool:
    camera = client.camera
    return np.allclose([camera.position, camera.look_at], [view.position, view.look_at], atol=1e-6)


def test_presets_follow_layout_and_canvas_until_a_person_turns_the_camera(
    server: viser.ViserServer, scene: Scene, rollout: Rollout, monkeypatch: pytest.MonkeyPatch
) -> None:
    new, side, turned = Client(1), Client(2), Client(3)
    clients = {client.client_id: client for client in (new, side, turned)}
    monkeypatch.setattr(server, "get_clients", lambda: dict(clients))
    scene.refit_cameras()
    assert new.camera.fov == 1.0, "there is no layout yet"
    scene.show(rollout, ViewSettings())
    scene.move_camera(side, "experimenter")
    scene.refit_cameras()
    wide = 930 / 430
    assert stands_at(new, scene.camera("both", wide)) and stands_at(side, scene.camera("experimenter", wide))
    turned.camera.position = np.array(turned.camera.position) + [0.3, 0.0, 0.0]
    stays = turned.camera.position

    far = rollout.T_world_human.copy()
    far[0, 3] += 0.5
    scene.show(replace(rollout, T_world_human=far), ViewSettings())
    assert not stands_at(new, scene.camera("both", wide))
    scene.refit_cameras()
    assert stands_at(new, scene.camera("both", wide)) and stands_at(side, scene.camera("experimenter", wide))
    new.camera.image_width = 430
    scene.refit_cameras()
    assert stands_at(new, scene.camera("both", 1.0)), "the canvas has become narrow"
    assert turned.camera.position is stays, "a person has turned it"
    before = side.camera.position
    far[0, 3] += 0.01
    scene.show(replace(rollout, T_world_human=far), ViewSettings())
    scene.refit_cameras()
    assert side.camera.position is before, "too little to move for"


def seen_from(view: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates to the right, up and ahead of a camera."""
    ahead = np.array(view.look_at) - view.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offsets = points - view.position
    return offsets @ right, offsets @ np.cross(right, ahead), offsets @ ahead


def test_the_groups_stand_side_by_side(scene: Scene, rollout: Rollout) -> None:
    scene.show(rollout, ViewSettings())
    layout = scene.layout
    assert layout is not None
    view = scene.camera("both")
    across, _, ahead = seen_from(view, np.stack([layout.robot_top, layout.human_top, layout.plot_centre]))
    places = across / ahead
    assert places[0] < places[1] < places[2]
    reach = 0.5 * PLOT_SIZE * np.sqrt(2.0)
    assert np.linalg.norm((layout.plot_centre - layout.human_top)[:2]) > reach, "the plot is clear of the human"


def test_dashes_cover_half_of_the_line() -> None:
    angle = np.linspace(0.0, 6.0, 400)
    pieces = segments(np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1))
    dashes = dashed(pieces)
    share = (
        np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=1).sum()
        / np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1).sum()
    )
    assert share == pytest.approx(0.5, abs=0.02)
    assert dashed(segments(np.full((5, 3), np.nan))).shape == (0, 2, 3)


def test_state_names_do_not_overlap() -> None:
    spots = spread(0.05 * np.random.default_rng(2).normal(size=(12, 3)))
    across, high = (spots @ axis for axis in picture_axes(towards_viewer()))
    wide, tall = (np.abs(values[:, None] - values[None]) for values in (across, high))
    overlap = (wide < 0.9 * TEXT_SIZE[0]) & (tall < 0.9 * TEXT_SIZE[1])
    assert overlap.sum() == len(spots), "only with themselves"
    assert np.abs(spots).max() < 0.5 * PLOT_SIZE
    assert len(np.unique(np.round(spread(np.zeros((8, 3))), 3), axis=0)) == 8, "equal places part too"


def test_quaternions_of_half_turns_are_right() -> None:
    turns = np.stack([np.diag(d) for d in ([1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]).astype(float)
    wxyz = quaternion_from_matrix(turns)
    for turn, quaternion in zip(turns, wxyz, strict=True):
        np.testing.assert_allclose(rotate(quaternion, np.eye(3)), turn.T, atol=1e-12)


def test_closed_meshes_face_outwards() -> None:
    for vertices, faces in (ball(), limb()):
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
        assert volume > 0.0


def test_colours_of_lines_are_linear_light() -> None:
    np.testing.assert_array_equal(linear(np.array([0, 128, 255], dtype=np.uint8)), [0, 55, 255])


def test_nice_steps() -> None:
    assert [nice_step(value) for value in (0.07, 0.2, 0.21, 4.9, 10.0)] == pytest.approx([0.05, 0.2, 0.2, 2.0, 10.0])


def test_stature_is_that_of_an_adult_for_any_arm(rollout: Rollout) -> None:
    tiny = replace(rollout.inference, human_arm=1e-3 * rollout.inference.human_arm, human_skeleton=None)
    lost = replace(tiny, human_arm=np.full_like(tiny.human_arm, np.nan))
    assert 1.5 <= make_figure(tiny).height <= 1.95
    figure = make_figure(lost)
    assert not figure.ball_scales.any() and np.isfinite(figure.torso_poses).all()
