"""Text of others in the formats that are published: one function for each place where text is put.

All show hidden characters as `visible` does, so that no line break and no control character is left.
"""

import json
import re
import unicodedata
from html import escape
from typing import Any

from imfvla.process.visible import visible

FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")  # the wide ones begin a formula in some languages
GREEK = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "epsilon", "θ": "theta", "λ": "lambda", "μ": "mu",
    "π": "pi", "ρ": "rho", "σ": "sigma", "φ": "phi", "ω": "omega",
}  # fmt: skip
LATEX = (
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {character: rf"$\{name}$" for character, name in GREEK.items()}
    | {
        "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
        "|": r"\textbar{}", "'": r"\textquotesingle{}", "`": r"\textasciigrave{}", "×": r"$\times$", "≥": r"$\geq$",
        "≤": r"$\leq$", "±": r"$\pm$", "°": r"$^\circ$", "·": r"$\cdot$", "→": r"$\to$", "µ": r"$\mu$", "–": "--",
        "—": "---", "…": r"\ldots{}", "“": "``", "”": "''", "’": "'", "ß": r"\ss{}", "æ": r"\ae{}", "Æ": r"\AE{}",
        "ø": r"\o{}", "Ø": r"\O{}", "ł": r"\l{}", "Ł": r"\L{}",
    }
)  # fmt: skip
ACCENTS = {  # of combining characters
    "\u0300": "`", "\u0301": "'", "\u0302": "^", "\u0303": "~", "\u0304": "=", "\u0306": "u", "\u0307": ".",
    "\u0308": '"', "\u030a": "r", "\u030b": "H", "\u030c": "v", "\u0327": "c",
}  # fmt: skip


def csv_cell(text: str) -> str:
    """A cell that no spreadsheet takes for a formula: an apostrophe precedes = + - and @, except before a number."""
    text = visible(text)
    return f"'{text}" if text.startswith(FORMULA) and not _is_number(text) else text


def markdown_text(text: str) -> str:
    """Running text. What would be HTML, an entity, code, emphasis, a link or a picture is shown as it is written.

    An underscore within a word and brackets without an address mean nothing in Markdown and stay.
    """
    text = re.sub(r"[\\`*]|(?<!\w)_|_(?!\w)|\](?=[(\[:])", r"\\\g<0>", visible(text))
    return re.sub(r"&(?=#?\w+;)", "&amp;", text).replace("<", "&lt;") if _is_markup(text) else text


def markdown_cell(text: str) -> str:
    """A cell of a table."""
    return markdown_text(text).replace("|", "\\|")


def markdown_code(text: str) -> str:
    """Code within a line, between more backticks than it has in a row."""
    text = visible(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    blank = " " if len(fence) > 1 else ""
    return f"{fence}{blank}{text}{blank}{fence}"


def latex_text(text: str) -> str:
    """ASCII for any LaTeX engine: special characters escaped, accents as commands, other signs as in U+4F60."""
    return "".join(map(_latex, unicodedata.normalize("NFC", visible(text))))


def latex_cell(text: str) -> str:
    r"A cell of a table. Its first character is no argument of the \\ or the \midrule before it."
    text = latex_text(text)
    return f"{{}}{text}" if text.startswith(("[", "*")) else text


def html_text(text: str) -> str:
    """Text between tags, and the value of an attribute in quotes."""
    return escape(visible(text))


def html_json(value: Any) -> str:
    """JSON inside of a script element, which no text in it ends."""
    return json.dumps(value).replace("<", "\\u003c")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_markup(text: str) -> bool:
    return re.search(r"<[A-Za-z/!?]|&#?\w+;", text) is not None


def _latex(character: str) -> str:
    if character in LATEX or character.isascii():
        return LATEX.get(character, character)
    base, *accents = unicodedata.normalize("NFD", character)
    if base.isascii() and len(accents) == 1 and accents[0] in ACCENTS:
        return rf"\{ACCENTS[accents[0]]}{{{base}}}"
    return " " if unicodedata.category(character) == "Zs" else f"U+{ord(character):04X}"
