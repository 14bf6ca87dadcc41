"""Several recorded files as one: each begins a recording of its own, whatever its times are."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Mask, Reader, Rows


class JoinedReader(Reader):
    """Reads files one after the other, in the order given."""

    def __init__(self, paths: Sequence[Path], open_file: Callable[[Path], Reader]) -> None:
        """Open all files, so that a missing one is named before any is read.

        Raises:
            ConfigurationError: a file cannot be opened, or the times of the files have different meanings.
        """
        super().__init__(paths[0])
        with ExitStack() as opened:
            self._readers = [opened.enter_context(open_file(path)) for path in paths]
            first = self._readers[0]
            for reader in self._readers[1:]:
                if reader.sampling != first.sampling:
                    kinds = f"{_kind(reader)} times, but {first.path} has {_kind(first)} ones"
                    raise ConfigurationError(f"{reader.path}: {kinds}: replay them apart")
            self._opened = opened.pop_all()
        self.place, self.is_table = f"its file's {first.place}", first.is_table
        self.sampling = first.sampling
        self.ignored = tuple(dict.fromkeys(name for reader in self._readers for name in reader.ignored))
        self._finished = 0

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        present = self._readers[self._finished].progress if self._finished < len(self._readers) else 0.0
        return (self._finished + present) / len(self._readers)

    @property
    def file(self) -> Path:
        """See :attr:`Reader.file`."""
        return self._readers[min(self._finished, len(self._readers) - 1)].path

    @property
    def bad(self) -> int:
        """See :attr:`Reader.bad`."""
        return sum(reader.bad for reader in self._readers)

    @property
    def lost(self) -> int:
        """See :attr:`Reader.lost`."""
        return sum(reader.lost for reader in self._readers)

    def chunks(self) -> Iterator[Rows]:
        """See :meth:`Reader.chunks`; the first row of each file but the first is marked."""
        bad_before = 0
        for reader in self._readers:
            is_first = True
            for rows in reader.chunks():
                marks: Mask = rows.begins.copy()
                marks[0] |= is_first and reader is not self._readers[0]
                is_first = False
                yield Rows(rows.times, rows.columns, rows.lines, rows.bad + bad_before, marks)
            bad_before += reader.bad
            self._finished += 1

    def describe(self) -> list[str]:
        """See :meth:`Reader.describe`."""
        return [*self._readers[0].describe(), f"from {len(self._readers)} files, each a recording of its own"]

    def summary_lines(self) -> list[str]:
        """See :meth:`Reader.summary_lines`."""
        return [f"{reader.path.name}: {', '.join(reader.summary_lines())}" for reader in self._readers]

    def warnings(self) -> list[str]:
        """See :meth:`Reader.warnings`."""
        return [f"{reader.path}: {line}" for reader in self._readers for line in reader.warnings()]


def _kind(reader: Reader) -> str:
    """Return the meaning of the times of a file."""
    kinds = reader.sampling
    return kinds if isinstance(kinds, Sampling) else ", ".join(f"{name} {kind}" for name, kind in kinds.items())
