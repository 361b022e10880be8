"""Send skeleton frames to `mild-viz live --input udp://127.0.0.1:9870`: a person who reaches out, again and again.

A tracker's own program does the same with the joints that it sees. The format: docs/live.md.
"""

import json
import math
import socket
import sys
import time

HOST, PORT, RATE = "127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 9870, 30
FRAMES = int(sys.argv[2]) if len(sys.argv) > 2 else 60 * RATE
UPPER_ARM, FOREARM = 0.30, 0.26  # metres

out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for sequence in range(FRAMES):
    # 2 s at rest, 1 s forward, 2 s held, 1 s back: how far the arm is raised, 0 to 1
    time_in_turn = sequence / RATE % 6
    raised = 0.5 - 0.5 * math.cos(math.pi * min(max(time_in_turn - 2, 0), max(6 - time_in_turn, 0), 1))
    upper, fore = 0.1 + 0.6 * raised, 0.3 + 1.2 * raised  # from hanging down [rad]
    shoulder = [0.0, -0.18, -0.02]  # x forward, y to the person's left, z up; from between the shoulders
    elbow = [shoulder[0] + UPPER_ARM * math.sin(upper), -0.2, shoulder[2] - UPPER_ARM * math.cos(upper)]
    wrist = [elbow[0] + FOREARM * math.sin(fore), -0.2, elbow[2] - FOREARM * math.cos(fore)]
    frame = {
        "version": 1,
        "type": "skeleton",
        "timestamp": time.time(),
        "sequence": sequence,
        "coordinates": "person",
        "joints": {"right_shoulder": shoulder, "right_elbow": elbow, "right_wrist": wrist},
    }
    out.sendto(json.dumps(frame).encode(), (HOST, PORT))
    time.sleep(1 / RATE)
