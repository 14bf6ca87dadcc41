"""What a machine file says of frames and what is in them; the same for a bus and for a recording of one."""

from pathlib import Path

from otolith_drivers.toml_files import Closed


class FrameOptions(Closed):
    """What describes the frames."""

    dbc: Path | tuple[Path, ...] = ()
    """The CAN database (DBC, KCD, SYM or ARXML), or several."""

    def databases(self) -> tuple[Path, ...]:
        """The databases, as written."""
        return (self.dbc,) if isinstance(self.dbc, Path) else self.dbc
