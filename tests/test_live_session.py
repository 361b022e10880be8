"""Recorded sessions: exact, readable after any end, refused when damaged, run again to the bit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from disk import full_disk
from hypothesis import given
from hypothesis import strategies as st
from live_streams import ListInput, ListOutput, demo_model, stream

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import LiveController
from mild_viz.live.loop import LiveLoop, Tick
from mild_viz.live.onset import INTERACTING, RETURNING
from mild_viz.live.record import QUEUED, Recorder
from mild_viz.live.replayed import (
    interactions,
    recorded_rollout,
    rerun,
    session_checkpoint,
    session_config,
    session_dataset,
    session_header,
    session_robot,
    session_settings,
    tick_taken,
)
from mild_viz.live.session import Session, plain, read_session, to_line
from mild_viz.live.setup import live_model, make_guard
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.settings import WINDOW
from mild_viz.streaming import StreamModel

HANDSHAKE, WAVE = 4, 0
CONFIG = LiveConfig().for_dataset("demo")


@pytest.fixture(scope="module")
def model() -> StreamModel:
    return demo_model(controller="mild-ik", lambda_q=0.02)


def run(model: StreamModel, path: Path, trials: tuple[int, ...] = (HANDSHAKE,), turns: int = sys.maxsize) -> list[Tick]:
    """Record a session of several trials in a row, each followed by silence; stop after so many turns."""
    frames: list = []
    for trial in trials:
        frames += [*stream(load_dataset("demo").test[trial], whole=True), *[None] * 25]  # time to be back at rest
    ticks: list[Tick] = []
    source, output = ListInput(frames, pause=0.004), ListOutput()
    header = session_header(load_checkpoint(default_checkpoint("demo")), model, "pepper", CONFIG, ("list", "list"))
    recorder = Recorder(path, header)
    loop = LiveLoop(LiveController(model, CONFIG), source, output, make_guard(model), (recorder, ticks.append))
    loop.run(lambda: len(ticks) >= turns)
    recorder.close()
    assert loop.faults == 0 and recorder.trouble == "" and recorder.written == len(ticks)
    return ticks


@pytest.fixture(scope="module")
def recorded(model: StreamModel, tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, list[Tick]]:
    path = tmp_path_factory.mktemp("sessions") / "session.jsonl"
    ticks = run(model, path)
    return read_session(path), ticks


def same(got: object, expected: object) -> None:
    """Equal to the bit, whatever it is."""
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(np.asarray(got), expected)
    elif hasattr(expected, "__dataclass_fields__"):
        for field in fields(expected):  # pyright: ignore[reportArgumentType]
            same(getattr(got, field.name), getattr(expected, field.name))
    elif isinstance(expected, tuple):
        assert isinstance(got, tuple) and len(got) == len(expected)
        for a, b in zip(got, expected, strict=True):
            same(a, b)
    elif isinstance(expected, float) and np.isnan(expected):
        assert isinstance(got, float) and np.isnan(got)
    else:
        assert got == expected


def test_what_was_is_read_back_to_the_bit(recorded: tuple[Session, list[Tick]]) -> None:
    session, ticks = recorded
    assert len(session.ticks) == len(ticks) > 150 and not session.torn
    for got, expected in zip(session.ticks, ticks, strict=True):
        same(got, expected)


@given(st.lists(st.floats() | st.integers(-(2**53), 2**53), max_size=8))
def test_numbers_survive_the_file(values: list[float]) -> None:
    array = np.array(values, dtype=np.float64)
    line = to_line({"values": array})
    from mild_viz.live.session import _array

    np.testing.assert_array_equal(_array(json.loads(line)["values"]), array)
    assert plain(np.array([np.nan, np.inf, -np.inf, 1.5])) == [None, "inf", "-inf", 1.5]


@pytest.fixture(scope="module")
def stopped(model: StreamModel, tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, list[Tick]]:
    """As by Ctrl-C within an interaction."""
    path = tmp_path_factory.mktemp("sessions") / "stopped.jsonl"
    ticks = run(model, path, turns=100)
    assert [tick.decision.phase for tick in ticks[98:101] if tick.decision] == [INTERACTING, INTERACTING, RETURNING]
    return read_session(path), ticks


@pytest.mark.parametrize("how", ["recorded", "stopped"])
def test_the_same_settings_decide_the_same_again(how: str, request: pytest.FixtureRequest) -> None:
    session, _ = request.getfixturevalue(how)
    checkpoint = session_checkpoint(session)
    config = session_config(session)
    model = live_model(
        checkpoint, session.header["variant"], session.header["action"], session_robot(session, checkpoint),
        session_settings(session), config,
    )  # fmt: skip
    again = list(rerun(session, model, config))
    assert len(again) == len(session.ticks) > 100
    for tick, decision in again:
        same(decision, tick.decision)


def test_other_settings_decide_otherwise(recorded: tuple[Session, list[Tick]]) -> None:
    session, _ = recorded
    checkpoint, config = session_checkpoint(session), replace(session_config(session), start_displacement=0.1)
    settings = replace(session_settings(session), controller="mild")
    robot = session_robot(session, checkpoint)
    model = live_model(checkpoint, "v2.1", "handshake", robot, settings, config)
    starts = [n for n, (_, each) in enumerate(rerun(session, model, config)) if each and each.phase == INTERACTING]
    before = [n for n, tick in enumerate(session.ticks) if tick.decision and tick.decision.phase == INTERACTING]
    assert starts[0] > before[0], "it starts later"


def test_an_interaction_is_a_trial_for_the_pipeline(recorded: tuple[Session, list[Tick]]) -> None:
    session, _ = recorded
    checkpoint = session_checkpoint(session)
    robot, settings = session_robot(session, checkpoint), session_settings(session)
    trial = session_dataset(session).test[0]
    inference = infer(checkpoint, trial, session.header["variant"])
    rollout = control(inference, checkpoint, robot, trial, settings)
    taken = [tick for tick in interactions(session)[1] if tick_taken(tick)]
    said = [tick.decision.command for tick in taken if tick.decision is not None]
    assert len(said) > 80 and inference.n_windows >= len(said)
    rows = np.cumsum([len(tick.decision.samples) for tick in taken if tick.decision is not None]) - WINDOW
    np.testing.assert_allclose(inference.log_alpha_human[rows], [each.log_alpha for each in said], atol=1e-9)
    np.testing.assert_allclose(inference.joints_decoded[rows], [each.joints_decoded for each in said], atol=1e-9)
    np.testing.assert_allclose(inference.robot_latent_mean[rows], [each.robot_latent_mean for each in said], atol=1e-9)
    np.testing.assert_allclose(rollout.target[rows], [each.target for each in said], atol=1e-12)
    assert rollout.contact[rows].tolist() == [each.contact for each in said]


def test_the_rollout_of_a_session_is_what_was_sent(recorded: tuple[Session, list[Tick]]) -> None:
    session, ticks = recorded
    checkpoint = session_checkpoint(session)
    rollout = recorded_rollout(session, interactions(session)[1], 0, checkpoint, session_robot(session, checkpoint))
    sent = [tick for tick in ticks if tick.sent and tick.decision and tick.decision.interaction == 1
            and tick.decision.phase in ("interacting", "returning")]  # fmt: skip
    assert rollout.inference.n_windows == len(sent)
    for n, tick in enumerate(sent):
        assert tick.sent is not None and tick.decision is not None
        np.testing.assert_array_equal(rollout.joints_commanded[n], tick.sent.positions)
        np.testing.assert_array_equal(rollout.stiffness[n], tick.sent.stiffness)
        np.testing.assert_array_equal(rollout.inference.log_alpha_human[n], tick.decision.command.log_alpha)
        assert rollout.contact[n] == tick.sent.contact and rollout.fired[n] == tick.decision.command.fired
    assert rollout.inference.human_skeleton is not None and rollout.contact.any()
    assert rollout.contact_states == checkpoint.contact_states_of("v3.1", "handshake")


def test_another_model_is_refused(recorded: tuple[Session, list[Tick]]) -> None:
    session, _ = recorded
    with pytest.raises(UserError, match="another model.*checksums differ"):
        session_checkpoint(session, default_checkpoint("nuisi"))


def test_a_session_without_an_interaction_says_so(recorded: tuple[Session, list[Tick]]) -> None:
    session, _ = recorded
    with pytest.raises(UserError, match="holds no interaction"):
        session_dataset(replace(session, ticks=session.ticks[:20]))


@pytest.fixture
def copy(recorded: tuple[Session, list[Tick]], tmp_path: Path) -> Path:
    copy = tmp_path / "copy.jsonl"
    copy.write_bytes(b"".join(recorded[0].path.read_bytes().splitlines(keepends=True)[:40]))
    return copy


def test_a_torn_last_line_is_left_out(copy: Path) -> None:
    content = copy.read_bytes()
    whole = len(read_session(copy).ticks)
    last = len(content) - content[:-1].rindex(b"\n") - 1
    for cut in (1, 2, last // 2, last - 1):
        copy.write_bytes(content[:-cut])
        session = read_session(copy)
        assert session.torn and len(session.ticks) == whole - 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda line: line[: len(line) // 2], "line 20 is damaged: it is no JSON"),
        (lambda line: b"[]", "line 20 is damaged.*no object"),
        (lambda line: line.replace(b'"time":', b'"tome":'), "line 20 is damaged: KeyError"),
        (lambda line: line.replace(b'"kind":"tick"', b'"kind":"tock"'), "line 20 is damaged"),
        (lambda line: line.replace(b'"joints_commanded":[', b'"joints_commanded":[1.0,'), "line 20 is damaged"),
        (lambda line: line.replace(b'"contact":false', b'"contact":0'), "line 20 is damaged: TypeError"),
        (lambda line: line.replace(b'"log_alpha":[', b'"log_alpha":["big",'), "line 20 is damaged"),
        (lambda line: line.replace(b'"positions":[', b'"positions":[[1,2],'), "line 20 is damaged"),
        (lambda line: b'{"kind":"tick","time":-5,"computing":0,"whole":0}', "line 20 is damaged.*time"),
    ],
)
def test_other_damage_is_refused_naming_the_line(copy: Path, change: object, message: str) -> None:
    lines = copy.read_bytes().split(b"\n")
    changed = change(lines[19])  # pyright: ignore[reportCallIssue]
    assert changed != lines[19]
    copy.write_bytes(b"\n".join([*lines[:19], changed, *lines[20:]]))
    with pytest.raises(UserError, match=message) as caught:
        read_session(copy)
    assert str(copy) in str(caught.value)


def test_what_is_no_session_is_refused(copy: Path, tmp_path: Path) -> None:
    for content, message in (
        (b"", "no whole line"),
        (b"\xff\xfe\n", "line 1 is damaged"),
        (b'{"kind":"tick"}\n', "begins no session"),
        (b'{"kind":"session","version":2}\n', "version is 2; this program reads version 1"),
        (b'{"kind":"session","version":1}\n', "does not say what ran"),
    ):
        copy.write_bytes(content)
        with pytest.raises(UserError, match=message):
            read_session(copy)
    with pytest.raises(UserError, match="cannot be read"):
        read_session(tmp_path / "none.jsonl")


def test_a_file_that_exists_is_not_overwritten(copy: Path, tmp_path: Path) -> None:
    before = copy.read_bytes()
    with pytest.raises(UserError, match="exists and is not overwritten"):
        Recorder(copy, {})
    assert copy.read_bytes() == before
    with pytest.raises(UserError, match="cannot be written"):
        Recorder(tmp_path / "none" / "s.jsonl", {})


def test_on_a_full_disk_recording_stops_and_control_goes_on(model: StreamModel, tmp_path: Path) -> None:
    path = tmp_path / "full.jsonl"
    header = session_header(load_checkpoint(default_checkpoint("demo")), model, "pepper", CONFIG, ("list", "list"))
    source, output = ListInput(stream(load_dataset("demo").test[HANDSHAKE]), pause=0.002), ListOutput()
    recorder = Recorder(path, header)
    loop = LiveLoop(LiveController(model, CONFIG), source, output, make_guard(model), (recorder,))
    with full_disk(100_000):
        loop.run(lambda: False)
    recorder.close()
    assert "stopped" in recorder.trouble and str(path) in recorder.trouble
    assert loop.faults == 0 and loop.controller.interaction == 1 and len(output.sent) > 150
    session = read_session(path)
    assert len(session.ticks) == recorded_lines(path) - 1 > 20


def recorded_lines(path: Path) -> int:
    return path.read_bytes().count(b"\n")


def test_a_disk_that_is_too_slow_stops_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write

    def slow(file: int, line: bytes) -> int:
        time.sleep(0.05)
        return real(file, line)

    recorder = Recorder(tmp_path / "slow.jsonl", {})
    monkeypatch.setattr(os, "write", slow)
    for n in range(QUEUED + 50):
        recorder(Tick(float(n), None, None, None, 0.0, 0.0))
    assert "too slow" in recorder.trouble
    monkeypatch.undo()
    recorder.close()


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from test_live_session import demo_model, run
run(demo_model(), Path({path!r}), (4, 4, 4, 4))
"""


def test_after_kill_9_the_session_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "killed.jsonl"
    script = KILLED.format(tests=str(Path(__file__).parent), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        deadline = time.monotonic() + 60.0
        while not (path.exists() and path.stat().st_size > 300_000) and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    session = read_session(path)
    assert len(session.ticks) > 80 and interactions(session)
    assert len(session.ticks) == recorded_lines(path) - 1
