"""Certificates, private keys and passwords of a driver, read from the files that its table names."""

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
        ConfigurationError: a file is missing, has other content, or they do not belong together.
    """
    where = ("driver", "key")
    own, data = certificate(certificate_path, "certificate"), content(key_path, SECRET_LIMIT, where)
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


def password(path: Path | None) -> str:
    """Return the first line of a password file, empty without one; raise ConfigurationError if it is unreadable."""
    if path is None:
        return ""
    lines = content(path, SECRET_LIMIT, ("driver", "password_file")).decode(errors="replace").splitlines()
    return lines[0] if lines else ""


def _is_pem(data: bytes) -> bool:
    return b"-----BEGIN" in data
