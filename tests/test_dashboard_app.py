"""What is given at the start is checked before a server is opened; what the page offers fits together."""

from __future__ import annotations

import json
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz import paths, pipeline
from mild_viz.checkpoint import RobotInterface, load_checkpoint, save_checkpoint
from mild_viz.dashboard.app import Dashboard, first_settings, open_dashboard
from mild_viz.dashboard.catalog import Catalog
from mild_viz.dashboard.server import free_port
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.rollout import Rollout


def port() -> int:
    found = free_port("127.0.0.1", 19_300)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("pepper")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(paths.default_checkpoint("demo"), tmp_path_factory.mktemp("models") / "demo-copy"))


@pytest.fixture(scope="module")
def dashboard(model: Path) -> Iterator[Dashboard]:
    dashboard = open_dashboard(checkpoint=model, port=port())
    assert dashboard.session.wait_idle() and dashboard.session.error is None
    yield dashboard
    dashboard.stop()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dataset": "nusi"}, "dataset 'nusi' is unknown; valid: demo, nuisi, yumi, handover"),
        ({"checkpoint": Path("/nowhere")}, "/nowhere is not a checkpoint"),
        ({"action": "dance"}, "action 'dance' is unknown; valid: wave, handshake, rocket, parachute"),
        ({"trial": 4711}, "demo/test has no trial 4711; valid: 0 to"),
        ({"trial": -1}, "demo/test has no trial -1; valid: 0 to"),
        ({"variant": "v9"}, "variant 'v9' is unknown; valid: v1, v2.1"),
        ({"robot": "/nowhere.urdf"}, "/nowhere.urdf"),
        ({"host": "192.0.2.1"}, "no address of this machine"),
    ],
)
def test_unusable_options_are_refused_before_a_server_starts(options: dict[str, Any], message: str) -> None:
    at = port()
    with pytest.raises(UserError) as caught:
        open_dashboard(**{"port": at, **options})
    assert message in str(caught.value)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", at))


def test_a_dataset_that_is_not_here_names_the_command_that_fetches_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MILD_VIZ_DATA", str(tmp_path))
    with pytest.raises(UserError, match="mild-viz data fetch nuisi"):
        open_dashboard(dataset="nuisi", port=port())


def test_a_checkpoint_for_another_robot_is_refused(tmp_path: Path, model: Path, robot: RobotModel) -> None:
    checkpoint = load_checkpoint(model)
    names = ("RShoulderPitch", "RShoulderRoll", "RElbowRoll", "RElbowYaw")
    other = replace(checkpoint, name="other", robot=RobotInterface("pepper", names, "r_gripper"))
    save_checkpoint(other, tmp_path / "other", "for a test")
    catalog = Catalog(robot, tmp_path / "other")
    assert "drives the joints RShoulderPitch, RShoulderRoll, RElbowRoll, RElbowYaw" in str(
        catalog.problem("other", "demo", "pepper")
    )
    assert "other" not in catalog.models("demo", "pepper")


def test_a_model_of_two_humans_fits_every_robot_where_there_is_a_second_human(robot: RobotModel) -> None:
    catalog = Catalog(robot)
    for one in ("pepper", "panda", "yumi", "kobo"):
        assert "nuisi-human" in catalog.models("nuisi", one)
        assert "shows none" in str(catalog.problem("nuisi-human", "yumi", one))


def test_the_first_trial_is_a_test_trial_of_the_action(model: Path) -> None:
    demo, checkpoint = load_dataset("demo"), load_checkpoint(model)
    first = first_settings(demo, checkpoint, None, None, None)
    trial = demo.trial(first.split, first.trial)
    assert (first.split, trial.action, first.variant) == ("test", "handshake", "v3.1")
    rocket = next(trial for trial in demo.test if trial.action == "rocket")
    assert first_settings(demo, checkpoint, None, rocket.index, "v1").trial == rocket.index
    with pytest.raises(UserError, match=f"test trial {rocket.index} is a rocket, not a wave"):
        first_settings(demo, checkpoint, "wave", rocket.index, None)
    with pytest.raises(UserError, match="has no trial 99; valid: 0 to"):
        first_settings(demo, checkpoint, None, 99, None)


def test_only_what_fits_is_offered(
    robot: RobotModel, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MILD_VIZ_DATA", str(tmp_path))
    catalog = Catalog(robot, model)
    usable, others = catalog.offers()
    assert usable == ("demo",)
    assert others["nuisi"] == "get it with: mild-viz data fetch nuisi"
    assert catalog.models("demo", "pepper")[0] == "demo-copy", "the model that was asked for comes first"
    (tmp_path / "nuisi").mkdir()
    (tmp_path / "nuisi" / "traj_data.npz").write_bytes(b"PK not a recording")
    usable, others = Catalog(robot, model).offers()
    assert usable == ("demo",) and "traj_data.npz" in others["nuisi"], "a broken file is named, and breaks nothing"


def test_real_recordings_come_with_the_model_made_for_them(robot: RobotModel, dataset: Callable[[str], Any]) -> None:
    dataset("nuisi")
    catalog = Catalog(robot, paths.default_checkpoint("demo"))
    assert catalog.models("nuisi", "pepper")[0] == "nuisi-pepper" and catalog.models("demo", "pepper")[0] == "demo"
    assert "nuisi" in catalog.offers()[0]
    dataset("yumi")
    assert catalog.models("yumi", "pepper") == ()
    assert "recorded the joints" in str(catalog.problem("demo", "yumi", "pepper"))
    assert "yumi" in catalog.offers()[0] and catalog.robot_for("yumi", "pepper") == "yumi"
    models = catalog.models("nuisi", "pepper")
    assert "nuisi-human" in models and "handover-human" not in models


@pytest.mark.parametrize(("name", "robot_name", "n_joints"), [("yumi", "yumi", 7), ("handover", "panda", 7)])
def test_another_robots_dataset_opens_with_its_shipped_model(
    name: str, robot_name: str, n_joints: int, dataset: Callable[[str], Any]
) -> None:
    dataset(name)
    page = open_dashboard(dataset=name, variant="v4", port=port())
    try:
        assert page.session.wait_idle() and page.session.error is None
        rollout, intro = page.session.rollout, page.controls._states._intro.content
        assert rollout is not None and rollout.robot == robot_name
        assert rollout.joints_commanded.shape[1] == n_joints and rollout.inference.variant == "v4"
        if name == "yumi":  # nothing tells where the hands meet, and the page says what that means
            assert rollout.contact_states == frozenset() and "No state of <b>handshake</b>" in intro
            assert "Saved: no contact states for handshake" in page.controls._states._saved.content
        else:
            assert rollout.contact.any() and "States of contact in <b>handover</b>, v4" in intro
    finally:
        for thread in threading.enumerate():
            if thread.name == "mild_viz datasets":
                thread.join(timeout=20.0)  # else it writes to a page that is gone
        page.stop()


def test_v4_has_its_own_states_and_contact_states(dashboard: Dashboard, model: Path) -> None:
    """Saved where they belong: those that v1 to v3.2 share stay as they are."""
    states, session, dropdown = dashboard.controls._states, dashboard.session, dashboard.controls._trial._variant

    def use(variant: str) -> Rollout:
        dropdown.value = variant
        session.mark_dirty()
        assert session.wait_idle() and session.error is None and session.rollout is not None
        return session.rollout

    before = use("v3.1")
    rollout = use("v4")
    assert not np.array_equal(rollout.inference.active_state, before.inference.active_state)
    checkpoint = load_checkpoint(model)
    own = checkpoint.contact_states_of("v4", "handshake")
    assert rollout.contact_states == own and "its own states" in dashboard.controls._trial._note.content
    state = min(own)
    states._boxes[state].value = False
    assert use("v4").contact_states == own - {state}
    dashboard.controls._save_contact_states()
    saved = json.loads((model / "contact_states.json").read_text())
    assert set(saved["v4"]["handshake"]) == own - {state}
    assert load_checkpoint(model).contact_states == checkpoint.contact_states
    assert use("v3.1").contact_states == before.contact_states
    assert use("v4").contact_states == own - {state}, "as saved"
    states.tick(own)
    assert use("v4").contact_states == own
    dashboard.controls._save_contact_states()
    use("v3.1")


def test_switching_the_dataset_brings_its_model_actions_and_trials(
    dashboard: Dashboard, dataset: Callable[[str], Any]
) -> None:
    dataset("nuisi")
    dropdown, session = dashboard.controls._trial._dataset, dashboard.session
    dashboard.controls.offer_datasets()
    dropdown.value = "nuisi"
    session.mark_dirty()
    assert session.wait_idle() and session.choice is not None
    assert session.error is None
    assert session.choice.trial.dataset == "nuisi" and session.choice.checkpoint.name == "nuisi-pepper"
    dropdown.value = "demo"
    session.mark_dirty()
    assert session.wait_idle() and session.choice.trial.dataset == "demo"


def test_compared_controllers_run_once_and_the_one_that_is_shown_not_again(dashboard: Dashboard) -> None:
    compare, session, view = dashboard.controls._compare, dashboard.session, dashboard.controls._view

    def settle() -> None:
        session.mark_dirty()
        assert session.wait_idle() and session.error is None, session.error

    for box in compare._boxes.values():
        box.value = True
    settle()
    of, ran = dashboard._compared
    assert of is session.rollout and set(ran) == {"base-ik", "mild", "mild-ik"}
    assert session.rollout is not None and ran[session.rollout.controller] is session.rollout
    assert all(name in compare._table.content for name in ran) and compare._table.visible
    before = dict(ran)
    view._sigma.value = 1.0
    settle()
    assert all(dashboard._compared[1][name] is one for name, one in before.items()), "a view runs no controller"
    dashboard.controls._robot._smoothing.value = 0.5
    settle()
    assert dashboard._compared[1]["base-ik"] is not before["base-ik"], "another setting runs them all"
    for box in compare._boxes.values():
        box.value = False
    view._sigma.value, dashboard.controls._robot._smoothing.value = 2.0, 0.8
    settle()
    assert not compare._table.visible


def test_a_robot_brings_what_moves_it_and_a_dataset_its_robot(
    dashboard: Dashboard, dataset: Callable[[str], Any]
) -> None:
    dataset("nuisi")
    dataset("yumi")
    tab, session, scene = dashboard.controls._trial, dashboard.session, dashboard.scene
    dashboard.controls.offer_datasets()

    def choose(handle: Any, value: str) -> tuple[str, str, str]:
        handle.value = value
        session.mark_dirty()
        assert session.wait_idle() and session.error is None, session.error
        choice, rollout = session.choice, session.rollout
        assert choice is not None and rollout is not None and rollout.robot == choice.robot.name
        nodes = set(dashboard.server.scene._handle_from_node_name)
        links = {name.rpartition("/")[2] for name in nodes if name.startswith("/robot/solid/")}
        assert links == set(choice.robot.link_names), "the scene has the links of this robot and of no other"
        assert rollout.joints_commanded.shape[1] == choice.robot.chain.n_joints
        return choice.robot.name, choice.trial.dataset, choice.checkpoint.name

    assert choose(tab._dataset, "nuisi") == ("pepper", "nuisi", "nuisi-pepper")
    # a model of two humans moves a Panda on the same recordings
    assert choose(tab._robot, "Panda") == ("panda", "nuisi", "nuisi-human")
    assert "m²" in dashboard.controls._header.content
    # YuMi's recordings have a robot of their own, whose model drives no other
    assert choose(tab._dataset, "yumi") == ("yumi", "yumi", "yumi")
    assert choose(tab._robot, "Pepper")[0] == "pepper"
    assert tab._dataset.value != "yumi"
    assert choose(tab._dataset, "demo")[:2] == ("pepper", "demo")
    assert scene.layout is not None


def test_ticks_are_compared_with_what_the_model_has_stored(dashboard: Dashboard, model: Path) -> None:
    states, session = dashboard.controls._states, dashboard.session
    assert states.save.disabled and "Saved:" in states._saved.content
    box = states._boxes[0]
    box.value = not box.value
    session.mark_dirty()
    assert session.wait_idle()
    assert not states.save.disabled and "Not saved" in states._saved.content
    dashboard.controls._save_contact_states()
    assert states.save.disabled and "the default of model demo-copy" in states._saved.content
    box.value = not box.value
    session.mark_dirty()
    assert session.wait_idle()
    assert not states.save.disabled and "Not saved" in states._saved.content
    dashboard.controls._save_contact_states()
    assert states.save.disabled


def test_a_copy_goes_by_its_own_name(dashboard: Dashboard) -> None:
    assert "model demo-copy, controller" in dashboard.controls._header.content


def test_what_has_no_effect_is_disabled(dashboard: Dashboard) -> None:
    robot, session = dashboard.controls._robot, dashboard.session
    assert not (robot._lambda_x.disabled or robot._lambda_q.disabled or robot._stiffness.disabled)
    robot._controller.value = "mild"
    dashboard.controls._trial._action.value = "wave"
    session.mark_dirty()
    assert session.wait_idle() and session.error is None
    assert robot._lambda_x.disabled and robot._lambda_q.disabled and robot._stiffness.disabled
    assert "<b>wave</b> has no contact" in dashboard.controls._states._intro.content
    robot._controller.value = "mild-ik"
    dashboard.controls._trial._action.value = "handshake"
    session.mark_dirty()
    assert session.wait_idle() and session.error is None


def test_contact_states_that_cannot_be_saved_say_so(dashboard: Dashboard, model: Path) -> None:
    (model / "contact_states.json").unlink(missing_ok=True)
    (model / "contact_states.json").mkdir()  # a place where no file can be put, for any account
    dashboard.controls._save_contact_states()
    assert "Not saved" in dashboard.controls._states._saved.content
    assert "cannot be written" in dashboard.controls._states._saved.content
    (model / "contact_states.json").rmdir()


def test_tracking_lost_for_seconds_is_drawn_as_a_gap(dashboard: Dashboard) -> None:
    choice, rollout = dashboard.session.choice, dashboard.session.rollout
    assert choice is not None and rollout is not None
    arm = choice.trial.human_arm.copy()
    arm[40:100] = np.nan
    trial = replace(choice.trial, human_arm=arm, human_skeleton=None)
    inference = pipeline.infer(choice.checkpoint, trial, "v3.1")
    gap = pipeline.control(inference, choice.checkpoint, choice.robot, trial, choice.settings.control)
    assert not gap.inference.observed.all()
    dashboard._show(gap, replace(choice, trial=trial), True)
    for frame in range(0, gap.inference.n_windows, 3):
        dashboard.scene.set_frame(frame)
        dashboard._tick(frame, False)
    lanes = dashboard.timeline._lanes
    assert "mv-lost" in lanes["alpha"].content and "tracking lost" in lanes["joints"].content
    assert all("nan" not in lane.content.lower() for lane in lanes.values())
    dashboard._show(rollout, choice, True)


def test_hours_of_use_do_not_make_joining_slower(dashboard: Dashboard) -> None:
    """viser replays to a new browser whatever it keeps: playing and turning must not make that grow."""
    session = dashboard.session
    kept = dashboard.server._websock_server._broadcast_buffer.message_from_id
    slider = dashboard.controls._robot._lambda_q

    def use() -> int:
        for i in range(6):
            slider.value = -2.0 + 0.1 * (i % 2)
            session.mark_dirty()
            assert session.wait_idle()
            for frame in range(0, dashboard.player.n_frames, 5):
                dashboard.scene.set_frame(frame)
                dashboard._tick(frame, bool(frame % 2))
        dashboard.server._run_garbage_collector(force=True)
        return len(kept)

    first = use()
    assert use() <= first + 2
