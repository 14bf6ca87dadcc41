"""The cells of a text table as numbers: decimal signs, separated thousands, words for true and false, blank cells.

The kernels of pyarrow convert a chunk at once. ``pyarrow.csv`` is not used: it stops at the first bad cell without its
line, lets an open quote swallow the lines below, and knows neither comments nor rows of varying width.
"""

import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers.replay.readers import Array, Mask
from otolith_drivers.replay.table.header import BLANK, NUMBER, is_number

MIN_GROUPED = 10  # cells like 1.001, and whole numbers, from which on it is asked whether thousands are separated
LAST_SIGNS = {".": r",.*\.\d*$", ",": r"\..*,\d*$"}  # of a cell with both signs
# A number whose thousands are separated, by {} or a space: three digits alone behind the other sign may be decimals.
THOUSANDS = (
    r"^[+-]?\d{{1,3}}(?:(?:{0}\d{{3}})+\.\d+|(?:{0}\d{{3}}){{2,}}"
    r"|(?:[ '\x{{2019}}\x{{a0}}\x{{202f}}]\d{{3}})+(?:\.\d*)?)$"
)

WORDS = ((r"(?i)^(?:true|wahr)$", "1"), (r"(?i)^(?:false|falsch)$", "0"))  # as programs write bits


def text_of(cells: pa.ListArray, places: list[int] | None) -> Mask:
    """Which of the lists of cells have a text, at one of the ``places`` if they are given."""
    if places is None:
        return has_text(cells)
    texts = [pc.utf8_trim_whitespace(pc.list_element(cells, place)) for place in places]
    mask: Mask = pc.not_equal(pc.binary_join_element_wise(*texts, ""), "").to_numpy(zero_copy_only=False)
    return mask


def has_text(cells: pa.ListArray) -> Mask:
    """Which of the lists of cells have a cell that is not empty."""
    text = pc.utf8_trim_whitespace(pc.binary_join(cells, ""))
    mask: Mask = pc.not_equal(text, "").to_numpy(zero_copy_only=False)
    return mask


def decimal_sign(texts: list[pa.StringArray]) -> str:
    """The decimal sign that most of the cells use; empty if none uses any. Of two signs in a cell it is the last."""
    points, commas = (sum(pc.sum(pc.count_substring(text, sign)).as_py() or 0 for text in texts) for sign in ".,")
    if points and commas:
        last = {sign: sum(count(text, pattern) for text in texts) for sign, pattern in LAST_SIGNS.items()}
        points, commas = (last["."], last[","]) if any(last.values()) else (points, commas)
    return "" if points == commas == 0 else "," if commas > points else "."


def ambiguous_cell(texts: list[pa.StringArray]) -> str:
    """A cell that may have separated thousands or decimals, where whole numbers and such cells are all that there is.

    Decimals of three digits each beside whole numbers are improbable, unless there are few.
    """
    cells = pc.utf8_trim_whitespace(pa.concat_arrays(texts)) if texts else pa.array([], pa.string())
    signed = cells.filter(pc.match_substring_regex(cells, "[.,]"))
    grouped = count(signed, r"^[+-]?[1-9]\d{0,2}[.,]\d{3}$")
    whole = count(cells, r"^[+-]?\d{1,3}$")
    return str(signed[0]) if MIN_GROUPED <= grouped == len(signed) and whole >= MIN_GROUPED else ""


def count(texts: pa.StringArray, pattern: str) -> int:
    """How many of the texts have the pattern."""
    return pc.sum(pc.match_substring_regex(texts, pattern)).as_py() or 0


def numbers(texts: pa.StringArray, decimal: str) -> Array:
    """The numbers of a column: NaN for a blank cell, infinity for one that is no number.

    A cell with the other decimal sign is no number, unless that clearly separates thousands.
    """
    texts = pc.utf8_trim_whitespace(texts)
    if decimal == ",":
        texts = pc.replace_substring(pc.replace_substring(texts, ".", "\x1f"), ",", ".")
    try:
        numbers = texts.cast(pa.float64())
    except pa.ArrowInvalid:
        texts = pc.replace_substring(texts, "\u2212", "-")  # the minus of typesetters
        grouped = pc.match_substring_regex(texts, THOUSANDS.format(r"\x1f" if decimal == "," else ","))
        texts = pc.if_else(grouped, pc.replace_substring_regex(texts, r"[^\d.+-]", ""), texts)
        for pattern, number in WORDS:
            texts = pc.if_else(pc.match_substring_regex(texts, pattern), number, texts)
        known = pc.if_else(pc.match_substring_regex(texts, BLANK), "nan", "inf")
        numbers = pc.if_else(pc.match_substring_regex(texts, NUMBER), texts, known).cast(pa.float64())
    array: Array = numbers.to_numpy()
    return array


def changes(texts: pa.StringArray, before: str | None) -> tuple[Mask, str | None]:
    """Which cells have another text than the one above, and the last text; a blank cell repeats that above.

    ``before`` is the text above all of them, None if there is none.
    """
    texts = pc.utf8_trim_whitespace(texts)
    texts = pc.if_else(pc.match_substring_regex(texts, BLANK), pa.scalar(None, pa.string()), texts)
    texts = pc.fill_null_forward(pa.concat_arrays([pa.array([before], pa.string()), texts]))
    changed: Mask = pc.fill_null(pc.not_equal(texts[1:], texts[:-1]), False).to_numpy(zero_copy_only=False)
    return changed, texts[-1].as_py()


def other_sign(text: str, decimal: str) -> str:
    """A clause for a cell that is a number but for its decimal sign."""
    return f", but {decimal!r} is the decimal sign of other cells" if decimal and is_number(text) else ""
