# SPDX-License-Identifier: Apache-2.0
"""A controller that is no part of chaserdock: it speaks the published protocol with `zenoh` and
`msgpack` alone.

It takes the place of `chaserdock controller` for one chaser: joins the mission, tracks the target
with an alpha-beta filter on the chaser's sightings, and flies a PD law. Written to be read by
someone who does the same in another language; what each message holds is in docs/protocol.md.

    python foreign_controller.py tcp/127.0.0.1:7447
"""

import json
import math
import queue
import sys
import threading
import time
import uuid

import msgpack
import zenoh

NAME, NAMESPACE = "controller", sys.argv[2] if len(sys.argv) > 2 else "chaserdock"


def encoding(kind):
    return f"application/msgpack;chaserdock.{kind}.v1"


# -- quaternions (w, x, y, z), body to world -------------------------------------------------------


def multiply(p, q):
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def conjugate(q):
    return (q[0], -q[1], -q[2], -q[3])


def rotate(q, v):
    return multiply(multiply(q, (0.0, *v)), conjugate(q))[1:]


def exp(v):
    angle = math.hypot(*v)
    s = math.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    return (math.cos(angle / 2), *(s * x for x in v))


def log(q):
    if q[0] < 0:
        q = tuple(-x for x in q)
    s = math.hypot(*q[1:])
    factor = 2 * math.atan2(s, q[0]) / s if s > 1e-9 else 2.0
    return tuple(factor * x for x in q[1:])


def unit(q):
    n = math.hypot(*q)
    return tuple(x / n for x in q)


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(a, b, factor=1.0):
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))


# -- the target ------------------------------------------------------------------------------------

Q_CRF_IRF = (0.5, -0.5, 0.5, -0.5)  # the camera looks along the body's +X, its top towards +Z


class Target:
    """Alpha-beta filter: position and velocity in the world, attitude, rate in the target's
    axes.
    """

    def __init__(self, alpha=0.15, beta=0.01):
        self.alpha, self.beta, self.time_s = alpha, beta, None

    def predict(self, time_s):
        dt = time_s - self.time_s
        self.time_s = time_s
        self.position = add(self.position, self.velocity, dt)
        self.q = unit(multiply(self.q, exp(tuple(dt * w for w in self.omega))))
        return dt

    def update(self, time_s, position, q):
        if self.time_s is None:
            self.time_s, self.position, self.q = time_s, position, q
            self.velocity = self.omega = (0.0, 0.0, 0.0)
            return
        dt = self.predict(time_s)
        away, turned = add(position, self.position, -1.0), log(multiply(conjugate(self.q), q))
        self.position = add(self.position, away, self.alpha)
        self.q = unit(multiply(self.q, exp(tuple(self.alpha * x for x in turned))))
        if dt > 0:
            self.velocity = add(self.velocity, away, self.beta / dt)
            self.omega = add(self.omega, turned, self.beta / dt)


def seen_pose(scenario, odometry, solution):
    """Target pose in the world from a sighting's solution (in the camera) and the chaser's
    odometry.
    """
    in_body = add(scenario["camera"]["position_m"], rotate(Q_CRF_IRF, solution["position_m"]))
    position = add(odometry["position_m"], rotate(odometry["q_wxyz"], in_body))
    return position, unit(multiply(odometry["q_wxyz"], multiply(Q_CRF_IRF, solution["q_wxyz"])))


# -- control ---------------------------------------------------------------------------------------


def wrench(scenario, odometry, target):
    """PD law towards the reference pose on the target; force and torque in body axes, within the
    limits.
    """
    body, place = scenario["chaser"], scenario["chasers"][odometry["chaser"]]
    m, size = body["mass_kg"], body["size_m"]
    inertia = body["inertia_kg_m2"] or [
        m / 12 * (sum(s * s for s in size) - size[i] ** 2) for i in range(3)
    ]
    offset = place["position_m"]
    aim = add(target.position, rotate(target.q, offset))
    aim_velocity = add(target.velocity, rotate(target.q, cross(target.omega, offset)))
    centripetal = rotate(target.q, cross(target.omega, cross(target.omega, offset)))
    aim_q = multiply(target.q, place["q_wxyz"])
    kp, kd, kq, kw = 0.16, 0.72, 0.16, 0.72  # critically damped within 10 %, 0.4 rad/s
    q = odometry["q_wxyz"]
    pull = add(aim, odometry["position_m"], -1.0)
    push = add(aim_velocity, odometry["velocity_m_s"], -1.0)
    acceleration = tuple(
        c + kp * a + kd * b for a, b, c in zip(pull, push, centripetal, strict=True)
    )
    turn = log(multiply(conjugate(q), aim_q))
    spin = add(rotate(conjugate(place["q_wxyz"]), target.omega), odometry["omega_rad_s"], -1.0)
    force = tuple(m * a for a in rotate(conjugate(q), acceleration))
    torque = tuple(i * (kq * a + kw * b) for i, a, b in zip(inertia, turn, spin, strict=True))

    def limited(values, most):
        return [max(-most, min(most, v)) for v in values]

    return limited(force, body["force_max_N"]), limited(torque, body["torque_max_N_m"])


# -- the process -----------------------------------------------------------------------------------


class Controller:
    def __init__(self, endpoint):
        config = zenoh.Config()
        for key, value in {
            "namespace": NAMESPACE,
            "mode": "peer",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "listen/endpoints": ["tcp/127.0.0.1:0"],
            "scouting/multicast/enabled": False,
            "timestamping/enabled": True,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.inbox, self.seq, self.heard = queue.SimpleQueue(), {}, {}
        self.instance = uuid.uuid4().hex[:12]

    def publish(self, key, kind, **fields):
        fields["seq"] = self.seq[key] = self.seq.get(key, -1) + 1
        stamp = self.session.new_timestamp()
        self.session.put(key, msgpack.packb(fields), encoding=encoding(kind), timestamp=stamp)

    def join(self):
        """Send join requests until the world replies; return the flight scenario."""
        request = msgpack.packb({"process": NAME, "instance": self.instance})
        while True:
            for answer in self.session.get(
                "world/join", payload=request, encoding=encoding("JoinRequest"), timeout=1.0
            ):
                if answer.ok is not None:
                    reply = msgpack.unpackb(answer.ok.payload.to_bytes())
                    if not reply["accepted"]:
                        sys.exit(reply["reason"])
                    return json.loads(reply["scenario_json"])
            time.sleep(0.1)

    def listen(self):
        """Subscribe; presence last, so that a process that receives ours can reach all other
        subscriptions.
        """
        self.token = self.session.liveliness().declare_token(f"live/{NAME}")
        keys = (
            "world/tick",
            "world/end",
            "world/chaser/*/odometry",
            "chaser/*/sighting",
            "chaser/*/lease",
            "**/presence",
        )
        self.subscribers = [
            self.session.declare_subscriber(
                key,
                lambda s: self.inbox.put((str(s.key_expr), msgpack.unpackb(s.payload.to_bytes()))),
            )
            for key in keys
        ]
        self.over = threading.Event()
        self.heartbeat = threading.Thread(target=self.publish_presence, daemon=True)
        self.heartbeat.start()

    def publish_presence(self):
        while not self.over.wait(0.05):
            self.publish(
                f"{NAME}/presence",
                "Presence",
                process=NAME,
                instance=self.instance,
                heard=dict(self.heard),
            )

    def fly(self):
        scenario = self.join()
        target, tick, odometry, sightings, leases, done = Target(), None, {}, {}, {}, -1
        self.listen()
        while True:
            key, message = self.inbox.get()
            if key == "world/end":
                break
            if key.endswith("/presence"):
                self.heard[message["process"]] = message["instance"]
            elif key == "world/tick":
                tick = message
            elif key.endswith("/odometry"):
                odometry[message["chaser"]] = message
            elif key.endswith("/sighting"):
                sightings[message["chaser"]] = message
            elif key.endswith("/lease"):
                leases[message["chaser"]] = message
            if tick is None or tick["tick"] <= done:
                continue
            now = tick["tick"]
            here = [i for i in tick["chasers"] if odometry.get(i, {}).get("tick") == now]
            stated = [
                i
                for i in tick["chasers"]
                if (leases.get(i, {}).get("tick"), leases.get(i, {}).get("revision"))
                == (now, tick.get("revision", 0))
            ]
            looked = [i for i in tick["chasers"] if sightings.get(i, {}).get("tick") == now]
            # Lock-step: answer when everything that belongs to this tick has come.
            if len(here) == len(stated) == len(tick["chasers"]) and (
                not tick["images"] or len(looked) == len(here)
            ):
                # It is the only controller, to which all chasers grant their leases. With a second
                # one, see docs/protocol.md.
                term = max((leases[i]["term"] for i in stated), default=0)
                self.answer(
                    scenario, tick, term, target, odometry, sightings if tick["images"] else {}
                )
                done = now
        self.over.set()
        self.heartbeat.join()  # its last messages belong to the counts
        counts = {key: n + 1 for key, n in self.seq.items()}
        time_ns = tick["sim_time_ns"] if tick else 0
        self.publish(
            f"{NAME}/farewell",
            "Farewell",
            tick=done,
            sim_time_ns=time_ns,
            process=NAME,
            published=counts,
        )
        self.session.close()

    def answer(self, scenario, tick, term, target, odometry, sightings):
        now_s, latency_s = tick["sim_time_ns"] / 1e9, scenario["time"]["latency_s"]
        for i, sighting in sorted(sightings.items()):
            if i in odometry and sighting["solutions"]:
                target.update(now_s, *seen_pose(scenario, odometry[i], sighting["solutions"][0]))
        known = target.time_s is not None
        if known:
            target.predict(now_s)
        head = {"tick": tick["tick"], "sim_time_ns": tick["sim_time_ns"]}
        physics_hz, rate_hz = scenario["time"]["physics_hz"], scenario["time"]["rate_hz"]
        step = tick["tick"] * physics_hz // rate_hz + round(latency_s * physics_hz)
        for i in tick["chasers"]:
            force, torque = (
                wrench(scenario, odometry[i], target) if known else ([0.0] * 3, [0.0] * 3)
            )
            self.publish(
                f"{NAME}/chaser/{i}/wrench",
                "WrenchCommand",
                **head,
                chaser=i,
                effective_time_ns=step * 1_000_000_000 // physics_hz,
                expires_ns=tick["sim_time_ns"] + 500_000_000,
                mode="nmpc" if known else "coast",
                force_N=force,
                torque_N_m=torque,
                term=term,
                commander=NAME,
                instance=self.instance,
            )
        self.publish(
            f"{NAME}/target",
            "TargetEstimate",
            **head,
            status="tracking" if known else "none",
            position_m=target.position if known else [0.0] * 3,
            velocity_m_s=target.velocity if known else [0.0] * 3,
            q_wxyz=target.q if known else [1.0, 0.0, 0.0, 0.0],
            omega_rad_s=target.omega if known else [0.0] * 3,
            covariance=[1e-4 if r == c else 0.0 for r in range(12) for c in range(12)],
            accepted=[],
            rejected=[],
        )
        # Last: it marks the end of this tick's messages for the recorder.
        nothing = {"chasers": [], "status": [], "iterations": [], "cost": [], "max_violation_m": []}
        self.publish(f"{NAME}/solver", "SolverStatus", **head, solver="foreign-pd", **nothing)


if __name__ == "__main__":
    Controller(sys.argv[1]).fly()
