"""Receive joint commands of `mild-viz live --output udp://127.0.0.1:9871` and print them.

A robot's own program does the same and moves its joints. The format: docs/live.md.
"""

import json
import socket
import sys

HOST, PORT = "127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 9871
COMMANDS = int(sys.argv[2]) if len(sys.argv) > 2 else None  # how many; without it, for ever

receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind((HOST, PORT))
receiver.settimeout(0.5)
print(f"listening at udp://{HOST}:{PORT}", flush=True)
last = received = 0
while COMMANDS is None or received < COMMANDS:
    try:
        command = json.loads(receiver.recv(65536))
    except TimeoutError:
        print("no command for half a second: a robot should hold still now", flush=True)
        continue
    if command["version"] != 1 or command["type"] != "command":
        sys.exit(f"this program reads commands of version 1, not {command['type']} of version {command['version']}")
    if received and 0 <= last - command["sequence"] < 100:
        continue  # it came late, or twice; a number that is far lower is another run's
    last, received = command["sequence"], received + 1
    # stiffness, 0 to 1, goes to the same joints
    joints = "  ".join(f"{name} {angle:+.3f}" for name, angle in command["positions"].items())
    print(f"{command['sequence']:6d}  {command['phase']:8s}  {joints} rad", flush=True)
