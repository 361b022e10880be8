"""Messages of the live interface: what is read, what is refused and how, agreement with the JSON Schemas."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.errors import UserError
from mild_viz.live.messages import JOINTS, MAX_BYTES, JointCommand, Observation, decode, encode, read

DOCS = Path(__file__).resolve().parents[1] / "docs"
ARM = {"right_shoulder": [0.0, -0.2, 0.1], "right_elbow": [0.1, -0.25, -0.2], "right_wrist": [0.3, -0.2, -0.1]}
FRAME = {"version": 1, "type": "skeleton", "timestamp": 12.5, "coordinates": "person", "joints": ARM}


def schema(name: str) -> jsonschema.Draft202012Validator:
    document = json.loads((DOCS / "live" / f"{name}.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(document)
    return jsonschema.Draft202012Validator(document)


def frame(**changed: Any) -> dict[str, Any]:
    return {**FRAME, **changed}


def joints(**changed: Any) -> dict[str, Any]:
    return frame(joints={**ARM, **changed})


def lacking(name: str) -> dict[str, Any]:
    return {key: value for key, value in FRAME.items() if key != name}


def decoded(message: Any) -> Observation:
    return decode(json.dumps(message).encode(), 3.0, "test")


GOOD = {
    "least": FRAME,
    "sequence": frame(sequence=0),
    "sequence as a whole float": frame(sequence=7.0),
    "largest sequence": frame(sequence=2**53 - 1),
    "no sequence": frame(sequence=None),
    "version as a float": frame(version=1.0),
    "whole timestamp": frame(timestamp=5),
    "clock before zero": frame(timestamp=-3.25),
    "world": frame(coordinates="world"),
    "a person": frame(person="2"),
    "no person": frame(person=None),
    "whole numbers": joints(head=[0, 0, 1]),
    "arm lost": frame(joints=dict.fromkeys(ARM)),
    "every joint": frame(joints={name: [0.1, 0.2, 0.3] for name in JOINTS}),
    "farthest": joints(right_wrist=[100, -100.0, 100]),
}

BAD = {
    "an array": ([FRAME], "expected: a JSON object"),
    "a text": ("skeleton", "expected: a JSON object"),
    "null": (None, "the message is null"),
    "no version": (lacking("version"), "lacks: version"),
    "no timestamp": (lacking("timestamp"), "lacks: timestamp"),
    "no joints": (lacking("joints"), "lacks: joints"),
    "no coordinates": (lacking("coordinates"), "lacks: coordinates"),
    "version 2": (frame(version=2), "version is 2; this program reads version 1"),
    "version true": (frame(version=True), "version is true"),
    "version as text": (frame(version="1"), 'version is "1"'),
    "a command": (frame(type="command"), 'expected: "skeleton"'),
    "type of an array": (frame(type=["skeleton"]), "type is an array of 1"),
    "unknown field": (frame(seqence=1), "\"seqence\" is unknown; did you mean 'sequence'?"),
    "timestamp as text": (frame(timestamp="12.5"), "expected: a number in seconds"),
    "timestamp true": (frame(timestamp=True), "timestamp is true"),
    "timestamp null": (frame(timestamp=None), "timestamp is null"),
    "milliseconds since 1970": (frame(timestamp=1.76e12), "expected: seconds"),
    "a huge timestamp": (frame(timestamp=10**400), "timestamp is a huge number"),
    "sequence -1": (frame(sequence=-1), "expected: a whole number from 0"),
    "sequence 1.5": (frame(sequence=1.5), "sequence is 1.5"),
    "sequence 2^53": (frame(sequence=2**53), "2^53 - 1"),
    "sequence true": (frame(sequence=True), "sequence is true"),
    "coordinates camera": (frame(coordinates="camera"), "valid: person, world"),
    "coordinates null": (frame(coordinates=None), "coordinates is null"),
    "coordinates of an object": (frame(coordinates={}), "coordinates is an object of 0"),
    "person 2": (frame(person=2), "person is 2"),
    "person of nothing": (frame(person=""), "1 to 64"),
    "person too long": (frame(person="x" * 65), "1 to 64"),
    "half a character": (frame(person="\ud800"), "printable ASCII"),
    "person with a line break": (frame(person="me\n"), "printable ASCII"),
    "joints of an array": (frame(joints=[0, 1, 2]), "joints is an array of 3"),
    "no wrist": (frame(joints={"right_shoulder": None, "right_elbow": None}), "joints has no 'right_wrist'"),
    "no joints at all": (frame(joints={}), "joints has no 'right_shoulder'"),
    "wrong name": (joints(RightWrist=[0, 0, 0]), "joint \"RightWrist\" is unknown; did you mean 'right_wrist'?"),
    "foreign name": (joints(qqq=[0, 0, 0]), "valid: head, neck"),
    "endless name": (joints(**{"right_wris" + "t" * 9000: None}), "is unknown"),
    "two numbers": (joints(right_wrist=[0, 0]), "joint 'right_wrist' is an array of 2"),
    "four numbers": (joints(right_wrist=[0, 0, 0, 0]), "an array of 4"),
    "a number": (joints(right_wrist=0.0), "joint 'right_wrist' is 0.0"),
    "by name": (joints(right_wrist={"x": 0, "y": 0, "z": 0}), "an object of 3"),
    "null inside": (joints(right_wrist=[0, None, 0]), "a coordinate of joint 'right_wrist' is null"),
    "true inside": (joints(right_wrist=[0, True, 0]), "is true"),
    "text inside": (joints(right_wrist=[0, "0", 0]), "expected: a number in metres"),
    "millimetres": (joints(right_wrist=[312.0, -205.0, -90.0]), "expected: metres, within ±100"),
    "huge": (joints(right_wrist=[0, 10**300, 0]), "a huge number"),
}

UNREADABLE = {
    "nothing": (b"", "no JSON"),
    "bytes": (bytes(range(256)), "no JSON"),
    "half a message": (json.dumps(FRAME).encode()[:-1], "no JSON"),
    "two messages": (json.dumps(FRAME).encode() * 2, "Extra data"),
    "UTF-16": (json.dumps(FRAME).encode("utf-16"), "utf-8"),
    "a byte-order mark": (json.dumps(FRAME).encode("utf-8-sig"), "no JSON"),
    "NaN": (json.dumps(joints(right_wrist=[0, float("nan"), 0])).encode(), "NaN is no JSON number; null stands"),
    "Infinity": (json.dumps(frame(timestamp=float("inf"))).encode(), "Infinity is no JSON number"),
    "infinite by its exponent": (json.dumps(FRAME).replace("12.5", "1e999").encode(), "within ±1e+11"),
    "more digits than Python reads": (json.dumps(FRAME).replace("12.5", "9" * 5000).encode(), "no JSON"),
    "nested arrays": (b"[" * MAX_BYTES, "nested too deeply"),
    "nested objects": (b'{"joints":' * (MAX_BYTES // 10), "nested too deeply"),
    "too long": (json.dumps(FRAME).encode() + b" " * MAX_BYTES, "longer than 16384 bytes"),
}


@pytest.mark.parametrize("name", GOOD)
def test_good_frames_are_read_as_the_schema_says(name: str) -> None:
    message = GOOD[name]
    schema("skeleton").validate(message)
    seen = decoded(message)
    assert (seen.received, seen.source) == (3.0, "test")
    assert seen.timestamp == message["timestamp"]
    assert seen.sequence == message.get("sequence")
    assert (seen.coordinates, seen.person) == (message["coordinates"], message.get("person"))
    assert seen.names == tuple(message["joints"])
    expected = [[np.nan] * 3 if point is None else point for point in message["joints"].values()]
    np.testing.assert_array_equal(seen.positions, np.array(expected, np.float64))
    assert not seen.positions.flags.writeable


@pytest.mark.parametrize("name", BAD)
def test_bad_frames_are_refused_as_the_schema_says(name: str) -> None:
    message, expected = BAD[name]
    assert not schema("skeleton").is_valid(message)
    with pytest.raises(UserError) as refusal:
        decoded(message)
    assert expected in str(refusal.value)
    assert str(refusal.value).isprintable() and len(str(refusal.value)) < 600
    with pytest.raises(UserError, match="^" + str(refusal.value)[:9]):
        read(message, 3.0, "test")


@pytest.mark.parametrize("name", UNREADABLE)
def test_what_is_no_message_is_refused(name: str) -> None:
    payload, expected = UNREADABLE[name]
    with pytest.raises(UserError) as refusal:
        decode(payload, 3.0, "test")
    assert expected in str(refusal.value)


PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
ANY_JSON = st.recursive(
    PLAIN, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4)
)
NEARLY = st.fixed_dictionaries(
    {},
    optional={
        "version": st.just(1) | ANY_JSON,
        "type": st.just("skeleton") | ANY_JSON,
        "timestamp": st.floats(-1e12, 1e12) | ANY_JSON,
        "sequence": st.integers() | ANY_JSON,
        "coordinates": st.sampled_from(["person", "world"]) | ANY_JSON,
        "person": st.text(max_size=3) | ANY_JSON,
        "joints": st.dictionaries(
            st.sampled_from(JOINTS) | st.text(max_size=5), st.lists(st.floats(-200, 200), max_size=4) | ANY_JSON
        ),
    },
).map(lambda changed: {**FRAME, **changed})


def outcome(payload: bytes) -> bool:
    """Whether a payload is read; anything but a UserError fails the test."""
    try:
        seen = decode(payload, 0.0, "test")
    except UserError as error:
        assert str(error).isprintable()
        return False
    assert np.isfinite(seen.timestamp) and not np.isinf(seen.positions).any()
    return True


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_no_bytes_do_more_than_be_refused(payload: bytes) -> None:
    assert not outcome(payload)


@given(ANY_JSON)
@settings(max_examples=200, deadline=None)
def test_no_json_does_more_than_be_refused(message: Any) -> None:
    assert not outcome(json.dumps(message).encode())


@given(NEARLY)
@settings(max_examples=300, deadline=None)
def test_near_frames_are_read_exactly_where_the_schema_allows_them(message: Any) -> None:
    payload = json.dumps(message)
    try:
        parsed = json.loads(payload, parse_constant=refuse_constant)
    except ValueError:
        parsed = None
    assert outcome(payload.encode()) == (parsed is not None and schema("skeleton").is_valid(parsed))


def refuse_constant(name: str) -> None:
    raise ValueError(name)  # Python reads NaN and Infinity, which are no JSON, and unknown to schemas


COMMAND = JointCommand(
    timestamp=1.75e9 + 0.125,
    sequence=41,
    observed=12.5,
    joint_names=("RShoulderPitch", "RElbowRoll"),
    positions=np.array([0.5, 1.0]),
    stiffness=np.array([1.0, 0.25]),
    phase="contact",
    contact=True,
    fired=("contact", "no way back"),
)


@pytest.mark.parametrize("command", [COMMAND, dataclasses.replace(COMMAND, observed=None, contact=False, fired=())])
def test_commands_are_written_as_the_schema_says(command: JointCommand) -> None:
    payload = encode(command)
    message = json.loads(payload)
    schema("command").validate(message)
    assert b"\n" not in payload
    assert message["positions"] == {"RShoulderPitch": 0.5, "RElbowRoll": 1.0}
    assert message["stiffness"] == {"RShoulderPitch": 1.0, "RElbowRoll": 0.25}
    assert (message["observed"], message["contact"]) == (command.observed, command.contact)
    assert (message["timestamp"], message["sequence"]) == (command.timestamp, 41)
    assert (message["phase"], tuple(message["fired"])) == ("contact", command.fired)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_that_is_not_finite_is_not_written(value: float) -> None:
    with pytest.raises(UserError, match="command 41 holds a number that is not finite"):
        encode(dataclasses.replace(COMMAND, positions=np.array([0.5, value])))


def test_the_documented_examples_are_valid() -> None:
    """The JSON blocks of docs/live.md are what the schemas and the program take."""
    blocks = (DOCS / "live.md").read_text().split("```json\n")[1:]
    messages = [json.loads(block.split("```")[0]) for block in blocks]
    assert [message["type"] for message in messages] == ["skeleton", "command"]
    schema("skeleton").validate(messages[0])
    decoded(messages[0])
    schema("command").validate(messages[1])
