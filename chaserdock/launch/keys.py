# SPDX-License-Identifier: Apache-2.0
"""Keys of a mission: a certificate authority of its own, and a key and a certificate per process.

Elliptic curve P-256. The authority's private key is never written. No process can therefore be
added later: a new mission needs new keys. ``FOLDER/NAME/`` holds all that the process NAME needs:
``ca.pem``, ``cert.pem`` and ``key.pem``.
"""

from __future__ import annotations

import ipaddress
import os
from datetime import datetime, timedelta
from pathlib import Path

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.transport.access_control import identities
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

ROUTER = "router"
_FILES = ("ca.pem", "cert.pem", "key.pem")


class KeysError(ChaserdockError):
    """Keys cannot be written, or would be overwritten."""


def names(chasers: int) -> list[str]:
    """Return the names of all key holders: the router, and the processes that may connect."""
    return [ROUTER, *(identity.common_name for identity in identities(chasers))]


def init_keys(
    folder: Path,
    chasers: int,
    hosts: tuple[str, ...],
    days: int,
    now: datetime,
    *,
    shared: bool = False,
) -> None:
    """Make all keys of a mission in ``folder``. ``hosts``: names and addresses of its router.

    ``now``: UTC. Certificates are valid for ``days`` from an hour before (clocks of hosts differ).
    Private keys are readable by their owner only, or by every user if ``shared`` (for a volume that
    one process mounts). Raises KeysError if the folder contains keys or cannot be written.
    """
    existing = [
        name for name in names(chasers) if any((folder / name / f).exists() for f in _FILES)
    ]
    if existing:
        raise KeysError(
            f"{folder} contains keys (of {', '.join(existing)}); they are never overwritten, "
            "choose another folder or remove them"
        )
    start, end = now - timedelta(hours=1), now + timedelta(days=days)
    authority_key = ec.generate_private_key(ec.SECP256R1())
    authority = _certificate(
        "chaserdock mission", authority_key, None, authority_key, start, end, ()
    )
    public = serialization.Encoding.PEM
    try:
        for name in names(chasers):
            key = ec.generate_private_key(ec.SECP256R1())
            certificate = _certificate(
                name, key, authority, authority_key, start, end, hosts if name == ROUTER else ()
            )
            (folder / name).mkdir(parents=True, exist_ok=True)
            _write(folder / name / "key.pem", _private(key), 0o644 if shared else 0o600)
            _write(folder / name / "ca.pem", authority.public_bytes(public), 0o644)
            # Written last: it shows that the other files are complete.
            _write(folder / name / "cert.pem", certificate.public_bytes(public), 0o644)
    except OSError as error:
        raise KeysError(f"{folder}: keys cannot be written: {error.strerror or error}") from None


def why_not_usable(folder: Path, chasers: int, now: datetime) -> str | None:
    """Return why ``folder`` does not hold keys of all processes that are valid for another hour;
    None if it does.
    """
    complete = [
        name for name in names(chasers) if all((folder / name / f).is_file() for f in _FILES)
    ]
    if not complete:
        return "it contains no keys"
    if missing := sorted(set(names(chasers)) - set(complete)):
        return f"the keys of {', '.join(missing)} are missing"
    for name in complete:
        end = x509.load_pem_x509_certificate(
            (folder / name / "cert.pem").read_bytes()
        ).not_valid_after_utc
        if end < now + timedelta(hours=1):
            return f"the keys of {name} expire at {end:%Y-%m-%d %H:%M} UTC"
    return None


def remove_keys(folder: Path, chasers: int) -> None:
    """Remove a mission's keys. The folders stay, because they may be mounts."""
    for name in names(chasers):
        for file in _FILES:
            (folder / name / file).unlink(missing_ok=True)


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(path: Path, content: bytes, mode: int) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as out:
        os.fchmod(out.fileno(), mode)  # overrides the umask
        out.write(content)


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _certificate(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Certificate | None,
    issuer_key: ec.EllipticCurvePrivateKey,
    start: datetime,
    end: datetime,
    hosts: tuple[str, ...],
) -> x509.Certificate:
    """Make a certificate of ``name``, self-signed without an ``issuer`` (RFC 5280, sections 4.1 and
    4.2).
    """
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    is_authority = issuer is None
    usage = x509.KeyUsage(
        digital_signature=not is_authority,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()),
            critical=False,
        )
    )
    if not is_authority:
        purpose = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        alternatives = [_alternative(host) for host in hosts] or [x509.DNSName(name)]
        builder = builder.add_extension(
            x509.ExtendedKeyUsage([purpose]), critical=False
        ).add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    return builder.sign(issuer_key, hashes.SHA256())
