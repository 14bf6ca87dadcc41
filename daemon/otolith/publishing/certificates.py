"""Certificates: the checks of those that a session uses, and the small certificate authority of ``otolith keys``."""

import os
import stat
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from otolith.machine_file import address_of
from otolith.storage.disk import replace_file
from otolith_drivers.common.credentials import SECRET_LIMIT, secret
from otolith_drivers.config_files import content
from otolith_drivers.errors import ConfigurationError, NotValidNowError, OtolithError

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 825  # validity of what 'otolith keys' makes
CLOCK_TOLERANCE = timedelta(hours=1)  # by which a new certificate is valid before it was made

KINDS = ("crt", "key")  # suffixes of the files of a certificate

Key = tuple[str, ...]  # Key of the machine file, or option, that names a file


@dataclass(frozen=True, slots=True)
class Identity:
    """The files by which one end of a connection is recognised."""

    ca: Path
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class Renewal:
    """What became of the certificate of a name when another was made for it."""

    kept: Path  # Where the old certificate is now; its key is beside it
    old_end: datetime
    end: datetime  # Of the new certificate


def authorities(path: Path, key: Key) -> list[x509.Certificate]:
    """Return the certificates of ``path``; raise ConfigurationError if it has none."""
    try:
        return x509.load_pem_x509_certificates(content(path, SECRET_LIMIT, key))
    except ValueError as error:
        raise ConfigurationError(f"{path}: not a certificate in PEM form", key) from error


def check_identity(identity: Identity, keys: Sequence[Key], hosts: Iterable[str], now: datetime) -> x509.Certificate:
    """Check certificate and key; return the certificate.

    ``keys`` name CA, certificate and private key for the error. ``hosts`` are the names or addresses where it listens.

    Raises:
        NotValidNowError: the certificate is not valid yet, or not any more; everything else is right.
        ConfigurationError: a file cannot be used, or they do not belong together; the message has the cause.
    """
    _, at_certificate, at_key = keys
    trusted = authorities(identity.ca, keys[0])
    chain = authorities(identity.certificate, at_certificate)
    own, name = chain[0], identity.certificate
    private = private_key(identity.key, at_key)
    if private.public_key() != own.public_key():
        raise ConfigurationError(f"{identity.key}: does not belong to the certificate {name}", at_key)
    if not own.subject.get_attributes_for_oid(NameOID.COMMON_NAME):
        raise ConfigurationError(f"{name}: has no common name, by which access is granted", at_certificate)
    if len(chain) == 1 and not any(is_issued(own, authority) for authority in trusted):
        raise ConfigurationError(f"{name}: was not issued by {identity.ca}", at_certificate)
    names = _names(own)
    for host in hosts:
        if not _is_for(names, host):
            remedy = f"'otolith keys add DIR NAME --host {host}' makes one"
            valid = ", ".join(sorted(names)) or "no host"
            raise ConfigurationError(f"{name}: not for {host}, but for {valid}; {remedy}", at_certificate)
    if now < own.not_valid_before_utc:
        start = f"{own.not_valid_before_utc:%Y-%m-%d}"
        raise NotValidNowError(f"{name}: valid only from {start}; check the clock of this computer", at_certificate)
    if now > own.not_valid_after_utc:
        expired = f"expired on {own.not_valid_after_utc:%Y-%m-%d}"
        raise NotValidNowError(f"{name}: {expired}; 'otolith keys renew' makes another", at_certificate)
    return own


def private_key(path: Path, key: Key) -> PrivateKeyTypes:
    """Return the private key in ``path``; raise ConfigurationError if it has none, or others may read it."""
    data = secret(path, key)
    try:
        return serialization.load_pem_private_key(data, password=None)
    except TypeError as error:
        raise ConfigurationError(f"{path}: encrypted; Zenoh needs a key without a passphrase", key) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise ConfigurationError(f"{path}: not a private key in PEM form", key) from error


def is_issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Whether an authority itself has issued a certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _names(certificate: x509.Certificate) -> set[str]:
    """Return the host names and addresses that the certificate is for."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    addresses = {str(address) for address in names.get_values_for_type(x509.IPAddress)}
    return {*(name.lower() for name in names.get_values_for_type(x509.DNSName)), *addresses}


def _is_for(names: set[str], host: str) -> bool:
    """Whether a certificate for ``names`` may serve an endpoint that listens at ``host``.

    Clients may reach an address by any name, so an address is refused only if all names are other addresses.
    """
    address = address_of(host)
    if address is None:
        host = host.lower()
        return bool(names & {host, f"*.{host.partition('.')[2]}"})
    return str(address) in names or any(address.is_unspecified or address_of(name) is None for name in names)


def make_authority(folder: Path, now: datetime) -> datetime:
    """Write ``ca.crt`` and ``ca.key`` into ``folder``, which is created for this user alone; return the expiry.

    Raises:
        ConfigurationError: one of them exists, or the folder cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{folder}: cannot be created: {error.strerror}") from error
    private = ec.generate_private_key(ec.SECP256R1())
    name = _common_name(f"Otolith site CA {os.urandom(4).hex()}")
    usage = _key_usage(authority=True)
    builder = _builder(name, name, private.public_key(), now, AUTHORITY_DAYS)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    certificate = builder.add_extension(usage, critical=True).sign(private, hashes.SHA256())
    _write(folder / "ca", private, certificate)
    return certificate.not_valid_after_utc


def make_certificate(folder: Path, name: str, hosts: Sequence[str], now: datetime) -> datetime:
    """Write ``NAME.crt`` and ``NAME.key``, issued by the authority in ``folder``; return the expiry.

    With ``hosts``, names or addresses, it serves a daemon that listens there; without any, a reader.

    Raises:
        ConfigurationError: the folder has no authority, or the files exist.
    """
    private, certificate = _issue(folder, name, hosts, now)
    _write(folder / name, private, certificate, f"'otolith keys renew {folder} {name}' makes another for this name")
    return certificate.not_valid_after_utc


def renew_certificate(folder: Path, name: str, hosts: Sequence[str], now: datetime) -> Renewal:
    """Write a new certificate and key for ``name``, for ``hosts`` or for those of the old one, which is kept.

    Raises:
        ConfigurationError: there is no certificate or authority, or the folder cannot be written.
        ServiceError: the old files cannot be copied.
    """
    (old,) = authorities(folder / f"{name}.crt", ())[:1]
    end = old.not_valid_after_utc
    private, certificate = _issue(folder, name, hosts or sorted(_names(old)), now)
    stem, number = folder / f"{name}.until-{end:%Y-%m-%d}", 1
    while any(stem.with_name(f"{stem.name}.{kind}").exists() for kind in KINDS):
        stem, number = folder / f"{name}.until-{end:%Y-%m-%d}-{number + 1}", number + 1
    fresh = folder / f".{name}.renewal"
    pairs = [(folder / f"{name}.{kind}", stem.with_name(f"{stem.name}.{kind}")) for kind in KINDS]
    try:
        _remove(fresh)  # of a renewal that was ended
        _write(fresh, private, certificate)
        for path, kept in pairs:
            _keep(path, kept)
        for path, _ in pairs:  # a daemon that reads them meanwhile misses neither
            fresh.with_name(f"{fresh.name}{path.suffix}").replace(path)
    except (OSError, OtolithError) as error:
        for path, kept in pairs:
            if kept.exists():
                kept.replace(path)  # nothing, if both are names of one file
                kept.unlink(missing_ok=True)
        _remove(fresh)
        if isinstance(error, OtolithError):
            raise
        raise ConfigurationError(f"{folder}: cannot be written: {error.strerror}") from error
    return Renewal(stem.with_name(f"{stem.name}.crt"), end, certificate.not_valid_after_utc)


def issued(folder: Path) -> tuple[dict[Path, tuple[datetime, tuple[str, ...]]], dict[Path, str]]:
    """Return end and hosts of each certificate in ``folder``, by its path, and why other files of that kind are none.

    The authority is the first. A renewal that was ended leaves hidden files, which are none.
    """
    rows, faults = dict[Path, tuple[datetime, tuple[str, ...]]](), dict[Path, str]()
    paths = (path for path in folder.glob("*.crt") if not path.name.startswith("."))
    for path in sorted(paths, key=lambda path: (path.stem != "ca", path.name)):
        try:
            own = authorities(path, ())[0]
            rows[path] = own.not_valid_after_utc, tuple(sorted(_names(own)))
        except ConfigurationError as error:
            faults[path] = str(error)
        except (ValueError, x509.DuplicateExtension, x509.UnsupportedGeneralNameType) as error:  # of its extensions
            faults[path] = f"{path}: its names cannot be read: {error}"
    return rows, faults


def _issue(
    folder: Path, name: str, hosts: Sequence[str], now: datetime
) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    """Return a new key for ``name``, and its certificate of the authority in ``folder``."""
    if name == "ca":
        raise ConfigurationError(f"{folder / name}.crt: is the certificate of the authority: use another name")
    (authority,) = authorities(folder / "ca.crt", ())[:1]
    signer = private_key(folder / "ca.key", ())
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != authority.public_key():
        raise ConfigurationError(f"{folder / 'ca.key'}: is not the key of {folder / 'ca.crt'}")
    private = ec.generate_private_key(ec.SECP256R1())
    rest = (authority.not_valid_after_utc - now).days
    if rest < 1:
        raise ConfigurationError(f"{folder / 'ca.crt'}: expired; 'otolith keys init' makes another in a new folder")
    builder = _builder(
        _common_name(name), authority.subject, private.public_key(), now, min(CERTIFICATE_DAYS, rest)
    ).add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_key_usage(authority=False), critical=True)
    # A daemon is also a client: of the router that it connects to.
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False)
    return private, builder.sign(signer, hashes.SHA256())


def _builder(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder(issuer, subject, public, x509.random_serial_number())
    return builder.not_valid_before(now - CLOCK_TOLERANCE).not_valid_after(now + timedelta(days=days))


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _key_usage(*, authority: bool) -> x509.KeyUsage:
    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only")
    usages = dict.fromkeys((*others, "decipher_only"), False)
    return x509.KeyUsage(digital_signature=not authority, key_cert_sign=authority, crl_sign=authority, **usages)


def _host(text: str) -> x509.GeneralName:
    address = address_of(text)
    return x509.DNSName(text) if address is None else x509.IPAddress(address)


def _remove(stem: Path) -> None:
    for kind in KINDS:
        stem.with_name(f"{stem.name}.{kind}").unlink(missing_ok=True)


def _keep(path: Path, kept: Path) -> None:
    """Give the file a second name; a copy where a file has one name only. A missing file is none to keep.

    Nobody else may read the copy of a key at any moment, and half of a copy would replace its original later.
    """
    try:
        os.link(path, kept)
    except FileNotFoundError:
        return
    except OSError:
        status, copy = path.stat(), kept.parent.resolve() / kept.name
        replace_file(copy, path.read_bytes(), f".{kept.name}.new", stat.S_IMODE(status.st_mode), status)


def _write(
    stem: Path,
    private: ec.EllipticCurvePrivateKey,
    certificate: x509.Certificate,
    remedy: str = "use another name or folder",
) -> None:
    """Write key and certificate as new files; neither replaces another."""
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    own = private.private_bytes(pem, pkcs8, serialization.NoEncryption())
    paths = (stem.with_name(f"{stem.name}.key"), stem.with_name(f"{stem.name}.crt"))
    for path in paths:
        if path.exists():
            raise ConfigurationError(f"{path}: exists and is not replaced; {remedy}")
    for path, data, mode in ((paths[0], own, 0o600), (paths[1], certificate.public_bytes(pem), 0o644)):
        try:
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(data)
        except OSError as error:
            for made in () if isinstance(error, FileExistsError) else paths:  # a half would prevent the next try
                made.unlink(missing_ok=True)
            raise ConfigurationError(f"{path}: cannot be written: {error.strerror}") from error


def utc_now() -> datetime:
    """Return the time of this computer, with its zone."""
    return datetime.now(UTC)
