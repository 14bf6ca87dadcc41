"""Names in other languages: no two quantities share one, and none is a word of the language."""

from collections.abc import Callable, Iterable


def free_name(wanted: str, taken: set[str]) -> str:
    """Return the name, with underscores as needed to be none of those ``taken``, and take it.

    Neither is it the begin of one of them, so that a suffix makes no name that is taken.
    """
    while any(name == wanted or name.startswith(f"{wanted}_") for name in taken):
        wanted += "_"
    taken.add(wanted)
    return wanted


def identifiers(names: Iterable[str], valid: Callable[[str], str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Return the identifier of each name: ``valid`` of it, with underscores where another name has that one.

    A name that is valid as it is keeps it, whatever its place; none becomes one of those ``taken``.
    """
    names, used, found = list(dict.fromkeys(names)), set(taken), dict[str, str]()
    for name in sorted(names, key=lambda item: valid(item) != item):
        own = valid(name)
        while own in used:
            own += "_"
        used.add(own)
        found[name] = own
    return found
