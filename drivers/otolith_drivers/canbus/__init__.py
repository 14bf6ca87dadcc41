"""The CAN driver. Other packages import python-can from here."""

from otolith_drivers import import_refused

# python-can imports asammdf, and with it pandas, wherever it is installed: 1 s and 140 MB in every process. Only the
# reader of MF4 files needs it. python-can has no switch for it.
with import_refused("asammdf"):
    import can

__all__ = ["can"]
