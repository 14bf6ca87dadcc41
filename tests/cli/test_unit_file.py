"""No text of a machine file becomes a line of the unit that root's systemd runs."""

import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import example, given, settings
from hypothesis import strategies as st

from otolith.cli.main import cli
from otolith.cli.operation.install import drop_in
from otolith.cli.operation.unit_file import comment, directive
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import CONTROL
from tests.conftest import EXAMPLES
from tests.hostile import HOSTILE, hostile_text

LINE = re.compile(
    r"|\[Service\]|#[^\x00-\x1f\x7f-\x9f]*|PrivateDevices=no|DevicePolicy=closed|SupplementaryGroups=dialout|"
    r"DeviceAllow=/dev/[A-Za-z0-9_./:@+,=~-]* rw|RestrictAddressFamilies=[A-Z0-9_ ]*|PrivateNetwork=yes|"
    r"IPAddressDeny=any|IPAddressAllow=(localhost|multicast|[0-9a-f.:]+(/\d+)?)"
)
"""All that a drop-in may have."""
PLACES = ("type", "host", "endpoint", "channel", "interface", "serial", "database", "anything")


@given(
    kind=st.sampled_from(["modbus", "mqtt", "opcua", "can", "of-our-own"]),
    place=st.sampled_from(PLACES),
    text=hostile_text,
    prefix=st.sampled_from(["", "/dev/", "10.0.0.1", "fe80::1%", "opc.tcp://", "opc.tcp://[fe80::1%"]),
)
@example(kind="modbus", place="host", text=HOSTILE[0], prefix="")
@example(kind="modbus", place="serial", text=HOSTILE[12], prefix="")
@settings(max_examples=300, deadline=None)
def test_a_drop_in_has_only_the_lines_that_it_may_have(kind: str, place: str, text: str, prefix: str) -> None:
    try:
        written = drop_in("press-3", [{"type": kind, place: prefix + text}], ("local",), ())
    except (ConfigurationError, ValueError):  # ValueError: a URL that is none
        return
    for line in re.split("[\n\r\0]", written):  # systemd ends a line at each of these
        assert LINE.fullmatch(line), line


@given(hostile_text)
@settings(max_examples=300, deadline=None)
def test_a_comment_is_one_line_and_a_word_stands_for_itself(text: str) -> None:
    written = comment(text)
    assert not CONTROL.search(written)
    assert len(written) < 5000
    try:
        assert directive("DeviceAllow", text) == f"DeviceAllow={text}"
    except ConfigurationError:
        return
    assert not set(text) & set("\n\r\0 \t%\\\"'$;#")


@pytest.mark.parametrize("place", ["host", "key", "device"])
def test_a_machine_file_with_a_line_break_in_a_text_is_not_installed(tmp_path: Path, place: str) -> None:
    for name in ("dc-motor.toml", "dc-motor.dbc"):
        shutil.copy(EXAMPLES / name, tmp_path)
    file = tmp_path / "dc-motor.toml"
    attack = {
        "host": 'on_event = ["/bin/true", "a\\nExecStartPre=+/bin/sh"]',
        "key": '"a\\nExecStartPre=+/bin/sh" = 1',
        "device": 'language = "/dev/ttyUSB0 rw\\rUser=root"',
    }[place]
    text = file.read_text(encoding="utf-8").replace("[machine]", f"[machine]\n{attack}")
    file.write_text(text, encoding="utf-8")
    root = tmp_path / "root"
    result = CliRunner().invoke(cli, ["install", str(file), "--root", str(root)])
    assert isinstance(result.exception, ConfigurationError)
    message = str(result.exception)
    assert message.startswith(f"{file}:")
    assert "control character U+000" in message
    assert not CONTROL.search(message)
    assert not root.exists()
