# SPDX-License-Identifier: Apache-2.0
"""Network address of a mission of ``chaserdock run``, in a file of its folder while the mission
flies.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.output_files import write_atomically
from msgspec import Struct

ADDRESS_FILE = "network.json"


class AddressError(ChaserdockError):
    """The folder contains no address of a mission."""


class MissionAddress(Struct, frozen=True, kw_only=True):
    """Where other processes reach a mission: Zenoh endpoint and namespace, and the folder of its
    keys, if any.
    """

    namespace: str
    endpoint: str
    keys: str | None = None

    def options(self) -> str:
        """Return the command-line options with which operator commands and the viewer join the
        mission.
        """
        keys = [] if self.keys is None else ["--keys", self.keys]
        return " ".join(["-e", self.endpoint, "--namespace", self.namespace, *keys])


def write_address(folder: Path, address: MissionAddress) -> None:
    """Write the address into the folder of the run."""
    write_atomically(folder / ADDRESS_FILE, msgspec.json.encode(address) + b"\n")


def read_address(folder: Path) -> MissionAddress:
    """Read the address of the mission that writes to ``folder``. Raises AddressError."""
    file = folder / ADDRESS_FILE
    try:
        return msgspec.json.decode(file.read_bytes(), type=MissionAddress)
    except FileNotFoundError:
        raise AddressError(
            f"--run {folder}: no {ADDRESS_FILE}; it exists while `chaserdock run` flies a mission "
            "into this folder"
        ) from None
    except OSError as error:
        raise AddressError(f"--run {folder}: {ADDRESS_FILE}: {error.strerror or error}") from None
    except msgspec.DecodeError as error:
        raise AddressError(
            f"{file}: {error}; it must be the file that `chaserdock run` wrote"
        ) from None


def remove_address(folder: Path) -> None:
    """Remove the address at the end of the mission."""
    (folder / ADDRESS_FILE).unlink(missing_ok=True)
