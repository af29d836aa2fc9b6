# SPDX-License-Identifier: Apache-2.0
"""Collect what people ask of a gateway: arm, disarm and kill, by command, by topic, by key; and arm
robots in the background.

Requests arrive on other threads; the gateway's loop takes them.
"""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from chaserdock_protocol.messages import ArmingCommand, ArmingReply
from chaserdock_protocol.transport import Node

from .devices import DeviceError
from .safety import ArmingAction

Answer = Callable[[ArmingReply], None]

KEYS: dict[str, ArmingAction] = {"a": "arm", "d": "disarm", "k": "kill", " ": "kill"}
"""Keys of the terminal; space kills, as it is the easiest to hit."""
_MOST_REQUESTS = 64
"""Requests that wait for the next look, at most; a look comes every few milliseconds."""


class ArmingRequests:
    """Requests that wait for the gateway's loop. ``not_yet``: why robots cannot be armed before the
    loop runs; ``arm`` is then refused at once, as it must not act later than a person expects.
    """

    def __init__(self) -> None:
        self.not_yet = "the mission has not begun"
        self._requests: deque[tuple[ArmingAction, str, Answer]] = deque(maxlen=_MOST_REQUESTS)

    def submit(self, command: ArmingCommand, reply: Answer) -> None:
        """Queue a command of an operator. Runs on Zenoh's thread."""
        self.add(command.action, command.operator, reply)

    def add(self, action: ArmingAction, by: str, answer: Answer = lambda reply: None) -> None:
        """Queue a request."""
        if action == "arm" and self.not_yet:
            answer(ArmingReply(accepted=False, reason=self.not_yet))
            return
        self._requests.append((action, by, answer))

    def take(self) -> list[tuple[ArmingAction, str, Answer]]:
        """Return the requests since the last call; what stops comes first."""
        taken = [self._requests.popleft() for _ in range(len(self._requests))]
        return sorted(taken, key=lambda request: ("kill", "disarm", "arm").index(request[0]))


@dataclass(frozen=True)
class EndOfArming:
    """How an arming that ``by`` requested has ended. ``error``: of a robot that refused, empty
    without. ``is_cancelled``: robots were disarmed meanwhile.
    """

    by: str
    answer: Answer
    error: str
    is_cancelled: bool


class BackgroundArming:
    """Arms robots in the background of a node's loop, as they answer after a second. ``arm`` arms
    them; it may raise DeviceError.
    """

    def __init__(self, node: Node, arm: Callable[[], None]) -> None:
        self._arm = arm
        self._requested: tuple[str, Answer] | None = None
        self._errors: deque[str] = deque()
        self._is_cancelled = False
        self._start, end = node.host.worker(self._run)
        node.on_close(end)

    @property
    def is_under_way(self) -> bool:
        """Whether robots are being armed."""
        return self._requested is not None

    def begin(self, by: str, answer: Answer) -> None:
        """Begin to arm the robots."""
        self._requested, self._is_cancelled = (by, answer), False
        self._start(None)

    def cancel(self) -> None:
        """Note that robots were disarmed: an arming that is under way does not count."""
        self._is_cancelled = True

    def take_end(self) -> EndOfArming | None:
        """Return how the arming has ended, once; None while none has."""
        if self._requested is None or not self._errors:
            return None
        (by, answer), self._requested = self._requested, None
        return EndOfArming(by, answer, self._errors.popleft(), self._is_cancelled)

    def _run(self, _: None) -> None:
        try:
            self._arm()
            self._errors.append("")
        except DeviceError as error:
            self._errors.append(str(error))


def listen_to_keys(requests: ArmingRequests) -> Callable[[], None]:
    """Take keys of the terminal as requests, if standard input is one. Returns what ends this and
    restores the terminal.
    """
    if not sys.stdin or not sys.stdin.isatty():
        return lambda: None
    import select
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    ended = threading.Event()
    tty.setcbreak(number)

    def read() -> None:
        while not ended.is_set():
            ready, _, _ = select.select([number], [], [], 0.1)
            if ready and (action := KEYS.get(sys.stdin.read(1).lower())) is not None:
                requests.add(action, "a key of the gateway's terminal")

    thread = threading.Thread(target=read, name="keys", daemon=True)
    thread.start()

    def end() -> None:
        ended.set()
        thread.join(timeout=1.0)
        with suppress(termios.error):
            termios.tcsetattr(number, termios.TCSADRAIN, before)

    return end
