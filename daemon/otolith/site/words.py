"""The words of the pages of a site, beside those of :mod:`otolith.health.text`."""

import tomllib
from functools import lru_cache
from importlib.resources import files

from otolith.health.schema import LANGUAGES, Language


@lru_cache
def words_in(language: Language) -> dict[str, str]:
    """Return the words of a language by their key."""
    content: dict[str, dict[str, str]] = tomllib.loads(
        files("otolith.site").joinpath("pages", "words.toml").read_text(encoding="utf-8")
    )
    return content[language]


def accepted(header: str) -> Language:
    """Return the language that a browser prefers by its header ``Accept-Language``; English if none is there."""
    for part in header.split(",")[:10]:
        tag = part.partition(";")[0].strip().lower().partition("-")[0]
        for language in LANGUAGES:
            if tag == language:
                return language
    return "en"
