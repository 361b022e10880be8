"""The page of live operation: what it is told, what it shows, and that control does not care what becomes of it."""

from __future__ import annotations

import os
import pickle
import re
import signal
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from dashboard_browser import eventually, scene_nodes, scene_props
from live_streams import ListInput, ListOutput, demo_model, stream
from test_live_command import HOST, ended, free_port, live, number

from mild_viz.checkpoint import load_checkpoint
from mild_viz.dashboard.live import status
from mild_viz.dashboard.live.page import LivePage
from mild_viz.dashboard.live.scene import MOVED
from mild_viz.dashboard.live.start import PageSetup
from mild_viz.dashboard.live.template import resting_rollout, sigma_points
from mild_viz.dashboard.scene.figure import Figure, skeleton_figure
from mild_viz.data.load import load_dataset
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import LiveController
from mild_viz.live.feed import Feed, Figures, Snapshot, channel, newest
from mild_viz.live.latency import Times
from mild_viz.live.loop import FAULT, LiveLoop, Tick
from mild_viz.live.messages import Observation
from mild_viz.live.onset import INTERACTING
from mild_viz.live.person import skeleton_bones
from mild_viz.live.replay import recorded_joints
from mild_viz.live.setup import NOMINAL_ARM, make_guard
from mild_viz.paths import default_checkpoint
from mild_viz.settings import ControlSettings
from mild_viz.streaming import StreamModel

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="module")
def model() -> StreamModel:
    return demo_model()


def fed_loop(model: StreamModel, end: socket.socket, rate: float = 1000.0) -> tuple[LiveLoop, Feed]:
    frames = stream(load_dataset("demo").test[4], whole=True)
    source, output = ListInput(frames, pause=0.002), ListOutput()
    loop = LiveLoop(LiveController(model, LiveConfig()), source, output, make_guard(model))
    feed = Feed(loop, end, rate)
    loop.witnesses = (feed,)
    return loop, feed


Ends = tuple[socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    ours, theirs = channel()
    with ours, theirs:
        yield ours, theirs


def snapshots(end: socket.socket) -> list[Snapshot]:
    end.setblocking(False)
    found = []
    while True:
        try:
            found.append(pickle.loads(end.recv(60_000)))
        except BlockingIOError:
            return found


def test_a_page_that_does_not_look_delays_nothing(
    model: StreamModel, ends: tuple[socket.socket, socket.socket]
) -> None:
    ours, theirs = ends
    loop, feed = fed_loop(model, ours)
    loop.run(lambda: False)
    waiting = snapshots(theirs)
    assert loop.faults == 0 and not feed.gone
    assert len(waiting) > 0 and feed.dropped > 0 and len(waiting) + feed.dropped == feed._number
    assert loop.latency.count >= 150


def test_a_page_that_is_gone_is_forgotten(model: StreamModel, ends: Ends) -> None:
    ours, theirs = ends
    loop, feed = fed_loop(model, ours)
    theirs.close()
    loop.run(lambda: False)
    assert feed.gone and loop.faults == 0 and loop.controller.interaction == 1
    feed.close()


def test_the_page_gets_the_newest_snapshot_and_no_more_than_asked_for(
    model: StreamModel, ends: tuple[socket.socket, socket.socket]
) -> None:
    ours, theirs = ends
    loop, feed = fed_loop(model, ours, rate=20.0)
    started = time.perf_counter()
    loop.run(lambda: False)
    assert feed._number <= 20.0 * (time.perf_counter() - started) + 2
    first = pickle.loads(theirs.recv(60_000))
    latest = newest(theirs, 0.1)
    assert latest is not None and latest.number > first.number and newest(theirs, 0.01) is None
    assert latest.figures.counts is not None and first.names


def test_faults_that_last_are_told_too(model: StreamModel, ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = ends
    loop, _ = fed_loop(model, ours, rate=100.0)
    original, turns = loop.controller.observe, count()

    def failing(seen: Observation, now: float) -> object:
        if next(turns) < 80:
            return original(seen, now)
        raise RuntimeError("made to fail")

    told: list[Snapshot] = []
    ticks: list[Tick] = []
    monkeypatch.setattr(loop.controller, "observe", failing)
    monkeypatch.setattr("mild_viz.live.feed.STATUS_PERIOD", 0.05)
    loop.witnesses = (*loop.witnesses, ticks.append, lambda _: told.extend(snapshots(theirs)))
    loop.run(lambda: False)
    faulted = [each for each in told if FAULT in each.fired]
    assert len(faulted) > 5
    before = next(tick for tick, after in zip(ticks, ticks[1:], strict=False) if after.fault)
    assert before.decision is not None and before.sent is not None
    assert faulted[-1].figures.last_fault == "RuntimeError: made to fail"
    for each in faulted:
        assert not each.answers and each.phase == INTERACTING
        assert each.contact == before.sent.contact and each.stiffness == before.sent.stiffness.min()
        np.testing.assert_array_equal(each.log_alpha, before.decision.command.log_alpha)


@pytest.fixture(scope="module")
def snapshot(model: StreamModel) -> Snapshot:
    n_states = model.controller.n_states
    return Snapshot(
        number=1, time=5.0, phase="interacting", interaction=2, note="<i>", displacement=0.123, answers=True, names=(),
        positions=None, arm=NOMINAL_ARM, commanded=np.zeros(4), decoded=np.zeros(4), stiffness=0.4, contact=True,
        fired=("contact", "soft"), log_alpha=np.log(np.full(n_states, 1.0 / n_states)), human_latent=np.zeros(5),
        robot_latent=np.zeros(5),
        figures=Figures(Times(5e-4, 9e-4, 1e-3), Times(1e-3, 4e-3, 2e-2), 60.0, 30.0,
                        {"received": 70, "last_error": "not JSON"}, {"stale": 2, "untracked": 1, "held": 4},
                        {"sent": 33}, refused=7, faults=1,
                        last_fault="ValueError: <b>", recorded=99),
    )  # fmt: skip


def test_the_panel_says_what_holds(snapshot: Snapshot) -> None:
    now = re.sub("<[^>]+>", " ", status.now_html(snapshot, LiveConfig()))
    for text in ("interacting", "12.3 cm", "40 %", "The most likely state is a contact state.", "&lt;i&gt;"):
        assert text in now, text
    figures = re.sub("<[^>]+>", " ", status.figures_html(snapshot.figures, 6))
    for text in ("0.50 / 0.90 ms", "1.00 / 4.00 ms", "60 / 30 a second", " 7 ", " 99 ", " 6 "):
        assert text in figures, text
    trouble = status.trouble_html(replace(snapshot.figures, troubles=("recording stopped",)), silent=3.2)
    for text in ("recording stopped", "ValueError: &lt;b&gt;", "for 3 s", "Last error of the input: not JSON"):
        assert text in trouble, text
    assert status.trouble_html(Figures(), 0.1) == ""
    thresholds = status.config_html(LiveConfig())
    assert "start displacement" in thresholds and "0.0224" in thresholds
    idle = replace(snapshot, phase="waiting", log_alpha=np.full(6, np.nan), displacement=float("nan"), fired=())
    assert "reach out" in status.now_html(idle, LiveConfig()) and "none" in status.now_html(idle, LiveConfig())


@pytest.fixture(scope="module")
def page(model: StreamModel) -> Iterator[LivePage]:
    setup = PageSetup(
        HOST, free_port(socket.SOCK_STREAM), default_checkpoint("demo"), model.variant, model.action, "pepper", "own",
        model.settings, model.T_world_human, LiveConfig(), "list", "list",
    )  # fmt: skip
    page = LivePage(setup)
    yield page
    page.server.stop()


def test_the_panel_counts_the_snapshots_that_never_came(
    page: LivePage, snapshot: Snapshot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: None})
    monkeypatch.setattr("mild_viz.dashboard.live.page.PANEL_PERIOD", 0.0)
    for n in (1, 4):
        page.show(replace(snapshot, number=n))
    assert "<td>Frames this page left out</td><td>2</td>" in page._figures.content


def test_a_trunk_that_is_lost_stays_where_it_was(
    page: LivePage, snapshot: Snapshot, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, body = recorded_joints(load_dataset("demo").test[4])
    drawn = count()

    def counted(*arguments: Any) -> Figure:
        next(drawn)
        return skeleton_figure(*arguments)

    page.scene.follow(replace(snapshot, names=names, positions=body[0]))  # lays the scene out
    assert not page.scene._server.scene._handle_from_node_name["/reach"].visible, "it would mark where no hand is"
    monkeypatch.setattr("mild_viz.dashboard.live.scene.skeleton_figure", counted)
    page.scene.follow(replace(snapshot, names=names, positions=body[0]))
    assert next(drawn) == 1, "of a body that is seen whole, one figure does"
    live = page.scene._live_figure
    before = {name: getattr(live, name).copy() for name in MOVED}
    moved = body[80].copy()
    moved[[n for n, name in enumerate(names) if name not in ("right_elbow", "right_wrist", "right_hand")]] = np.nan
    page.scene.follow(replace(snapshot, names=names, positions=moved))
    for name in ("torso_poses", "head_positions"):
        np.testing.assert_array_equal(getattr(live, name), before[name])
    assert not np.allclose(live.ball_positions, before["ball_positions"], equal_nan=True)


def test_the_chart_shows_the_last_seconds_of_every_state(snapshot: Snapshot) -> None:
    rolling = status.Rolling()
    assert rolling.html() == ""
    for n in range(400):
        phase = "waiting" if n % 100 < 10 else "interacting"
        rolling.add(replace(snapshot, time=n / 30.0, phase=phase))
    lines = re.findall(r'points="([^"]+)"', rolling.html())
    assert len(lines) == 6 * 3  # six states; waiting parts the last ten seconds into three pieces
    x = np.array([[float(point.split(",")[0]) for point in line.split()][:: len(line.split()) - 1] for line in lines])
    assert x.min() >= 0.0 and x.max() == 100.0


def test_the_scene_before_anything_happened_holds_every_state(model: StreamModel) -> None:
    checkpoint = load_checkpoint(default_checkpoint("demo"))
    rollout = resting_rollout(
        checkpoint, "v3.1", "handshake", model.robot, ControlSettings(), model.T_world_human, NOMINAL_ARM, None
    )
    hmm = model.models[0].hmms["handshake"]
    np.testing.assert_allclose(rollout.inference.human_state_means, hmm.emission_means[:, :5])
    np.testing.assert_array_equal(rollout.joints_commanded[0], model.robot.chain.rest)
    points = sigma_points(np.zeros((1, 2)), np.array([[[4.0, 0.0], [0.0, 1.0]]]))
    np.testing.assert_allclose(np.sort(np.linalg.norm(points, axis=1)), [0.0, 2.0, 2.0, 4.0, 4.0])


def test_bones_follow_from_the_names() -> None:
    body = load_dataset("demo").test[0].human_skeleton
    assert body is not None and set(skeleton_bones(body.joint_names)) == set(body.bones)
    assert skeleton_bones(("right_shoulder", "right_elbow", "right_wrist")) == ()


def children(process: int) -> list[int]:
    """The processes that a process started, the page's server among them (not multiprocessing's tracker)."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            command = (folder / "cmdline").read_bytes()
        except (OSError, ValueError):
            continue
        if parent == process and b"spawn_main" in command:
            found.append(int(folder.name))
    return found


READY = """() => ['/human', '/robot', '/latent'].every(g =>
  Object.keys(window.__viserSceneTree?.getState() ?? {}).some(n => n.startsWith(g)))
  && (window.__viserTestpoints?.rendererInfo?.render?.frame ?? 0) > 3"""


def panel(page: Page) -> str:
    return page.locator("[data-dock-region='right']").inner_text()


def test_the_page_follows_live_and_its_death_is_no_matter(chromium: Browser, tmp_path: Path) -> None:
    port, commands = free_port(socket.SOCK_STREAM), tmp_path / "commands.csv"
    options = ("--input", "replay:demo/4?loop=1", "--output", f"csv:{commands}", "--port", str(port))
    with live(*options) as process:
        page = chromium.new_page(viewport={"width": 1440, "height": 860})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://{HOST}:{port}")
        page.wait_for_function(READY, timeout=60_000)
        for phase in ("interacting", "returning"):
            page.locator(".mv-phase-now", has_text=phase).wait_for(timeout=30_000)
        page.locator(".mv-phase-now", has_text="interacting").wait_for(timeout=30_000)
        text = panel(page)
        for words in ("Live · handshake · v3.1", "Frame to command, median / 99 %", "Rules that fired", "Counts"):
            assert words in text, words
        assert page.locator(".mv-rolling polyline").count() >= 6
        nodes = scene_nodes(page)
        assert "/human/limbs" in nodes and "/latent/human/state5" in nodes
        arm = next(node for node in nodes if node.startswith("/robot/solid/") and "RForeArm" in node)

        def pose() -> list[float]:
            return page.evaluate("n => window.__viserMutable.nodeRefFromName[n]?.matrixWorld.toArray() ?? []", arm)

        before = pose()
        eventually(lambda: pose() != before, "the robot's arm moves")
        opacity = [scene_props(page, f"/latent/human/state{state}")["opacity"] for state in range(6)]
        assert max(opacity) > 0.5 and min(opacity) < 0.3, "the active state stands out"
        assert errors == []
        page.close()

        [child] = children(process.pid)
        os.kill(child, signal.SIGKILL)
        lines = commands.read_text().count("\n")
        eventually(lambda: commands.read_text().count("\n") >= lines + 15, "commands go on")
        process.send_signal(signal.SIGINT)
        output = ended(process)
    assert number(output, "faults")[2] == 0 and "page's process ended early" in output


def test_a_taken_port_is_refused_and_nothing_stays(capfd: pytest.CaptureFixture[str]) -> None:
    from mild_viz.cli import main

    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        assert main(["live", "--input", "replay:demo/4", "--port", str(taken.getsockname()[1])]) == 2
    assert "is already in use" in capfd.readouterr().err
    assert children(os.getpid()) == []
