# SPDX-License-Identifier: Apache-2.0
"""A world that is no part of chaserdock: it speaks the published protocol with `zenoh` and
`msgpack` alone (docs/howto-own-world.md). Chasers are double integrators that keep their attitude;
the target drifts. In place of an image it sends what the perception `statistical` reads: a pose.

    chaserdock scenario single --set 'perception.name="statistical"' --flight > flight.json
    python own_world.py flight.json listen tcp/127.0.0.1:7447
"""

import json
import pathlib
import struct
import sys
import threading
import time
import uuid

import msgpack
import numpy as np
import zenoh
from scipy.spatial.transform import Rotation

FLIGHT = pathlib.Path(sys.argv[1]).read_text(encoding="utf-8")
SCENARIO, NAMESPACE = json.loads(FLIGHT), sys.argv[4] if len(sys.argv) > 4 else "chaserdock"
CHASERS = [f"chaser/{i}" for i in range(len(SCENARIO["chasers"]))]
MEMBERS, RATE = {*CHASERS, "controller"}, SCENARIO["time"]["rate_hz"]
CAMERA_AXES = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])  # IRF to CRF
INSTANCE = uuid.uuid4().hex[:12]


class World:
    def __init__(self):
        config = zenoh.Config()
        config.insert_json5("namespace", json.dumps(NAMESPACE))
        config.insert_json5("mode", '"peer"')
        config.insert_json5("timestamping/enabled", "true")
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5(f"{sys.argv[2]}/endpoints", json.dumps([sys.argv[3]]))
        self.session, self.seq, self.lock = zenoh.open(config), {}, threading.Lock()
        self.joined, self.heard, self.replies = {}, {}, {}
        self.declared = [
            self.session.declare_queryable("world/join", self.admit),
            self.session.declare_subscriber("chaser/*/actuators", self.take),
            self.session.declare_subscriber("**/presence", self.meet),
            self.session.liveliness().declare_token("live/world"),
        ]

    def admit(self, query):  # duty 1: whoever asks gets the mission
        request = msgpack.unpackb(query.payload.to_bytes())
        self.joined[request["process"]] = request["instance"]
        reply = {"accepted": True, "reason": "", "run_id": INSTANCE, "mode": "lockstep"}
        reply |= {"scenario_json": FLIGHT, "source": str(self.session.zid())}
        encoding = "application/msgpack;chaserdock.JoinReply.v1"
        query.reply("world/join", msgpack.packb(reply), encoding=encoding)

    def take(self, sample):
        command = msgpack.unpackb(sample.payload.to_bytes())
        self.replies[command["chaser"]] = command

    def meet(self, sample):
        presence = msgpack.unpackb(sample.payload.to_bytes())
        self.heard[presence["process"]] = presence

    def publish(self, key, kind, version=1, **fields):
        with self.lock:
            fields["seq"] = self.seq[key] = self.seq.get(key, -1) + 1
        encoding = f"application/msgpack;chaserdock.{kind}.v{version}"
        stamp = self.session.new_timestamp()  # names this session as the world
        self.session.put(key, msgpack.packb(fields), encoding=encoding, timestamp=stamp)

    def present(self):
        heard = {n: p["instance"] for n, p in dict(self.heard).items() if n in self.joined}
        me = {"process": "world", "instance": INSTANCE, "world": str(self.session.zid())}
        self.publish("world/presence", "Presence", heard=heard, **me)

    def is_met(self, name):  # by the world, and by those with which it exchanges messages
        partners = MEMBERS - {name} if name == "controller" else {"controller"}
        return {"world", *partners} <= set(self.heard.get(name, {"heard": ()})["heard"])

    def fly(self):
        while not all(map(self.is_met, MEMBERS)):  # duty 2: no tick before all have met
            self.present()
            time.sleep(0.05)
        places = [1.1 * np.array(c["position_m"]) for c in SCENARIO["chasers"]]
        turns = [Rotation.from_quat(np.roll(c["q_wxyz"], -1)) for c in SCENARIO["chasers"]]
        speeds, ticks = [np.zeros(3) for _ in places], round(SCENARIO["duration_s"] * RATE)
        for tick in range(ticks + 1):
            head = {"tick": tick, "sim_time_ns": tick * 1_000_000_000 // RATE}
            for i, place in enumerate(places):  # duty 3: each chaser's own state
                state = {"position_m": place.tolist(), "velocity_m_s": speeds[i].tolist()}
                state |= {"q_wxyz": np.roll(turns[i].as_quat(), 1).tolist(), "omega_rad_s": [0] * 3}
                self.publish(f"world/chaser/{i}/odometry", "Odometry", 2, **head, chaser=i, **state)
            if tick == ticks:
                break
            self.replies.clear()
            who = {n: self.joined[n] for n in CHASERS}  # duty 4: the tick, and who replies to it
            flying = {"chasers": [*range(len(places))], "chaser_instances": who, "images": True}
            flying |= {"controllers": {"controller": self.joined["controller"]}}
            self.publish("world/tick", "Tick", 3, **head, **flying)
            for i, place in enumerate(places):  # duty 5: the images that the tick announces
                axes = turns[i] * CAMERA_AXES
                lens = place + turns[i].apply(SCENARIO["camera"]["position_m"])
                seen = axes.inv().apply(np.array([0.002, 0.001, 0.0]) * tick / RATE - lens)
                pose = struct.pack("<9d", *seen, *np.roll(axes.inv().as_quat(), 1), tick, i)
                image = {"chaser": i, "width_px": 72, "height_px": 1, "encoding": "mono8"}
                self.publish(f"world/chaser/{i}/image", "Image", 1, **head, data=pose, **image)
            while len(self.replies) < len(places):  # duty 6: wait for the commands, then move on
                time.sleep(0.0005)
            for i, command in self.replies.items():
                force = turns[i].apply(command["force_N"])
                speeds[i] = speeds[i] + force / SCENARIO["chaser"]["mass_kg"] / RATE
                places[i] = places[i] + speeds[i] / RATE
            if tick % RATE == 0:
                self.present()
        self.publish("world/end", "MissionEnd", 1, **head, reason="completed", complete=True)
        counts = {key: n + 1 for key, n in self.seq.items()}  # duty 7: the end, and what was sent
        self.publish("world/farewell", "Farewell", **head, process="world", published=counts)
        time.sleep(0.5)
        self.session.close()


if __name__ == "__main__":
    World().fly()
