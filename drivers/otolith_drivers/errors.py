"""The errors that a user can meet.

    OtolithError
     ├── ConfigurationError   a file is wrong: unknown key, value out of its bounds, missing signal
     ├── DeviceError          a device, bus or interface is missing or refuses: no vcan0, no permission
     └── ServiceError         the computer refuses: port in use, folder not writable (raised by the daemon)

Each message names the file or device, the key or signal, the value, the bound or cause, and the remedy. An error is
raised where the fault is detected; only ``otolith.__main__`` prints it, as one line, and turns it into an exit code.
"""

import shlex
import sys
from collections.abc import Callable, Sequence
from importlib import metadata

MAX_NAMES = 12  # names of messages, arbitration IDs or signals in a line
MAX_NEAREST = 5  # names of many that are shown for one that is not among them


def installation_of(extra: str) -> str:
    """The command that installs the libraries of an extra into the environment of this Otolith.

    It names them and not Otolith, which may come from a clone, or from wheels that are gone.
    """
    rows = (row.partition(";") for row in metadata.requires("otolith") or ())
    own = (library.strip() for library, _, marker in rows if f'extra == "{extra}"' in marker.replace("'", '"'))
    return f"{sys.executable} -m pip install {shlex.join(own)}"


class OtolithError(Exception):
    """Base of all errors whose text is written for the user."""

    exit_code = 2


class ConfigurationError(OtolithError):
    """A machine file, scenario, DBC or option is wrong."""

    def __init__(self, message: str, key: tuple[str, ...] = ()) -> None:
        """``key`` locates the fault in the machine file, for code that does not know the file itself."""
        super().__init__(message)
        self.key = key


class NotValidNowError(ConfigurationError):
    """A certificate is not valid yet or not any more: the clock, or a new file in its place, may change that."""


class DeviceError(OtolithError):
    """A device, bus or interface is missing or refuses."""


class ServiceError(OtolithError):
    """The computer that runs the daemon refuses."""


def counted(number: int, noun: str) -> str:
    """Return the number and its noun, which takes an ``s`` unless the number is one."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def shown(value: object) -> str:
    """Return a value from outside as a message has it, shortened."""
    try:
        text = repr(value).replace("\n", " ")  # of an array
    except ValueError:  # a whole number of thousands of digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:60]}..."


def some_names(names: Sequence[str]) -> str:
    """Return the first ``MAX_NAMES`` names, and how many more there are."""
    more = len(names) - MAX_NAMES
    return ", ".join(names[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def nearest(word: str, known: list[str]) -> str:
    """Return a hint for a misspelt ``word``: the most similar known name, or the known names, the nearest few of many.

    Numbers, as those of registers, are near each other by their difference.
    """
    import difflib  # noqa: PLC0415 - only needed for an error

    if word.isdecimal() and known and all(name.isdecimal() for name in known):
        return _names(known, lambda name: abs(int(name) - int(word)))
    by_folded_name = {name.casefold(): name for name in known}
    similar = difflib.get_close_matches(word, known, n=1) or [
        by_folded_name[name] for name in difflib.get_close_matches(word.casefold(), list(by_folded_name), n=1)
    ]
    if similar:
        return f"did you mean {similar[0]!r}?"
    folded = word.casefold()
    return _names(known, lambda name: -difflib.SequenceMatcher(None, folded, name.casefold()).ratio())


def _names(known: Sequence[str], distance: Callable[[str], float]) -> str:
    """Return all names in order if they are few; else those with the least ``distance``, and how many there are."""
    if len(known) > MAX_NAMES:
        return f"nearest of {len(known)} names: {', '.join(sorted(known, key=distance)[:MAX_NEAREST])}"
    return f"known: {', '.join(sorted(known))}" if known else "there are none"
