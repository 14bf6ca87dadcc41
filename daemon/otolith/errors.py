"""The errors a user can meet; the tree is drawn in :mod:`otolith_drivers.errors`, where the lowest house begins."""

from otolith_drivers.errors import ConfigurationError, DeviceError, OtolithError, ServiceError, nearest

__all__ = ["ConfigurationError", "DeviceError", "OtolithError", "ServiceError", "nearest"]
