"""Frames from and commands to ROS, against a stand-in that speaks the rosbridge protocol over the loopback.

The stand-in holds what rosbridge_suite's protocol document says: subscribe, advertise and publish, messages of a
topic only to those who subscribed, publishing only after advertising with one type, `status` for what is refused.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from live_messages import JOINTS, accounted, arrives, command, eventually, frame
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from mild_viz.errors import UserError
from mild_viz.live.inputs import Input, open_input
from mild_viz.live.messages import encode
from mild_viz.live.outputs import Output, open_output


class StandIn:
    """A rosbridge server with one topic table."""

    def __init__(self, port: int = 0) -> None:
        self.types: dict[str, str] = {}
        self.subscribers: dict[str, list[ServerConnection]] = {}
        self.published: dict[str, list[Any]] = {}
        self.connections: list[ServerConnection] = []
        self.server = serve(self._handle, "127.0.0.1", port)
        self.port = self.server.socket.getsockname()[1]
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()

    def _handle(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        advertised: set[str] = set()
        with contextlib.suppress(ConnectionClosed):
            for text in connection:
                message = json.loads(text)
                topic = message["topic"]
                if message["op"] in ("advertise", "subscribe"):
                    if self.types.setdefault(topic, message["type"]) != message["type"]:
                        self._refuse(connection, f"{topic} is of type {self.types[topic]}")
                        continue
                    if message["op"] == "advertise":
                        advertised.add(topic)
                    else:
                        self.subscribers.setdefault(topic, []).append(connection)
                elif message["op"] == "publish":
                    if topic not in advertised:
                        self._refuse(connection, f"{topic} is not advertised")
                        continue
                    self.published.setdefault(topic, []).append(message["msg"])
                else:
                    self._refuse(connection, f"unknown operation {message['op']}")

    @staticmethod
    def _refuse(connection: ServerConnection, text: str) -> None:
        connection.send(json.dumps({"op": "status", "level": "error", "msg": text}))

    def publish(self, topic: str, message: Any) -> None:
        """A node of ROS publishes on a topic."""
        for connection in self.subscribers.get(topic, []):
            connection.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def stop(self) -> None:
        self.server.shutdown()
        for connection in self.connections:
            connection.close()
        self.thread.join()


@pytest.fixture
def ros() -> Iterator[StandIn]:
    server = StandIn()
    yield server
    server.stop()


@contextlib.contextmanager
def subscribed(ros: StandIn, options: str = "", topic: str = "/mild_viz/skeleton") -> Iterator[Input]:
    source = open_input(f"rosbridge://127.0.0.1:{ros.port}{options}")
    try:
        eventually(lambda: ros.subscribers.get(topic))
        yield source
    finally:
        source.close()


@contextlib.contextmanager
def advertised(ros: StandIn, options: str = "", topics: int = 2) -> Iterator[Output]:
    output = open_output(f"rosbridge://127.0.0.1:{ros.port}{options}", JOINTS)
    try:
        eventually(lambda: len(ros.types) == topics)
        yield output
    finally:
        output.close()


def test_frames_arrive_as_json_in_a_string(ros: StandIn) -> None:
    with subscribed(ros) as source:
        assert ros.types == {"/mild_viz/skeleton": "std_msgs/String"} and source.trouble == ""
        ros.publish("/mild_viz/skeleton", {"data": frame(5, coordinates="world").decode()})
        seen = arrives(source)
        assert (seen.sequence, seen.coordinates) == (5, "world")
        assert seen.source == f"rosbridge://127.0.0.1:{ros.port}/mild_viz/skeleton"
        np.testing.assert_array_equal(seen.positions[2], [0.005, -0.2, -0.3])


WRONG_STRINGS = {
    "no text": {"data": 5},
    "nothing": {},
    "no object": ["data"],
    "no JSON": {"data": "hello"},
    "half a character": {"data": "\ud800"},
    "wrong name": {"data": frame(1, joints={"right_wrsit": None}).decode()},
}


def test_unusable_strings_are_counted_and_the_stream_goes_on(ros: StandIn) -> None:
    with subscribed(ros, "?topic=/people/first", "/people/first") as source:
        for message in WRONG_STRINGS.values():
            ros.publish("/people/first", message)
        ros.publish("/people/first", {"data": frame(1).decode()})
        assert arrives(source).sequence == 1
        assert source.counts.rejected == len(WRONG_STRINGS) and accounted(source.counts)
        assert source.counts.last_error.endswith("joint \"right_wrsit\" is unknown; did you mean 'right_wrist'?")


def poses(stamp: dict[str, int], *points: Any, **header: Any) -> dict[str, Any]:
    rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    return {
        "header": {"stamp": stamp, "frame_id": "map", **header},
        "poses": [{"position": dict(zip("xyz", point, strict=True)), "orientation": rotation} for point in points],
    }


ARM = ([0.0, -0.2, 1.4], [0.0, -0.2, 1.1], [0.3, -0.2, 1.1])


@pytest.mark.parametrize(
    ("stamp", "header", "sequence"),
    [({"secs": 12, "nsecs": 250_000_000}, {"seq": 4}, 4), ({"sec": 12, "nanosec": 250_000_000}, {}, None)],
    ids=["ROS 1", "ROS 2"],
)
def test_frames_arrive_as_poses(ros: StandIn, stamp: dict[str, int], header: Any, sequence: int | None) -> None:
    with subscribed(ros, "?type=geometry_msgs/PoseArray") as source:
        assert ros.types == {"/mild_viz/skeleton": "geometry_msgs/PoseArray"}
        ros.publish("/mild_viz/skeleton", poses(stamp, *ARM, **header))
        seen = arrives(source)
        assert (seen.timestamp, seen.sequence, seen.coordinates) == (12.25, sequence, "world")
        assert seen.names == ("right_shoulder", "right_elbow", "right_wrist")
        np.testing.assert_array_equal(seen.positions, ARM)


def test_poses_of_named_joints_of_which_some_are_lost(ros: StandIn) -> None:
    options = "?type=geometry_msgs/PoseArray&coordinates=person&joints=neck,right_wrist,right_elbow,right_shoulder"
    with subscribed(ros, options) as source:
        message = poses({"sec": 1, "nanosec": 0}, [None] * 3, [float("nan"), 0.0, 0.0], ARM[1], ARM[0])
        ros.publish("/mild_viz/skeleton", message)
        seen = arrives(source)
        assert seen.names == ("neck", "right_wrist", "right_elbow", "right_shoulder") and seen.coordinates == "person"
        np.testing.assert_array_equal(seen.positions, [[np.nan] * 3, [np.nan] * 3, ARM[1], ARM[0]])


NOW = {"sec": 5, "nanosec": 0}
WRONG_POSES = {
    "too few": (poses(NOW, ARM[0]), "1 poses; expected: 3: right_shoulder, right_elbow, right_wrist"),
    "millimetres": (poses(NOW, *ARM[:2], [312.0, 0.0, 0.0]), "expected: metres"),
    "texts": (poses(NOW, *ARM[:2], ["a", "b", "c"]), "expected: a number in metres"),
    "no stamp": (poses({"sec": 0, "nanosec": 0}, *ARM), "header.stamp is zero"),
    "half a stamp": (poses({"sec": 5}, *ARM), "is no geometry_msgs/PoseArray (KeyError: 'nsecs')"),
    "a text for a stamp": (poses({"sec": "5", "nanosec": 0}, *ARM), "TypeError"),  # type: ignore[dict-item]
    "endless seconds": (poses({"sec": 10**400, "nanosec": 0}, *ARM), "OverflowError"),
    "no header": ({"poses": []}, "KeyError: 'header'"),
    "a list for a header": ({"header": [], "poses": []}, "AttributeError"),
    "no list": ({"header": {"stamp": NOW}, "poses": 3}, "TypeError"),
    "a list": ([], "TypeError"),
    "nothing": (None, "TypeError"),
}


def test_unusable_poses_are_counted_and_the_stream_goes_on(ros: StandIn) -> None:
    with subscribed(ros, "?type=geometry_msgs/PoseArray") as source:
        for number, (message, expected) in enumerate(WRONG_POSES.values(), 1):
            ros.publish("/mild_viz/skeleton", message)
            eventually(lambda number=number: source.poll(0.0) is not None or source.counts.rejected == number)
            assert expected in source.counts.last_error
        ros.publish("/mild_viz/skeleton", poses(NOW, *ARM))
        assert arrives(source).timestamp == 5.0
        assert accounted(source.counts)


def test_commands_are_published_as_json_and_joint_states(ros: StandIn) -> None:
    with advertised(ros) as output:
        assert ros.types == {
            "/mild_viz/command": "std_msgs/String",
            "/mild_viz/joint_command": "sensor_msgs/JointState",
        }
        output.send(command(1))
        eventually(lambda: len(ros.published) == 2)
    assert ros.published["/mild_viz/command"] == [{"data": encode(command(1)).decode()}]
    (state,) = ros.published["/mild_viz/joint_command"]
    assert (state["name"], state["position"]) == (list(JOINTS), [0.1, 0.001])
    assert state["velocity"] == state["effort"] == []
    stamp = state["header"]["stamp"]
    assert stamp["sec"] == stamp["secs"] == 1_750_000_000  # ROS 1 and ROS 2 each take the fields they know
    assert stamp["nanosec"] == stamp["nsecs"] == pytest.approx(1e9 / 30, abs=300)  # a double's precision by now
    assert (output.counts.sent, output.counts.unheard, output.counts.failed) == (1, 0, 0)


def test_commands_are_published_as_a_trajectory_where_a_topic_is_named(ros: StandIn) -> None:
    options = "?trajectory=/arm_controller/joint_trajectory&states=/states&topic=/json"
    with advertised(ros, options, topics=3) as output:
        assert ros.types["/arm_controller/joint_trajectory"] == "trajectory_msgs/JointTrajectory"
        output.send(command(1))
        eventually(lambda: set(ros.published) == {"/arm_controller/joint_trajectory", "/states", "/json"})
    (trajectory,) = ros.published["/arm_controller/joint_trajectory"]
    assert trajectory["joint_names"] == list(JOINTS)
    (point,) = trajectory["points"]
    assert point["positions"] == [0.1, 0.001]
    assert (point["time_from_start"]["sec"], point["time_from_start"]["nanosec"]) == (0, 100_000_000)
    assert trajectory["header"]["stamp"]["sec"] == 0  # at once


def test_a_bridge_that_comes_back_gets_new_commands_and_none_of_the_old(ros: StandIn) -> None:
    with advertised(ros) as output, subscribed(ros) as source:
        output.send(command(1))
        eventually(lambda: output.counts.sent == 1)
        ros.stop()
        eventually(lambda: output.trouble and source.trouble)
        for number in range(2, 12):
            output.send(command(number))
        eventually(lambda: output.counts.unheard + output.counts.dropped == 10)
        again = StandIn(ros.port)
        try:
            # roslibpy waits a second before it tries, and another before it subscribes.
            eventually(lambda: not output.trouble and not source.trouble, within=10)
            output.send(command(12))
            eventually(lambda: len(again.published.get("/mild_viz/joint_command", [])) == 1)
            eventually(lambda: again.subscribers, within=10)
            assert [json.loads(each["data"])["sequence"] for each in again.published["/mild_viz/command"]] == [12]
            again.publish("/mild_viz/skeleton", {"data": frame(3).decode()})
            assert arrives(source).sequence == 3
        finally:
            output.close()
            source.close()
            again.stop()


def test_what_the_bridge_complains_about_is_shown(ros: StandIn) -> None:
    ros.types["/mild_viz/command"] = "std_msgs/Float64"
    with advertised(ros) as output:
        eventually(lambda: "/mild_viz/command is of type std_msgs/Float64" in output.counts.last_error)


def test_a_bridge_that_is_not_there_holds_nobody() -> None:
    output, source = open_output("rosbridge://127.0.0.1:1", JOINTS), open_input("rosbridge://127.0.0.1:1")
    output.send(command(1))
    eventually(lambda: output.counts.unheard == 1)
    assert source.poll(0.0) is None
    assert output.trouble == "rosbridge://127.0.0.1:1: not connected yet" and source.trouble
    output.close()
    source.close()


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "roslibpy", None)
    for opening in (lambda: open_input("rosbridge://127.0.0.1:1"), lambda: open_output("rosbridge://h:1", JOINTS)):
        with pytest.raises(UserError, match=r"needs the package roslibpy: pip install 'mild-viz\[ros\]'"):
            opening()


WRONG_INPUTS = {
    "rosbridge://127.0.0.1": "has no host and port; expected: rosbridge://HOST:PORT",
    "rosbridge://127.0.0.1:9090?topics=/a": "did you mean 'topic'?",
    "rosbridge://127.0.0.1:9090?topic=a": "topic is 'a'; expected: a topic, such as /mild_viz/skeleton",
    "rosbridge://127.0.0.1:9090?type=std_msgs/Strin": "valid: std_msgs/String, geometry_msgs/PoseArray",
    "rosbridge://127.0.0.1:9090?joints=neck": "joints and coordinates belong to type=geometry_msgs/PoseArray",
    "rosbridge://127.0.0.1:9090?type=geometry_msgs/PoseArray&joints=neck": "joints has no 'right_shoulder'",
    "rosbridge://127.0.0.1:9090?type=geometry_msgs/PoseArray&joints=neck,neck": "joints names one twice",
    "rosbridge://127.0.0.1:9090?type=geometry_msgs/PoseArray&joints=nek": "did you mean 'neck'?",
    "rosbridge://127.0.0.1:9090?type=geometry_msgs/PoseArray&coordinates=map": "valid: world, person",
}


@pytest.mark.parametrize("spec", WRONG_INPUTS)
def test_wrong_addresses_are_refused(spec: str) -> None:
    with pytest.raises(UserError) as refusal:
        open_input(spec)
    assert WRONG_INPUTS[spec] in str(refusal.value)
    with pytest.raises(UserError, match="states is 'x'; expected: a topic"):
        open_output("rosbridge://127.0.0.1:9090?states=x", JOINTS)
