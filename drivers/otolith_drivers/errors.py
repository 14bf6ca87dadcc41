"""The errors a user can meet, drawn as a tree.

    OtolithError
     ├── ConfigurationError   a file says something that cannot be meant: unknown key, wrong unit, missing signal
     ├── DeviceError          a device, bus or interface is not there or refuses: vcan0 missing, no permission
     └── ServiceError         the computer refuses: port in use, folder not writable (raised by the daemon)

Each message names the file or device, the key or signal, the value, the bound or cause, and the way out. Raised where
the fault is seen, spoken once at the edge: ``otolith.__main__`` turns them into one line and an exit code.
"""


class OtolithError(Exception):
    """Anything Otolith says no to; the text is meant for the user as it stands."""

    exit_code = 2


class ConfigurationError(OtolithError):
    """A machine file, scenario, DBC or option is wrong.

    Example scenarios: unknown key, value without a unit, parameter outside its bounds, DBC without the named signal.
    """

    def __init__(self, message: str, key: tuple[str, ...] = ()) -> None:
        """``key`` is where in the machine file the fault begins, for a fault found by who does not know that file."""
        super().__init__(message)
        self.key = key


class DeviceError(OtolithError):
    """A device, bus or interface is missing or refuses.

    Example scenarios: no such CAN interface, no permission on it, no route for the virtual bus.
    """


class ServiceError(OtolithError):
    """The computer the daemon runs on refuses.

    Example scenarios: the Zenoh port is in use, the recording folder is not writable.
    """


def nearest(word: str, known: list[str]) -> str:
    """The end of a sentence that helps after a misspelt ``word``: the nearest known one, or the list of them."""
    import difflib  # noqa: PLC0415 - only on the way to an error

    alike = {name.casefold(): name for name in known}
    close = difflib.get_close_matches(word, known, n=1)
    close = close or [alike[name] for name in difflib.get_close_matches(word.casefold(), list(alike), n=1)]
    if close:
        return f"did you mean {close[0]!r}?"
    return f"known: {', '.join(sorted(known))}" if known else "there are none"
