# SPDX-License-Identifier: Apache-2.0
"""Track who takes part in the open tick, and who has replied. No I/O."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from chaserdock_models.clock import Timing

from chaserdock_protocol.messages import Tick


@dataclass
class OpenTick:
    """A tick that expects a reply of ``chasers``.

    ``revision``: how often it was published again. ``controllers``, ``instances`` (of chasers),
    ``since`` and ``mapper``: see ``Tick``.
    """

    tick: int = -1
    images: bool = False
    chasers: tuple[int, ...] = ()
    controllers: dict[str, str] = field(default_factory=dict)
    instances: Mapping[str, str] = field(default_factory=dict)
    since: dict[str, int] = field(default_factory=dict)
    mapper: str = ""
    revision: int = 0
    replied: set[int] = field(default_factory=set)

    @property
    def missing(self) -> list[int]:
        """Return the chasers whose reply has not arrived."""
        return [i for i in self.chasers if i not in self.replied]

    def remove(self, process: str) -> bool:
        """Stop expecting a reply of a lost process; return whether it took part."""
        self.since.pop(process, None)
        if process == "mapper" and self.mapper:
            self.mapper = ""
            return True
        if self.controllers.pop(process, None) is not None:
            return True
        before = self.chasers
        self.chasers = tuple(i for i in before if f"chaser/{i}" != process)
        return self.chasers != before

    def message(self, timing: Timing) -> Tick:
        """Return the tick as a message."""
        return Tick(
            tick=self.tick,
            sim_time_ns=timing.tick_time_ns(self.tick),
            revision=self.revision,
            images=self.images,
            chasers=self.chasers,
            controllers=self.controllers,
            chaser_instances={
                name: self.instances[name] for name in map("chaser/{}".format, self.chasers)
            },
            since=self.since,
            mapper=self.mapper,
        )
