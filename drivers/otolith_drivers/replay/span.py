"""A part of recorded data: the rows from one time to another."""

from collections.abc import Iterator
from types import TracebackType

import numpy as np

from otolith_drivers.replay.readers import Reader, Rows


class SpanReader(Reader):
    """Passes on the rows of another reader from ``begin`` to ``end`` (s, as its times)."""

    def __init__(self, reader: Reader, begin: float, end: float) -> None:
        super().__init__(reader.path)
        self._reader, self._begin, self._end = reader, begin, end
        self.place, self.is_table, self.sampling = reader.place, reader.is_table, reader.sampling
        self.ignored = reader.ignored

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._reader.__exit__(kind, error, _)

    @property
    def progress(self) -> float:
        """Share of the data that was read, 0 to 1."""
        return self._reader.progress

    @property
    def bad(self) -> int:
        return self._reader.bad

    @property
    def lost(self) -> int:
        return self._reader.lost

    def chunks(self) -> Iterator[Rows]:
        begins = False  # whether a recording began in rows that were left out
        for rows in self._reader.chunks():
            inside = np.flatnonzero((rows.times >= self._begin) & (rows.times <= self._end))
            if not len(inside):
                begins = begins or bool(rows.begins.any())
                continue
            first, last = int(inside[0]), int(inside[-1])
            part = rows.part(slice(first, last + 1))
            if begins or rows.begins[:first].any():
                marks = part.begins.copy()
                marks[0] = True
                part = rows.part(slice(first, last + 1), marks)
            begins = bool(rows.begins[last + 1 :].any())
            yield part

    def describe(self) -> list[str]:
        return self._reader.describe()

    def summary_lines(self) -> list[str]:
        return self._reader.summary_lines()

    def warnings(self) -> list[str]:
        return self._reader.warnings()
