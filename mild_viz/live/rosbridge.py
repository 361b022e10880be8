"""ROS, by way of a rosbridge server: frames from a topic, commands to topics (package roslibpy, extra `ros`).

Works with ROS 1 and 2: types are named as both know them, and times carry both spellings of their fields.
"""

from __future__ import annotations

import contextlib
import logging
from typing import Any

from mild_viz.data.skeletons import ARM_JOINTS
from mild_viz.errors import UserError
from mild_viz.live.address import Address, check_options
from mild_viz.live.inputs import FedInput
from mild_viz.live.messages import COORDINATES, VERSION, JointCommand, Observation, decode, encode, read
from mild_viz.live.outputs import QueuedOutput

STRING, POSES = "std_msgs/String", "geometry_msgs/PoseArray"

SKELETON_TOPIC = "/mild_viz/skeleton"
COMMAND_TOPIC = "/mild_viz/command"
STATES_TOPIC = "/mild_viz/joint_command"
"""Topics where the address names no others."""

ARRIVAL = 0.1
"""When a point of a trajectory is to be reached, after it is received [s]."""

MAX_WAITING = 65536
"""Bytes that may wait for the server before commands are dropped."""

LONGEST_PAUSE = 2.0
"""Between attempts to connect [s]."""


class Bridge:
    """A connection to a rosbridge server, which roslibpy keeps up in a thread of its own."""

    def __init__(self, address: Address, owner: FedInput | QueuedOutput) -> None:
        try:
            import roslibpy
        except ImportError:
            raise UserError(f"{address.text} needs the package roslibpy: pip install 'mild-viz[ros]'") from None
        logger = logging.getLogger("roslibpy")
        logger.propagate = False  # what goes wrong is counted; its tracebacks belong on nobody's terminal
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
        self._library = roslibpy
        self._owner = owner
        self._owner.trouble = f"{owner.name}: not connected yet"
        self._protocol: Any = None
        self._closed = False
        # Not roslibpy's own choice, Twisted: its loop cannot be started again in the same process.
        self._ros: Any = roslibpy.Ros(address.host, address.port, transport="asyncio")
        self._ros.factory.maxDelay = LONGEST_PAUSE
        self._ros.factory.on_ready(self._ready)
        self._ros.on("ready", self._ready)
        self._ros.on("close", self._lost)

    def _ready(self, protocol: Any) -> None:
        self._protocol = protocol
        # roslibpy knows no handler for the server's complaints, such as a type that does not fit the topic.
        protocol._message_handlers["status"] = self._complain
        self._owner.trouble = ""
        if self._closed:
            protocol.send_close()

    def _lost(self, _: Any) -> None:
        self._owner.trouble = f"{self._owner.name}: the connection was lost"

    def _complain(self, message: Any) -> None:
        self._owner.counts.last_error = f"{self._owner.name}: {str(message.get('msg'))[:200]}"

    @property
    def connected(self) -> bool:
        return bool(self._ros.is_connected)

    @property
    def waiting(self) -> int:
        """Bytes that the server has not taken yet."""
        transport = getattr(self._protocol, "transport", None)
        return 0 if transport is None else transport.get_write_buffer_size()

    def topic(self, name: str, kind: str, published: bool) -> Any:
        """A topic to publish on, or to subscribe to. After the connection was lost it is named to the server again."""
        # What is published is named again with the next message; roslibpy's own way takes a second longer.
        return self._library.Topic(
            self._ros, name, kind, queue_size=1, queue_length=1, reconnect_on_close=not published
        )

    def close(self) -> None:
        """Disconnect, and try no more."""
        self._closed = True
        self._ros.factory.maxRetries = 0
        with contextlib.suppress(TimeoutError):  # it was lost meanwhile
            self._ros.close(timeout=2)


class RosbridgeInput(FedInput):
    """Frames from one topic: our JSON in a String, or a PoseArray with one pose a joint, in the order of `joints`."""

    def __init__(self, address: Address) -> None:
        check_options(address, ("topic", "type", "joints", "coordinates"))
        self._type = address.choice("type", (STRING, POSES))
        if self._type == STRING and {"joints", "coordinates"} & address.options.keys():
            raise UserError(f"{address.text}: joints and coordinates belong to type={POSES}; {STRING} carries its own")
        self._coordinates = address.choice("coordinates", COORDINATES[::-1])
        self._joints = tuple(address.options.get("joints", ",".join(ARM_JOINTS)).split(","))
        if len(set(self._joints)) < len(self._joints):
            raise UserError(f"{address.text}: joints names one twice")
        # Refuses wrong joint names now rather than with every message.
        read(self._frame(0.0, None, dict.fromkeys(self._joints)), 0.0, address.text)
        topic = topic_option(address, "topic", SKELETON_TOPIC)
        super().__init__(f"rosbridge://{address.host}:{address.port}{topic}")
        self._bridge = Bridge(address, self)
        self._topic = self._bridge.topic(topic, self._type, published=False)
        self._topic.subscribe(lambda message: self._feed(message, self.name))

    def _decode(self, payload: Any, received: float, source: str) -> Observation:
        if self._type == STRING:
            text = payload.get("data") if isinstance(payload, dict) else None
            if not isinstance(text, str):
                raise UserError(f"the message has no text 'data'; expected: a {STRING}")
            return decode(text.encode("utf-8", "replace"), received, source)
        return read(self._of_poses(payload), received, source)

    def _of_poses(self, payload: Any) -> dict[str, Any]:
        try:
            header, poses = payload["header"], payload["poses"]
            sequence = header.get("seq")  # ROS 1 only
            stamp = header["stamp"]
            seconds = stamp["sec"] if "sec" in stamp else stamp["secs"]
            timestamp = seconds + 1e-9 * (stamp["nanosec"] if "nanosec" in stamp else stamp["nsecs"])
            points = [[pose["position"][axis] for axis in "xyz"] for pose in poses]
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise UserError(f"the message is no {POSES} ({type(error).__name__}: {str(error)[:60]})") from None
        if timestamp == 0:
            raise UserError("header.stamp is zero; expected: when the person was seen")
        if len(points) != len(self._joints):
            raise UserError(f"{len(points)} poses; expected: {len(self._joints)}: {', '.join(self._joints)}")
        # rosbridge writes NaN, which marks a lost joint, as null or as it is.
        lost = [any(value is None or value != value for value in point) for point in points]
        joints = {name: None if gone else point for name, point, gone in zip(self._joints, points, lost, strict=True)}
        return self._frame(timestamp, sequence, joints)

    def _frame(self, timestamp: float, sequence: int | None, joints: dict[str, Any]) -> dict[str, Any]:
        return {
            "version": VERSION,
            "type": "skeleton",
            "timestamp": timestamp,
            "sequence": sequence,
            "coordinates": self._coordinates,
            "joints": joints,
        }

    def close(self) -> None:
        super().close()
        self._bridge.close()


class RosbridgeOutput(QueuedOutput):
    """Each command as JSON in a String, as a JointState, and as a JointTrajectory where a topic is named for it."""

    def __init__(self, address: Address, joint_names: tuple[str, ...]) -> None:
        check_options(address, ("topic", "states", "trajectory"))
        topic = topic_option(address, "topic", COMMAND_TOPIC)
        states = topic_option(address, "states", STATES_TOPIC)
        trajectory = topic_option(address, "trajectory", "")
        super().__init__(f"rosbridge://{address.host}:{address.port}", joint_names, queued=8)
        self._bridge = Bridge(address, self)
        self._json = self._bridge.topic(topic, STRING, published=True)
        self._states = self._bridge.topic(states, "sensor_msgs/JointState", published=True)
        self._trajectory = None
        if trajectory:
            self._trajectory = self._bridge.topic(trajectory, "trajectory_msgs/JointTrajectory", published=True)
        for each in (self._json, self._states, self._trajectory):
            if each is not None:
                each.advertise()
        self._thread.start()

    def _write(self, command: JointCommand) -> None:
        text = encode(command).decode()
        self.counts.receivers = int(self._bridge.connected)
        # roslibpy keeps what is published meanwhile and sends it all on connecting: a robot would play the past.
        if not self._bridge.connected:
            self.counts.unheard += 1
            return
        if self._bridge.waiting > MAX_WAITING:
            self.counts.dropped += 1
            return
        names, positions = list(command.joint_names), command.positions.tolist()
        self._json.publish({"data": text})
        self._states.publish(
            {
                "header": {"stamp": _time(command.timestamp), "frame_id": ""},
                "name": names,
                "position": positions,
                "velocity": [],
                "effort": [],
            }
        )
        if self._trajectory is not None:
            point = {"positions": positions, "time_from_start": _time(ARRIVAL)}
            # A stamp of zero: start on receipt.
            self._trajectory.publish(
                {"header": {"stamp": _time(0.0), "frame_id": ""}, "joint_names": names, "points": [point]}
            )
        self.counts.sent += 1

    def close(self) -> None:
        super().close()
        self._bridge.close()


def topic_option(address: Address, option: str, default: str) -> str:
    """The name of a topic, absolute."""
    name = address.options.get(option, default)
    if name != default and not (name.startswith("/") and name.isascii() and name.replace("/", "_").isidentifier()):
        raise UserError(f"{address.text}: {option} is '{name}'; expected: a topic, such as {SKELETON_TOPIC}")
    return name


def _time(seconds: float) -> dict[str, int]:
    """A time or duration [s] with the fields of ROS 1 (secs, nsecs) and of ROS 2; rosbridge takes those it knows."""
    whole = int(seconds)
    rest = int((seconds - whole) * 1e9)
    return {"secs": whole, "nsecs": rest, "sec": whole, "nanosec": rest}
