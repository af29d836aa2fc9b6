# SPDX-License-Identifier: Apache-2.0
"""Drive a robot on UDP from the laboratory's gateway. README.md states what the robot has to do."""

import json
import socket

from chaserdock_agents.gateway.devices import DeviceError

ANSWER_S = 1.0  # longest wait for the answer to arming, s


class UdpRobot:
    """See `chaserdock_agents.gateway.devices.Robot`."""

    body_axes = "flu"

    def __init__(self, host, port, thrusters):
        self.thrusters = thrusters
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(ANSWER_S)
        self._socket.connect((host, port))

    def _put(self, fields):
        try:
            self._socket.send(json.dumps(fields).encode())
        except OSError as error:
            raise DeviceError(f"the robot is gone: {error}") from None

    def send(self, command):
        self._put({n: getattr(command, n).tolist() for n in ("force_N", "torque_N_m", "duty")})

    def arm(self):
        self._put({"arm": True})
        try:
            armed = json.loads(self._socket.recv(1024)).get("armed")
        except (OSError, ValueError) as error:
            raise DeviceError(f"no answer to arming: {error}") from None
        if armed is not True:
            raise DeviceError("the robot refuses to arm")

    def stop(self):
        zero = {"force_N": [0.0] * 3, "torque_N_m": [0.0] * 3, "duty": [0.0] * self.thrusters}
        for fields in (zero, {"arm": False}):
            try:
                self._put(fields)
            except DeviceError:
                continue  # gone: it stops by itself

    def close(self):
        self.stop()
        self._socket.close()


def open_robot(address, options, host):
    """Open ``udp:HOST:PORT``. Option ``thrusters``: their number; 0, for a robot of wrenches."""
    name, _, port = address.rpartition(":")
    if set(options) - {"thrusters"} or not name or not port.isdecimal():
        raise DeviceError("must be udp:HOST:PORT with no other option than thrusters")
    return UdpRobot(name, int(port), int(options.get("thrusters", 0)))
