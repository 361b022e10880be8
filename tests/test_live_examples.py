"""The example programs, run as a person runs them."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
from live_messages import JOINTS, arrives, command

from mild_viz.live.inputs import open_input
from mild_viz.live.outputs import open_output

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def free_port() -> int:
    opened = open_input("udp://127.0.0.1:0")
    opened.close()
    return int(opened.name.rpartition(":")[2])


def test_the_example_sender_sends_usable_frames() -> None:
    source = open_input("udp://127.0.0.1:0")
    program = [sys.executable, EXAMPLES / "send_skeleton.py", source.name.rpartition(":")[2], "90"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as sender:
        seen = []
        while not seen or seen[-1].sequence != 89:
            seen.append(arrives(source))
        assert sender.communicate(timeout=5)[0] == "" and sender.returncode == 0
    source.close()
    assert source.counts.rejected == source.counts.reordered == 0
    arms = np.stack([each.positions for each in seen])
    lengths = np.linalg.norm(np.diff(arms, axis=1), axis=2)
    np.testing.assert_allclose(lengths, [[np.hypot(0.3, 0.02), 0.26]] * len(seen), atol=1e-9)  # an arm is stiff
    moved = np.linalg.norm(arms[:, 2] - arms[0, 2], axis=1)
    resting = [each.sequence is not None and each.sequence < 60 for each in seen]
    assert moved[resting].max() == 0 and moved[-1] > 0.3  # two seconds of rest, then it reaches out


def test_the_example_receiver_prints_what_is_sent() -> None:
    port = free_port()
    program = [sys.executable, EXAMPLES / "receive_commands.py", str(port), "3"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as receiver:
        assert receiver.stdout is not None
        assert receiver.stdout.readline() == f"listening at udp://127.0.0.1:{port}\n"
        output = open_output(f"udp://127.0.0.1:{port}", JOINTS)
        for number in (4, 5, 5, 3, 6):
            output.send(command(number))
        assert receiver.stdout.read().splitlines() == [
            f"     {number}  reach     RShoulderPitch +0.100  RElbowRoll +0.00{number} rad" for number in (4, 5, 6)
        ]
        assert receiver.wait(5) == 0
    output.close()


def test_the_example_receiver_says_when_nothing_comes_and_when_it_understands_nothing() -> None:
    port = free_port()
    program = [sys.executable, EXAMPLES / "receive_commands.py", str(port)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as receiver:
        assert receiver.stdout is not None
        receiver.stdout.readline()
        assert receiver.stdout.readline() == "no command for half a second: a robot should hold still now\n"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b'{"version": 2, "type": "command"}', ("127.0.0.1", port))
        assert "reads commands of version 1, not command of version 2" in receiver.stdout.read()
        assert receiver.wait(5) == 1


def test_examples_use_nothing_but_the_standard_library_and_are_short() -> None:
    for path in EXAMPLES.glob("*.py"):
        lines = path.read_text().splitlines()
        imported = {line.split()[1] for line in lines if line.startswith(("import ", "from "))}
        assert imported and imported <= sys.stdlib_module_names
        assert len(lines) <= 40
