"""A ROS 2 node that lets a controller of surgbench hold the camera of a da Vinci arm (dVRK; topics as CRTK has them).

    surgbench serve-viewpoint --tracker gaze --port 5555
    python viewpoint_node.py --ros-args -p port:=5555 -p scene:=scene.json

It needs rclpy and the common messages, and of surgbench nothing but the socket. `scene.json` is the message `scene` of
docs/viewpoint-bridge.md without `type`, `id` and `joints`: the rules, and where the camera arm's base is in the frame
in which the tool's `measured_cp` is given.

Every `dt_s` it sends the newest feature and joints, and publishes what comes back as `servo_jp` or `move_jp`. Where
anything is missing or older than `stale_s`, or no answer comes within `dt_s`, it holds: one `move_jp` to where the arm
comes to rest, and nothing more until all is there again.
"""

import json
import math
import socket
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

JOINTS = 6
# What a PSM's joints brake with, rad/s^2 and m/s^2: dVRK's limits for `move_jp`.
BRAKES = (1.571, 1.571, 0.2, 12.57, 12.57, 12.57)


class Server:
    """The other end of the bridge."""

    def __init__(self, port):
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._held, self._asked = b"", 0
        self._send({"type": "hello", "protocol": 1, "name": "viewpoint-node"})
        self._next(time.monotonic() + 5.0)

    def ask(self, question, patience_s):
        """The answer to a question; raises OSError where none comes in time, ValueError where it is an error."""
        self._asked += 1
        self._send({**question, "id": self._asked})
        deadline = time.monotonic() + patience_s
        while (answer := self._next(deadline)).get("id") != self._asked:
            pass  # to an earlier question, too late
        if answer["type"] == "error":
            raise ValueError(answer["error"])
        return answer

    def _send(self, message):
        self._socket.sendall(json.dumps(message, allow_nan=False).encode() + b"\n")

    def _next(self, deadline):
        while b"\n" not in self._held:
            self._socket.settimeout(max(1e-3, deadline - time.monotonic()))
            more = self._socket.recv(1 << 16)
            if not more:
                raise ConnectionError("the server hung up")
            self._held += more
        line, _, self._held = self._held.partition(b"\n")
        return json.loads(line)


class Newest:
    """The newest of a topic's messages, and when it came."""

    def __init__(self, read):
        self._read, self.value, self._came = read, None, -math.inf

    def __call__(self, message):
        """Take a message in; one with numbers missing or not finite is none."""
        value = self._read(message)
        if value is not None:
            self.value, self._came = value, time.monotonic()

    def fresh(self, stale_s):
        """It, or None where it is too old."""
        return self.value if time.monotonic() - self._came <= stale_s else None


def read_joints(message):
    """Positions and velocities."""
    position, velocity = list(message.position), list(message.velocity)
    good = len(position) == len(velocity) == JOINTS and all(map(math.isfinite, position + velocity))
    return (position, velocity) if good else None


def where_they_rest(position, velocity):
    """Where joints come to rest that brake as hard as they can; limits are for `move_jp` to keep."""
    return [q + v * abs(v) / (2 * a) for q, v, a in zip(position, velocity, BRAKES, strict=True)]


def read_ring(message, ring_m):
    """T_world_feature of a ring that the tool holds `ring_m` ahead of its tip: its normal is the tool's y axis."""
    p, q = message.pose.position, message.pose.orientation
    length = math.sqrt(q.w**2 + q.x**2 + q.y**2 + q.z**2)
    if not (math.isfinite(p.x + p.y + p.z + length) and length > 0.5):
        return None
    w, x, y, z = q.w / length, q.x / length, q.y / length, q.z / length
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return [[*row, at + ring_m * row[2]] for row, at in zip(turn, (p.x, p.y, p.z), strict=True)] + [[0, 0, 0, 1]]


class ViewpointNode(Node):
    """Feature and joints in, commands out."""

    def __init__(self):
        super().__init__("viewpoint")
        port = self.declare_parameter("port", 5555).value
        self._scene = json.loads(Path(self.declare_parameter("scene", "scene.json").value).read_text(encoding="utf-8"))
        tool = self.declare_parameter("tool", "PSM1").value
        arm = self.declare_parameter("arm", "PSM3").value
        ring_m = self.declare_parameter("ring_m", 0.033).value
        self._stale_s = self.declare_parameter("stale_s", 0.1).value
        self._server, self._begun, self._holds, self._index = Server(port), False, False, 0
        self._ring = Newest(lambda message: read_ring(message, ring_m))
        self._measured, self._setpoint = Newest(read_joints), Newest(read_joints)
        self.create_subscription(PoseStamped, f"/{tool}/measured_cp", self._ring, 1)
        self.create_subscription(JointState, f"/{arm}/measured_js", self._measured, 1)
        self.create_subscription(JointState, f"/{arm}/setpoint_js", self._setpoint, 1)
        self._to = {mode: self.create_publisher(JointState, f"/{arm}/{mode}_jp", 1) for mode in ("servo", "move")}
        self.create_timer(self._scene["dt_s"], self.step)

    def step(self):
        """One period."""
        measured, setpoint = self._measured.fresh(self._stale_s), self._setpoint.fresh(self._stale_s)
        if measured is None or setpoint is None:
            self._hold("no joints of the camera arm")
            return
        try:
            if not self._begun:
                self._server.ask({"type": "scene", **self._scene, "joints": measured[0]}, 5.0)
                self._begun = True
            observation = {
                "type": "observation",
                "index": self._index,
                "timestamp_s": self._index * self._scene["dt_s"],
                "T_world_feature": self._ring.fresh(self._stale_s),
                "joints": measured[0],
                "setpoint": setpoint[0],
                "setpoint_velocity": setpoint[1],
            }
            self._index += 1
            command = self._server.ask(observation, self._scene["dt_s"])
        except (OSError, ValueError) as error:
            self._hold(str(error))
            return
        if command["held"]:
            self._hold(command["held"], command["joints"])
        else:
            self._holds = False
            self._publish(command["mode"], command["joints"], command["velocity"] or [])

    def _hold(self, why, rest=None):
        """Let the arm come to rest, once: at `rest`, or where the joints brake to from what they were last told."""
        if not self._holds and (rest is not None or self._setpoint.value is not None):
            self.get_logger().warning(f"holding: {why}")
            self._publish("move", rest or where_they_rest(*self._setpoint.value), [])
            self._holds = True

    def _publish(self, mode, position, velocity):
        message = JointState()
        message.header.stamp = self.get_clock().now().to_msg()
        message.position, message.velocity = position, velocity
        self._to[mode].publish(message)


def main():
    """Run until ROS shuts down."""
    rclpy.init()
    node = ViewpointNode()
    rclpy.spin(node)


if __name__ == "__main__":
    main()
