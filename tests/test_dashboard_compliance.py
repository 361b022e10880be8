"""The compliance view: the stage in the session's worker, what is drawn, the lane and the table."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser
from dashboard_browser import eventually
from dashboard_fakes import make_checkpoint, make_choice, make_inference, make_rollout, with_view
from scene_rollouts import scene_inference, scene_rollout

from mild_viz.dashboard import charts
from mild_viz.dashboard.recorder import private_server
from mild_viz.dashboard.scene.compliance import METRES_PER_NEWTON, compliance_frames
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.session import Choice, Pipeline, Session
from mild_viz.dashboard.tabs.compliance import table_html
from mild_viz.dashboard.view import ComplianceSettings, ViewSettings
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout
from mild_viz.simulation.compare import Comparison, compare


class Slow:
    """A session whose last stage takes as long as it is told to."""

    def __init__(self) -> None:
        self.choice = make_choice(make_checkpoint())
        self.free = threading.Event()
        self.free.set()
        self.begun: list[Choice] = []
        self.done: list[Choice] = []
        self.shown: list[Rollout] = []
        pipeline = Pipeline(
            lambda checkpoint, trial, variant, robot: make_inference(trial=trial.index, variant=variant),
            lambda inference, checkpoint, robot, trial, settings: make_rollout(inference, settings.controller),
        )
        self.session = Session(
            lambda: self.choice, pipeline, lambda rollout, *_: self.shown.append(rollout), lambda _: None, self.finish
        )

    def finish(self, rollout: Rollout, choice: Choice, is_stale: Callable[[], bool]) -> bool:
        assert rollout is self.shown[-1], "the rollout is shown before"
        self.begun.append(choice)
        assert self.free.wait(10.0)
        if is_stale():
            return False
        self.done.append(choice)
        return True

    def choose(self, choice: Choice) -> None:
        self.choice = choice
        self.session.mark_dirty()


@pytest.fixture
def slow() -> Iterator[Slow]:
    slow = Slow()
    slow.session.start()
    assert slow.session.wait_idle(10.0)
    yield slow
    slow.session.close()


def test_the_last_stage_follows_every_rollout_and_view(slow: Slow) -> None:
    assert slow.done == [slow.choice]
    slow.choose(with_view(slow.choice, dark=True))
    assert slow.session.wait_idle(10.0) and slow.done[1:] == [slow.choice]
    slow.session.mark_dirty()  # nothing changed
    assert slow.session.wait_idle(10.0) and len(slow.begun) == 2


def test_a_newer_choice_is_shown_while_the_last_stage_is_overtaken(slow: Slow) -> None:
    slow.free.clear()
    first, second = (with_view(slow.choice, sigma=sigma) for sigma in (1.0, 1.5))
    slow.choose(first)
    eventually(lambda: slow.begun[-1] is first, "the stage begins")
    slow.choose(second)
    slow.free.set()
    assert slow.session.wait_idle(10.0)
    assert first not in slow.done and slow.done[-1] is second


def test_a_choice_taken_back_is_finished_all_the_same(slow: Slow) -> None:
    slow.free.clear()
    wanted = with_view(slow.choice, sigma=1.0)
    slow.choose(wanted)
    eventually(lambda: slow.begun[-1] is wanted, "the stage begins")
    slow.session.mark_dirty()  # a widget was moved and moved back
    slow.free.set()
    assert slow.session.wait_idle(10.0)
    assert slow.begun.count(wanted) == 2 and slow.done[-1] is wanted


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("pepper")


@pytest.fixture(scope="module")
def rollout(robot: RobotModel) -> Rollout:
    return scene_rollout(robot, scene_inference())


@pytest.fixture(scope="module")
def held(robot: RobotModel, rollout: Rollout) -> Comparison:
    return compare(robot, rollout, "human-led")


def handle(server: viser.ViserServer, name: str) -> Any:
    return server.scene._handle_from_node_name[name]


def test_the_simulated_arm_and_the_force_are_drawn(robot: RobotModel, rollout: Rollout, held: Comparison) -> None:
    view = ViewSettings(compliance=ComplianceSettings("human-led"))
    motion = held.motions["schedule"]
    strongest = int(motion.force.argmax())
    with private_server() as server:
        scene = Scene(server, robot, dark=False)
        scene.show(rollout, view)
        scene.set_frame(strongest)
        assert not handle(server, "/compliance").visible
        scene.show_compliance(compliance_frames(robot, rollout, held, "schedule"))
        poses = robot.link_poses(motion.joints, "handshake")[strongest]
        commands = robot.link_poses(held.joints_commanded, "handshake")[strongest]
        wrist = robot.link_names.index("r_wrist")
        assert np.allclose(handle(server, "/compliance/arm/r_wrist").position, poses[wrist, 4:])
        assert np.allclose(handle(server, "/robot/solid/r_wrist").position, commands[wrist, 4:])
        foot, point = handle(server, "/compliance/force").points[0]
        assert np.allclose(point - foot, METRES_PER_NEWTON * motion.hand_force[strongest], atol=1e-6)
        assert handle(server, "/compliance/text").text.startswith(f"{motion.force[strongest]:.1f} N")
        scene.set_frame(0)
        assert not handle(server, "/compliance/force").visible and not handle(server, "/compliance/text").visible
        scene.show(rollout, ViewSettings())
        scene.set_frame(strongest)
        assert not handle(server, "/compliance").visible
        assert np.allclose(handle(server, "/robot/solid/r_wrist").position, rollout.link_poses[strongest, wrist, 4:])


def test_the_lane_and_the_table_tell_the_comparison(rollout: Rollout, held: Comparison) -> None:
    fixed, schedule = (held.motions[name].summary() for name in ("fixed", "schedule"))
    lane = charts.force_lane(rollout, held)
    assert f"{max(fixed.force_peak, schedule.force_peak):.0f} N" in lane
    assert lane.count("<polyline") == 2 and "mv-touch" in lane and "mv-cursor" in lane
    table = table_html(held)
    for value in (fixed.force_peak, fixed.force_rms, 100 * fixed.displacement_peak):
        assert f"<td>{value:.1f}</td>" in table
    assert f"<td><b>{schedule.force_peak:.1f}</b></td>" in table and "both are the same" not in table
    never = replace(held, grips=())
    assert "never hold each other" in table_html(never)
    same = replace(held, motions=dict.fromkeys(held.motions, held.motions["fixed"]))
    assert "both are the same" in table_html(same)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UserError, match="scenario 'both' is unknown; valid: commanded, human-led"):
        ComplianceSettings("both")
    with pytest.raises(UserError, match="stiffness 'soft' is unknown; valid: fixed, schedule"):
        ComplianceSettings(stiffness="soft")
