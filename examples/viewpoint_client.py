"""A camera controller outside surgbench, with nothing but Python's own library: `python viewpoint_client.py PORT`.

It stays straight before the feature, at the wanted distance along its normal. Start first

    surgbench serve-viewpoint --dataset DIR --port PORT

docs/viewpoint-bridge.md says what is said.
"""

import json
import math
import socket
import sys


def naive_pose(feature, distance_m):
    """T_world_camera that looks back along the feature's normal (its y axis), level; metres, z of the world up."""
    normal, place = [row[1] for row in feature[:3]], [row[3] for row in feature[:3]]
    z = [-n for n in normal]
    level = math.hypot(z[0], z[1])
    x = [-z[1] / level, z[0] / level, 0.0] if level > 1e-9 else [0.0, -1.0, 0.0]
    y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]]
    return [[x[k], y[k], z[k], place[k] + distance_m * normal[k]] for k in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def main(port):
    """Answer whatever is asked, until the server hangs up."""
    server = socket.create_connection(("127.0.0.1", port)).makefile("rw", encoding="utf-8")

    def say(**message):
        server.write(json.dumps(message) + "\n")
        server.flush()

    say(type="hello", protocol=1, name="straight")
    for message in map(json.loads, server):
        if message["type"] == "scene":
            distance_m = message["distance_m"]
            say(type="ready", id=message["id"])
        elif message["type"] == "observation":
            pose = naive_pose(message["T_world_feature"], distance_m)
            say(type="command", id=message["id"], pose=pose)


if __name__ == "__main__":
    main(int(sys.argv[1]))
