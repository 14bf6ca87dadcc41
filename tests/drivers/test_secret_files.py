"""A file with a password or a private key that every user may read or change is refused, whoever needs it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from otolith.machine_file import ZenohTable
from otolith.publishing.certificates import make_authority, make_certificate, utc_now
from otolith.publishing.zenoh_config import Access, Credentials, reader_settings
from otolith_drivers import mqtt
from otolith_drivers.base import Setup
from otolith_drivers.common.credentials import secret
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.opcua.connection import OpcUaCredentials, OpcuaOptions
from tests.drivers.certificates import certificate
from tests.messages import raises_saying

PAIR = {"certificate": "own.der", "key": "own.pem"}
USER = {"user": "operator", "password_file": "password"}
TLS = {"tls": {"ca": "ca.crt", "certificate": "press.crt", "key": "press.key"}}


def with_mqtt(folder: Path, **keys: object) -> None:
    mqtt.build(mqtt.Options.model_validate({"host": "broker", "tls": True, **keys}), Setup((), folder, 0.01))


def with_opcua(folder: Path, **keys: object) -> None:
    options = {"endpoint": "opc.tcp://plc:4840", "security": "Basic256Sha256", **PAIR, **keys}
    OpcUaCredentials.load(OpcuaOptions.model_validate(options), folder)


def with_zenoh(folder: Path, **keys: object) -> None:
    Access(ZenohTable.model_validate(keys), folder / "machine.toml").settings(["otolith/here/motor"], ["tcp/[::]:7447"])


def with_reader(folder: Path, **names: str) -> None:
    files = {option: folder / name for option, name in names.items()}
    reader_settings(Credentials(**files), ["tls/press.local:7447"])


NEEDS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "password of MQTT": ("password", lambda folder: with_mqtt(folder, **USER)),
    "key of MQTT": ("own.pem", lambda folder: with_mqtt(folder, **PAIR)),
    "password of OPC UA": ("password", lambda folder: with_opcua(folder, **USER)),
    "key of OPC UA": ("own.pem", with_opcua),
    "passwords of Zenoh": ("password", lambda folder: with_zenoh(folder, access={"passwords": "password"})),
    "key of Zenoh": ("press.key", lambda folder: with_zenoh(folder, **TLS)),
    "login of a reader": ("password", lambda folder: with_reader(folder, login="password")),
    "key of a reader": ("press.key", lambda folder: with_reader(folder, **TLS["tls"])),
    "key of the authority": ("ca.key", lambda folder: make_certificate(folder, "other", [], utc_now())),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("secrets")
    certificate(made, "own")
    make_authority(made, utc_now())
    make_certificate(made, "press", ["press.local"], utc_now())
    (made / "password").write_text("operator:secret\n", encoding="utf-8")
    (made / "machine.toml").touch()
    for path in made.iterdir():
        path.chmod(0o600)
    return made


@pytest.mark.parametrize("mode", [0o604, 0o602, 0o666])
@pytest.mark.parametrize("need", NEEDS)
def test_a_secret_that_is_open_to_every_user_is_refused(folder: Path, need: str, mode: int) -> None:
    name, use = NEEDS[need]
    path = folder / name
    path.chmod(mode)
    try:
        with raises_saying(ConfigurationError, str(path), f"{mode:04o}", f"chmod o-rwx {path}"):
            use(folder)
    finally:
        path.chmod(0o640)
    assert secret(path, ()) == path.read_bytes()
