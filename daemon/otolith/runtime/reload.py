"""What a changed machine file changes in a running daemon: limits and recording. The rest needs a restart."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from otolith.machine import LoadedMachine

Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Reload:
    """The machine to go on with, and what has changed."""

    machine: LoadedMachine
    limits: bool
    recording: bool
    needs_restart: tuple[str, ...]
    """Keys of the file that were changed and that a running daemon does not take over."""

    @property
    def text(self) -> str:
        """What has changed, in words."""
        changed = " and ".join(name for name in ("limits", "recording") if getattr(self, name)) or "nothing"
        line = f"{self.machine.path}: reloaded, {changed} changed"
        return f"{line}; only a restart takes over {', '.join(self.needs_restart)}" if self.needs_restart else line


def reloaded(running: LoadedMachine, new: LoadedMachine) -> Reload:
    """Return ``running`` with what it can take over from ``new``.

    Limits may be percentages of values, so they are taken over only with the parameters they belong to.
    """
    old, file = running.file, new.file
    changed = list(_differences(old.model_dump(), file.model_dump()))
    recording = any(key[0] == "recording" for key in changed)
    limits = [key for key in changed if _is_limit(key)]
    rest = [key for key in changed if key[0] != "recording" and not _is_limit(key)]
    if new.twin != running.twin and not any(key[0] == "twin" for key in rest):
        rest.append(("twin", "file"))
    update: dict[str, Any] = {"recording": file.recording}
    if any(key[0] in {"twin", "parameters"} for key in rest):
        rest, limits = [*rest, *limits], []
    if limits:
        update |= {"parameters": file.parameters, "components": file.components}
    machine = replace(running, file=old.model_copy(update=update), plan=new.plan if limits else running.plan)
    return Reload(machine, bool(limits), recording, tuple(".".join(key) for key in rest))


def _is_limit(key: Key) -> bool:
    return key[0] == "components" or (key[0] == "parameters" and key[-1] in {"watch", "act"})


def _differences(old: Any, new: Any, key: Key = ()) -> Iterator[Key]:
    """The keys at which two tables differ; a table that one of them lacks is compared with an empty one."""
    if isinstance(old, Mapping) or isinstance(new, Mapping):
        before, after = (value if isinstance(value, Mapping) else {} for value in (old, new))
        for name in dict.fromkeys((*before, *after)):
            yield from _differences(before.get(name), after.get(name), (*key, str(name)))
    elif old != new:
        yield key
