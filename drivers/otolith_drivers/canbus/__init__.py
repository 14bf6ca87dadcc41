"""The CAN driver. Other packages import python-can from here."""

import sys

# python-can imports asammdf, and with it pandas, wherever it is installed: 1 s and 140 MB in every process. Only the
# reader of MF4 files needs it.
ASAMMDF = "asammdf"
_is_loaded = ASAMMDF in sys.modules
if not _is_loaded:
    sys.modules[ASAMMDF] = None  # type: ignore[assignment]  # an import of it fails at once
try:
    import can
finally:
    if not _is_loaded:
        del sys.modules[ASAMMDF]

__all__ = ["can"]
