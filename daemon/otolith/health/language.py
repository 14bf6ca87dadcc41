"""Texts for people in the language of a machine, from ``texts/en.toml`` and the like.

Rules and texts have a key. What the core, the twins and the drivers compose in English is translated by ``[phrases]``:
a phrase is an English sentence with names in braces, and a sentence that it matches becomes its translation, with the
parts translated too. What no phrase matches stays English.
"""

import re
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Literal, get_args

Language = Literal["en", "de"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
ALTERNATIVES = "; or "  # between the parts of a sentence, as the next
PARTS = "; "
MAX_SENTENCE = 500  # characters: the time of a match grows with a high power of them, and a device may write the text


@dataclass(frozen=True, slots=True)
class Texts:
    """The texts of a language."""

    language: Language
    rules: dict[str, dict[str, str]]  # Condition, cause and advice of each rule, by its id
    texts: dict[str, str]  # By key, with names in braces
    phrases: dict[str, str]  # Translations by the English phrase; empty for English
    patterns: tuple[tuple[re.Pattern[str], str], ...]  # The phrases with names in braces; the first that matches counts

    def __call__(self, key: str, **values: object) -> str:
        """Return the text of ``key`` with its values."""
        return self.texts[key].format(**values)

    def translated(self, text: str) -> str:
        """Return an English text in this language; what no phrase matches stays English."""
        if not self.phrases or not text:
            return text
        if (whole := self.phrases.get(text)) is not None:
            return whole
        for joint, own in ((ALTERNATIVES, self.texts["alternatives"]), (PARTS, PARTS)):
            if joint in text:
                return own.join(map(self.translated, text.split(joint)))
        if len(text) > MAX_SENTENCE:
            return text
        for pattern, translation in self.patterns:
            if match := pattern.fullmatch(text):
                return translation.format(**{name: self.translated(part) for name, part in match.groupdict().items()})
        return text


@lru_cache
def texts_in(language: Language) -> Texts:
    """Return the texts of a language."""
    content = tomllib.loads(files("otolith.health").joinpath("texts", f"{language}.toml").read_text(encoding="utf-8"))
    phrases: dict[str, str] = content.get("phrases", {})
    patterns = tuple((_pattern(phrase), text) for phrase, text in phrases.items() if "{" in phrase)
    return Texts(language, content["rules"], content["texts"], phrases, patterns)


def _pattern(phrase: str) -> re.Pattern[str]:
    """Return the expression of a phrase: each name in braces is any text, and ``share`` is a number."""
    expression = re.sub(r"\\{(\w+)\\}", r"(?P<\1>.*?)", re.escape(phrase)).replace("<share>.*?", r"<share>[<>]?[\d.]+")
    return re.compile(expression, re.DOTALL)
