# SPDX-License-Identifier: Apache-2.0
"""Fly on an emulated laboratory: starts laboratory, gateway, controller, chasers and recorder, arms
the robots, and commands them to dock where they can::

    python fly.py planar-docking --out RUN

Ends with the mission, status 0 if it is judged a success.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent
ARM_WITHIN_S = 180.0  # devices find each other late on a machine that does other work
SETTLE_S = 12.0
RECORDED_WITHIN_S = 300.0
ABSENT_S = 3.0  # from the end of a gateway that is killed to the start of the next one
# Numerics on one thread each, as several processes share the cores.
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


PORTS = ("7449", "14559")  # of the laboratory in the files; flights beside each other need others


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Flight:
    """The processes of a flight. Output goes to files in ``out``."""

    def __init__(self, name: str, out: Path, seed: int, extra: list[str]) -> None:
        self.scenario, self.out, lab = out / "scenario.toml", out, out / "lab.toml"
        out.mkdir(parents=True)
        ports = {port: str(free_port()) for port in PORTS}
        for file in (self.scenario, lab):
            text = (FOLDER / name / file.name).read_text(encoding="utf-8")
            for port, own in ports.items():
                text = text.replace(port, own)
            file.write_text(text, encoding="utf-8")
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        laboratory = tomllib.loads(lab.read_text(encoding="utf-8"))
        self.robots = range(len(laboratory["robot"]))
        self.docking = [i for i in self.robots if "port" in laboratory["robot"][i]]
        summary = out / "laboratory.json"
        program = [FOLDER / "main.py", lab, "--seed", seed, "--summary", summary, *extra]
        self.start("laboratory", *program)

    def start(self, name: str, *arguments: object) -> None:
        with (self.out / f"{name.replace('/', '-')}.txt").open("ab") as output:
            command = [sys.executable, *map(str, arguments)]
            self.processes[name] = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, env=ENVIRONMENT
            )

    def start_gateway(self, *sets: str) -> None:
        options = ["-l", self.endpoint, "--resume", self.out / "begun.json"]
        options += ["--timeout", ARM_WITHIN_S]
        options += [word for text in sets for word in ("--set", text)]
        self.start("gateway", "-m", "chaserdock", "gateway", self.scenario, *options)

    def start_others(self) -> None:
        for name, *words in (
            ("controller", "controller"),
            *((f"chaser/{i}", "chaser", str(i)) for i in self.robots),
            ("recorder", "record", "--out", str(self.out / "run")),
        ):
            self.start(name, "-m", "chaserdock", *words, "-e", self.endpoint)

    def command(self, *words: str) -> bool:
        """Send a command of an operator; return whether it was accepted."""
        program = [sys.executable, "-m", "chaserdock", "command", *words, "-e", self.endpoint]
        return subprocess.run(program, env=ENVIRONMENT, check=False).returncode == 0

    def wait_for(self, name: str, text: str, within_s: float) -> None:
        """Wait until a process has printed a text. Raises TimeoutError."""
        deadline = time.monotonic() + within_s
        while text not in (self.out / f"{name}.txt").read_text(encoding="utf-8", errors="replace"):
            if self.processes[name].poll() is not None or time.monotonic() > deadline:
                raise TimeoutError(f"{name} has not printed {text!r}; see {self.out / name}.txt")
            time.sleep(0.1)

    def arm(self) -> None:
        """Arm as soon as the gateway accepts. Raises TimeoutError."""
        deadline = time.monotonic() + ARM_WITHIN_S
        while not self.command("arm"):
            if time.monotonic() > deadline or self.processes["gateway"].poll() is not None:
                raise TimeoutError(f"not armed within {ARM_WITHIN_S:g} s")
            time.sleep(0.5)

    def restart_gateway(self, *sets: str) -> None:
        """Kill the gateway, start it again and arm."""
        self.processes["gateway"].kill()
        self.processes["gateway"].wait()
        time.sleep(ABSENT_S)
        self.start_gateway(*sets)
        self.arm()

    def end(self) -> None:
        """Interrupt what still runs, the laboratory last."""
        for name in [n for n in self.processes if n != "laboratory"] + ["laboratory"]:
            process = self.processes[name]
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(20.0)
                except subprocess.TimeoutExpired:
                    process.kill()


def fly(a: argparse.Namespace) -> int:
    """Fly to the end of the mission; return the status of its judgement."""
    extra = [word for text in a.fault for word in ("--fault", text)]
    flight = Flight(a.flight, a.out, a.seed, extra)
    try:
        flight.wait_for("laboratory", "ready", 30.0)
        flight.start_gateway(*a.set)
        flight.start_others()
        flight.wait_for("gateway", "waiting for", 60.0)
        flight.arm()
        if flight.docking:
            time.sleep(SETTLE_S)
        for i in flight.docking:
            flight.command("approach", str(i))
        if a.kill_gateway is not None:
            time.sleep(a.kill_gateway)
            flight.restart_gateway(*a.set)
        flight.processes["gateway"].wait()
        flight.processes["recorder"].wait(RECORDED_WITHIN_S)
    finally:
        flight.end()
    judge = [sys.executable, "-m", "chaserdock", "judge", str(a.out / "run")]
    return subprocess.run(judge, check=False).returncode


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly on an emulated laboratory.")
    flights = sorted(path.parent.name for path in FOLDER.glob("*/lab.toml"))
    parser.add_argument("flight", choices=flights)
    parser.add_argument("--out", type=Path, required=True, help="folder for log and output")
    parser.add_argument("--seed", type=int, default=0, help="of the laboratory")
    parser.add_argument("--set", action="append", default=[], help="override a scenario value")
    parser.add_argument("--fault", action="append", default=[], help="see main.py")
    parser.add_argument(
        "--kill-gateway", type=float, metavar="S", help="so long after the last command; restart it"
    )
    sys.exit(fly(parser.parse_args()))


if __name__ == "__main__":
    main()
