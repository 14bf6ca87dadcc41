"""The CAN driver. Other packages import python-can from here."""

import sys

# python-can imports asammdf, and with it pandas, wherever it is installed: 1 s and 140 MB in every process. Only the
# reader of MF4 files needs it. python-can has no switch for it, so an import of it fails at once meanwhile.
ASAMMDF = "asammdf"
sys.modules.setdefault(ASAMMDF, None)  # type: ignore[arg-type]  # None makes an import fail
import can  # noqa: E402 - after the line above

if sys.modules[ASAMMDF] is None:
    del sys.modules[ASAMMDF]

__all__ = ["can"]
