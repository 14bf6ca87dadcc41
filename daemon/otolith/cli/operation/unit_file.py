"""Lines of a unit of systemd: the grammar by which text of a machine file may enter them.

systemd runs as root what a unit says. A line ends at a line feed, a carriage return or a zero byte; a value expands
``%`` and reads quotes and backslashes. Words of a value are therefore refused unless all their characters stand for
themselves, and comments are escaped. Source: systemd.syntax(7), systemd.unit(5) on specifiers.
"""

import ipaddress
import re
from collections.abc import Iterable

from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.outside_text import visible

WORD = re.compile(r"[A-Za-z0-9_./:@+,=~-]+")
SHOWN = 200  # characters of a comment


def comment(text: str) -> str:
    """Return ``text`` as one comment, shortened."""
    return f"# {visible(text, SHOWN)}"


def directive(key: str, *words: str) -> str:
    """Return the line ``key=words``.

    Raises:
        ConfigurationError: a word has a character that does not stand for itself.
    """
    for word in words:
        if not WORD.fullmatch(word):
            remedy = "give the device another name by udev, of letters, digits and _ . / : @ + , = ~ -"
            raise ConfigurationError(f"{shown(word)} cannot be a word of {key}= in a unit of systemd: {remedy}")
    return f"{key}={' '.join(words)}"


def addresses(names: Iterable[str]) -> list[str]:
    """Return addresses as systemd reads them: without the interface that an IPv6 address may name after a ``%``."""
    return list(dict.fromkeys(_without_interface(name) for name in names))


def _without_interface(name: str) -> str:
    host, slash, length = name.partition("/")
    try:
        return str(ipaddress.ip_address(host.partition("%")[0])) + slash + length
    except ValueError:
        return name
