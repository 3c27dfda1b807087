"""Output to terminals, pipes and files that are not UTF-8.

The command line calls `write_everywhere` first. What an encoding lacks is then written in ASCII,
"s0" for σ0, "chi2" for χ², and names of files with the bytes that they have; in UTF-8 nothing
changes. JSON is written by `write_json`: there such characters become escapes.
"""

import codecs
import re
import sys
from collections.abc import Iterable

HANDLER = "jaxbundle.ascii"
# As `sX` is the column of σX in tables: one letter, so that columns stay aligned.
ASCII = {
    "σ": "s", "µ": "u", "μ": "u", "·": "*", "−": "-", "–": "-", "—": "-", "─": "-", "━": "-",
    "×": "x", "±": "+-", "≤": "<=", "≥": ">=", "≠": "!=", "≈": "~", "√": "sqrt", "∞": "inf",
    "→": "->", "←": "<-", "°": "deg", "′": "'", "⁄": "/", "∂": "d", "∇": "grad", "∠": "angle",
    "λ": "lambda", "ŝ": "s",
}  # fmt: skip


SURROGATES = re.compile("[\ud800-\udfff]")


def write_everywhere() -> None:
    """Let standard output and error write any text, whatever their encoding."""
    codecs.register_error(HANDLER, _replace)
    for stream in (sys.stdout, sys.stderr):
        if reconfigure := getattr(stream, "reconfigure", None):
            reconfigure(errors=HANDLER)


def write_json(text: str | Iterable[str]) -> None:
    """Write JSON, or its pieces, to standard output: in UTF-8, or with escapes."""
    codec = codecs.lookup(sys.stdout.encoding or "utf-8").name
    for piece in map(in_utf8, (text,) if isinstance(text, str) else text):
        sys.stdout.write(piece if codec.startswith("utf") else re.sub("[^\0-\x7f]", _escape, piece))


def in_utf8(text: str) -> str:
    """A text without what UTF-8 cannot write: bytes in names of files (`os.fsdecode`) that are no
    UTF-8, and halves of letters. Names that Python could not read in a locale without UTF-8 become
    what they are."""
    if not SURROGATES.search(text):
        return text
    text = re.sub("[\ud800-\udc7f\udd00-\udfff]", "\ufffd", text)
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def for_output(text: str) -> str:
    """A text as standard output can write it."""
    codec = getattr(sys.stdout, "encoding", None) or "utf-8"
    codecs.register_error(HANDLER, _replace)
    return text.encode(codec, HANDLER).decode(codec, "surrogateescape")


def for_printing(text: str) -> str:
    """A text that `print` can write: unchanged where its stream replaces what it cannot write."""
    strict = getattr(sys.stdout, "errors", None) in (None, "strict")
    return for_output(text) if strict else text


def _escape(match: re.Match) -> str:
    # JSON escapes are units of UTF-16: letters beyond U+FFFF have two.
    units = match[0].encode("utf-16-be")
    return "".join(f"\\u{units[i : i + 2].hex()}" for i in range(0, len(units), 2))


def _replace(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letter = error.object[error.start]
    if "\udc80" <= letter <= "\udcff":  # a byte of the name of a file (`os.fsdecode`)
        return bytes([ord(letter) - 0xDC00]), error.start + 1
    return _in_ascii(letter), error.start + 1


def _in_ascii(letter: str) -> str:
    if letter.isascii():
        return letter
    if letter in ASCII:
        return ASCII[letter]
    import unicodedata

    if unicodedata.decomposition(letter).startswith("<"):  # ², ᵀ, ₀, ½, …
        return "".join(map(_in_ascii, unicodedata.normalize("NFKD", letter)))
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK"):
        return name.split(" WITH ")[0].split()[-1].lower()
    category = unicodedata.category(letter)
    if category == "Mn":  # the ̂ of an estimate
        return ""
    return letter.encode("ascii", "backslashreplace").decode() if category[0] in "LMNC" else "*"
