"""Certificates, private keys and passwords, read from the files that a table names."""

import shlex
import stat
from pathlib import Path
from typing import Any, Self

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from pydantic import model_validator

from otolith_drivers.config_files import StrictModel, content
from otolith_drivers.errors import ConfigurationError

SECRET_LIMIT = 1 << 16  # bytes of a certificate, key or password file; a long chain has 10 kB


class CredentialOptions(StrictModel):
    """The keys of ``[driver]`` that prove who this client is; paths are relative to the machine file."""

    certificate: Path | None = None
    key: Path | None = None  # Certificate and private key of this client
    user: str | None = None
    password_file: Path | None = None  # A file whose first line is the password

    @model_validator(mode="after")
    def _are_pairs(self) -> Self:
        for one, other in (("certificate", "key"), ("user", "password_file")):
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise ValueError(f"{one} and {other} belong together: set both")
        return self


def secret(path: Path, key: tuple[str, ...]) -> bytes:
    """Return the content of a file with passwords or a private key, at ``key`` of the machine file.

    Raises:
        ConfigurationError: the file is unreadable, or every user of this computer may read or change it.
    """
    data = content(path, SECRET_LIMIT, key)
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        remedy = f"'chmod o-rwx {shlex.quote(str(path))}' closes it"
        raise ConfigurationError(f"{path}: open to every user of this computer (mode {mode:04o}); {remedy}", key)
    return data


def stamp(path: Path) -> tuple[int, int, int] | None:
    """Return what differs once a file is replaced; None while it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def certificate(path: Path, key: str) -> x509.Certificate:
    """Return the first certificate of ``path``, at ``key`` of the table; raise ConfigurationError if there is none."""
    where = ("driver", key)
    data = content(path, SECRET_LIMIT, where)
    try:
        return x509.load_pem_x509_certificate(data) if _is_pem(data) else x509.load_der_x509_certificate(data)
    except ValueError as error:
        raise ConfigurationError(f"{path}: is no X.509 certificate in PEM or DER", where) from error


def certificate_and_key(certificate_path: Path, key_path: Path) -> tuple[x509.Certificate, Any]:
    """Return the certificate and the private key of this client, which the table names ``certificate`` and ``key``.

    Raises:
        ConfigurationError: a file is missing or has other content, the key is open to every user, or they do not
            belong together.
    """
    where = ("driver", "key")
    own, data = certificate(certificate_path, "certificate"), secret(key_path, where)
    load = serialization.load_pem_private_key if _is_pem(data) else serialization.load_der_private_key
    try:
        key = load(data, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        text = f"{key_path}: is no private key in PEM or DER without a password"
        raise ConfigurationError(text, where) from error
    if key.public_key() != own.public_key():
        text = f"{key_path}: is not the key of {certificate_path}: give those that belong together"
        raise ConfigurationError(text, where)
    return own, key


def password(path: Path | None, key: str = "password_file") -> str:
    """Return the first line of the file that ``key`` of the table names, empty without one.

    Raises:
        ConfigurationError: as :func:`secret`, or the line is empty.
    """
    if path is None:
        return ""
    where = ("driver", key)
    lines = secret(path, where).decode(errors="replace").splitlines()
    if not lines or not lines[0].strip():
        raise ConfigurationError(f"{path}: its first line is empty: write the secret there", where)
    return lines[0]


def _is_pem(data: bytes) -> bool:
    return b"-----BEGIN" in data
