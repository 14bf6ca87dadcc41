"""Values of a configuration as a file has them: with their units."""

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo

from otolith_drivers.grammars.toml_lines import toml_value
from otolith_drivers.units import Quantity


def written_value(field: FieldInfo, value: Any) -> str:
    """Return ``value`` of a field as TOML has it; a quantity with the unit that the field states."""
    quantity = next(
        (one.func for one in field.metadata if isinstance(one, BeforeValidator) and isinstance(one.func, Quantity)),
        None,
    )
    if quantity is not None and isinstance(value, int | float) and not quantity.is_plain_number:
        return toml_value(f"{value:.9g} {quantity.unit}")
    return toml_value(plain(value))


def plain(value: Any) -> Any:
    """Return a validated value as numbers, texts, lists and tables; what is None is left out."""
    if isinstance(value, BaseModel):
        return plain({name: getattr(value, name) for name in type(value).model_fields})
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, Path) else value
