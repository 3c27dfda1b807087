"""The lines of a text file as rows of words; errors name the file and the line."""

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_text

# Characters, of some hundred numbers: longer rows are read without a text for each number, four
# times faster; in shorter ones the guard around it costs more than it gains.
LONG_ROW = 1000
# Characters from which it pays to import pyarrow, a tenth of a second.
LONG_TEXT = 1_000_000
BLANK_TO_LINE = bytes.maketrans(b" \t", b"\n\n")
# A number that no line has, since they are finite: where the next line begins.
END_OF_LINE = " nan\n"
BLANKS = "; blanks separate columns, so that no name may have one"


def is_number(word: str) -> bool:
    """Whether a word is a number, also one that is not finite."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def join_numbers(values: Iterable[float], separator: str = " ") -> str:
    """Numbers as text that reads back to the last bit (`repr` is the shortest such text)."""
    return separator.join(repr(float(value)) for value in values)


def parse_numbers(text: str) -> Float[np.ndarray, " n"]:
    """The numbers of a text that blanks and line feeds separate, without a text for each.

    **Raises:** `ValueError` for anything else."""
    if len(text) > LONG_TEXT and (numbers := _parse_by_arrow(text)) is not None:
        return numbers
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # about text that is not a number
        try:
            return np.fromstring(text, sep=" ")
        except DeprecationWarning as error:
            raise ValueError(f"{error}") from None


def _parse_by_arrow(text: str) -> Float[np.ndarray, " n"] | None:
    """The same numbers by pyarrow, where it is installed; None if it refuses the text, too.

    Both round as IEEE 754 has it, and refuse what is no number; 2.6 times faster.
    """
    try:
        import pyarrow as pa
        from pyarrow import csv
    except ImportError:
        return None
    try:
        # One column: a number a line.
        content = text.encode("ascii").translate(BLANK_TO_LINE)
        table = csv.read_csv(
            pa.BufferReader(content),
            csv.ReadOptions(use_threads=False, column_names=["x"]),
            csv.ParseOptions(quote_char=False),
            csv.ConvertOptions(column_types={"x": pa.float64()}, null_values=[]),
        )
    except (pa.ArrowException, UnicodeEncodeError):
        return None
    return table["x"].to_numpy()


def parse_lines(lines: Iterable[str]) -> list[Float[np.ndarray, " n"]] | None:
    """The numbers of every line, all lines at once; None if something is not a finite number."""
    lines = list(lines)
    try:
        numbers = parse_numbers(END_OF_LINE.join([*lines, ""]))
    except ValueError:
        return None
    ends = np.flatnonzero(np.isnan(numbers))
    if len(ends) != len(lines) or np.isinf(numbers).any():
        return None
    # Views of one array.
    return [numbers[a:b] for a, b in zip([0, *(ends[:-1] + 1).tolist()], ends.tolist())]


class TextRow:
    """A line of a file: its location, text, and words."""

    def __init__(self, path: Path, number: int, text: str, separator: str | None = None):
        self.path, self.number, self.text = path, number, text
        self.separator = separator

    @cached_property
    def words(self) -> list[str]:
        """The words; not split before they are needed: rows of numbers have many."""
        words = self.text.split(self.separator)
        # Blanks as separators leave none in the words.
        return words if self.separator is None else [word.strip() for word in words]

    def __len__(self) -> int:
        return len(self.words)

    @property
    def location(self) -> str:
        """File and line."""
        return f"{self.path}, line {self.number}"

    def error(self, message: str) -> InputError:
        """An error about this line, to be raised."""
        return InputError(f"{self.location}: {message}")

    def numbers(
        self, names: Sequence[str], begin: int = 0, allow_more: bool = False
    ) -> Float[np.ndarray, " n"]:
        """The numbers from the word `begin` on, called `names`; no others unless `allow_more`."""
        words = self.words[begin:]
        if len(words) < len(names) or (len(words) > len(names) and not allow_more):
            hint = BLANKS if len(words) > len(names) and self.separator is None else ""
            raise self.error(
                f"{len(words)} values where {len(names)} are expected ({', '.join(names)}){hint}"
            )
        return np.array([self._number(word, word_name) for word, word_name in zip(words, names)])

    def all_numbers(self, name: str) -> Float[np.ndarray, " n"]:
        """All words as numbers, each called `name` in messages."""
        try:
            if self.separator is None and len(self.text) > LONG_ROW:
                numbers = parse_numbers(self.text)
            else:
                numbers = np.array(self.words, float) if self.words else np.zeros(0)
        except ValueError:
            numbers = np.array([np.nan])
        # Python and NumPy read "1_0" as ten; in a file it is a name, or a mistake.
        if not np.isfinite(numbers).all() or "_" in self.text:
            return np.array([self._number(word, name) for word in self.words])
        return numbers

    def integer(self, k: int, name: str, minimum: int = 0) -> int:
        """The k-th word as a whole number."""
        word = self.words[k] if k < len(self.words) else ""
        digits = word.removeprefix("-")
        # 18 digits fit in 64 bits; isascii, because digits of other scripts count as digits
        if not (digits.isascii() and digits.isdigit() and len(digits) < 19) or int(word) < minimum:
            raise self.error(f"{name} is {show(word)}; expected a whole number from {minimum}")
        return int(word)

    def rays(self, k: int, row_name: str, images: int, image_name: str) -> Float[np.ndarray, "n 4"]:
        """The rays that end a row, of which number `k` is the count: image, key, x, y each; images
        are numbered from 0 to `images` − 1."""
        numbers, announced = self.all_numbers(row_name), self.integer(k, "the number of rays")
        if len(numbers) != k + 1 + 4 * announced:
            raise self.error(
                f"{announced} rays are announced; {4 * announced} numbers should follow, not "
                f"{len(numbers) - k - 1}"
            )
        rays = numbers[k + 1 :].reshape(-1, 4)
        for number in rays[:, 0]:
            if not (0 <= number < images and number % 1 == 0):
                raise self.error(
                    f"{image_name} {number:g} does not exist; there are {images}, from 0"
                )
        return rays

    def _number(self, word: str, name: str) -> float:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in word:
            raise self.error(f"{name} is {show(word)}; expected a number")
        return number


class TextRows:
    """The lines of a file in sequence.

    **Arguments:** `comment` begins lines to skip; `blank` whether empty lines count;
    `separator` of the words, blanks if None; `fallback` the encoding if it is not UTF-8.
    """

    def __init__(
        self,
        path: Path,
        comment: str = "",
        blank: bool = False,
        separator: str | None = None,
        fallback: str = "",
    ):
        self.path = path
        self.lines = [
            (number, line)
            for number, line in enumerate(read_text(path, fallback).splitlines(), 1)
            if (blank or (line and not line.isspace()))
            # Most lines have none of it, and need not be copied without their blanks.
            and not (comment and comment in line and line.lstrip().startswith(comment))
        ]
        self.separator = separator
        self.position = 0

    def __iter__(self) -> Iterator[TextRow]:
        while self.has_more():
            yield self.take("a line")

    def has_more(self) -> bool:
        """Whether there is another line."""
        return self.position < len(self.lines)

    def take(self, expected: str) -> TextRow:
        """The next line; `expected`: its content in words, for messages.

        **Raises:** `InputError` if the file has ended.
        """
        if not self.has_more():
            last_line = self.lines[-1][0] if self.lines else 0
            raise InputError(
                f"{self.path}: the file ends after line {last_line}; expected {expected}"
            )
        number, text = self.lines[self.position]
        self.position += 1
        return TextRow(self.path, number, text, self.separator)

    def next_words(self) -> list[str]:
        """The words of the next line without taking it; none at the end of the file."""
        return self.lines[self.position][1].split(self.separator) if self.has_more() else []
