"""Seeded damage to files: text and binary, also inside what is compressed.

`mutate(content, suffix, rng)` gives a damaged copy and what was done. Members of archives and
compressed files are damaged inside too, with right checksums: a raw change is nearly always found
by the checksum, and what reads the content would not be tested.
"""

import bz2
import gzip
import io
import re
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np

WORDS = [b"nan", b"-1", b"1e400", b"999999999999999999", b"1000000000000000000000", b"0", b"-0.5",
         b"", b"x", b"1_0", b"inf", b"-inf", b"'", b'"', b"[", b"]", b"{", b"<a>", b"\x00",
         "é".encode(), b"\xff", b"\n", b",", b"-99", b"1e300", b"-1e300", b"1e-320", b"4294967296",
         b"true", b"null", b"0.1.2", b"1,5", b" ", b"a" * 5000]  # fmt: skip
"""In the place of a word of a text."""
NUMBERS = [struct.pack(form, value) for form, values in (
    ("<I", (0, 1, 2**31, 2**32 - 1, 2**31 - 1)), ("<H", (0, 1, 2**16 - 1)), ("<B", (0, 1, 255)),
    ("<Q", (0, 2**63, 2**64 - 1, 2**40)), (">I", (1, 2**31, 2**31 - 1)), (">H", (1, 2**15)),
    ("<d", (float("nan"), float("inf"), -1.0, 0.0, 1e300, -1e300, 1e-320)),
    ("<f", (float("nan"), float("inf"), -1.0, 0.0)),
) for value in values]  # fmt: skip
"""In the place of bytes."""
WORD = re.compile(rb"[^\s,;=:<>()\[\]\"']+")
NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
PACKED = (".npz", ".gz", ".bz2")


def mutate_folder(valid: Path, target: Path, rng: np.random.Generator) -> str:
    """A copy of a folder, with one file damaged one to three times; says how."""
    shutil.copytree(valid, target, dirs_exist_ok=True)
    files = sorted(p for p in target.rglob("*") if p.is_file())
    file = files[rng.integers(len(files))]
    content, done = file.read_bytes(), []
    # mostly one: two faults may hide behind each other
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        content, what = mutate(content, file.suffix.lower(), rng)
        done.append(what)
    file.write_bytes(content)
    return f"{file.relative_to(target)}: {', '.join(done)}"


def mutate(content: bytes, suffix: str, rng: np.random.Generator) -> tuple[bytes, str]:
    """A damaged copy, and what was done."""
    if suffix in PACKED and rng.random() < 0.8:
        inside = _mutate_inside(content, suffix, rng)
        if inside is not None:
            return inside
    text = b"\x00" not in content[:4096] and _is_utf8(content[:4096])
    ways = [cut, drop, repeat, flip, exchange_parts, grow]
    ways += [replace_word] * 4 + [exchange_numbers] * 2 + [line] * 2 if text else []
    ways += [] if text else [number, number, number, flip]
    way = ways[rng.integers(len(ways))]
    return way(content, rng), way.__name__


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode("utf-8", "strict")
    except UnicodeDecodeError as error:
        return error.start > len(content) - 4
    return True


def _mutate_inside(
    content: bytes, suffix: str, rng: np.random.Generator
) -> tuple[bytes, str] | None:
    try:
        if suffix != ".npz":
            packer = {".gz": gzip, ".bz2": bz2}[suffix]
            plain, what = mutate(packer.decompress(content), "", rng)
            return packer.compress(plain), f"inside {what}"
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:  # damaged before
        return None
    k, packed = int(rng.integers(len(members))), zipfile.ZIP_DEFLATED
    name, member = members[k]
    match rng.integers(12):
        case 0:
            del members[k]
            what = f"without {name}"
        case 1:
            members[k], what = (name.removesuffix(".npy"), member), f"{name} renamed"
        case 2:
            members.append((name.replace(".npy", "x.npy"), member))
            what = f"{name} twice"
        case 3:
            packed, what = [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2][rng.integers(2)], "other packing"
        case 4:
            members[k], what = (name, _other_array(rng)), f"{name} another array"
        case 5:
            zeros = io.BytesIO()
            np.save(zeros, np.zeros(2**22))  # 32 MB of nothing
            members[k], what = (name, zeros.getvalue()), f"{name} of zeros"
        case _:
            # half of the damage in the header of NumPy
            head, body = member[:128], member[128:]
            if rng.random() < 0.5:
                head, what = mutate(head[:10] + head[10:], "", rng)
            else:
                body, what = mutate(body, "", rng) if body else (body, "nothing")
            members[k], what = (name, head + body), f"{name} {what}"
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packed) as archive:
        for name, member in members:
            archive.writestr(zipfile.ZipInfo(name), member, packed)
    return out.getvalue(), what


def _other_array(rng: np.random.Generator) -> bytes:
    arrays = [np.zeros((2, 3)), np.array("word"), np.zeros(0), np.arange(5), np.zeros((2, 0, 3)),
              np.array([1 + 2j]), np.full((3, 3), np.nan), np.array([True, False]),
              np.array(["a", "b"]), np.full((4, 3), -(2**60)),
              np.array([(1, 2.0)], [("a", int), ("b", float)])]  # fmt: skip
    out = io.BytesIO()
    np.save(out, arrays[rng.integers(len(arrays))])
    return out.getvalue()


def place(content: bytes, rng: np.random.Generator) -> int:
    """An offset, half of them near the beginning or the end, where headers and tables are."""
    n = len(content)
    near = int(min(n, 400) * rng.random())
    return int([near, n - near, n * rng.random(), n * rng.random()][rng.integers(4)])


def cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: place(content, rng)]


def drop(content: bytes, rng: np.random.Generator) -> bytes:
    i = place(content, rng)
    return content[:i] + content[i + rng.integers(1, 64) :]


def repeat(content: bytes, rng: np.random.Generator) -> bytes:
    i = place(content, rng)
    return content[:i] + content[i : i + rng.integers(1, 512)] * rng.integers(2, 9) + content[i:]


def exchange_parts(content: bytes, rng: np.random.Generator) -> bytes:
    i, j = sorted((place(content, rng), place(content, rng)))
    length = int(rng.integers(1, 33))
    a, b = content[i : i + length], content[max(j, i + length) : max(j, i + length) + length]
    j = max(j, i + length)
    return content[:i] + b + content[i + length : j] + a + content[j + length :]


def grow(content: bytes, rng: np.random.Generator) -> bytes:
    i = place(content, rng)
    return content[:i] + rng.bytes(int(rng.integers(1, 200))) + content[i:]


def flip(content: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(content)
    for _ in range(rng.integers(1, 5) if damaged else 0):
        damaged[min(place(content, rng), len(damaged) - 1)] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def number(content: bytes, rng: np.random.Generator) -> bytes:
    i, new = place(content, rng), NUMBERS[rng.integers(len(NUMBERS))]
    return content[:i] + new + content[i + len(new) :]


def replace_word(content: bytes, rng: np.random.Generator) -> bytes:
    words = list(WORD.finditer(content))
    if not words:
        return content + WORDS[rng.integers(len(WORDS))]
    word = words[rng.integers(len(words))]
    return content[: word.start()] + WORDS[rng.integers(len(WORDS))] + content[word.end() :]


def exchange_numbers(content: bytes, rng: np.random.Generator) -> bytes:
    """Two numbers, or two words, exchanged."""
    kind = NUMBER if rng.random() < 0.7 else WORD
    found = list(kind.finditer(content))
    if len(found) < 2:
        return flip(content, rng)
    a, b = (found[k] for k in sorted(rng.choice(len(found), 2, replace=False)))
    between = content[a.end() : b.start()]
    return content[: a.start()] + b[0] + between + a[0] + content[b.end() :]


def line(content: bytes, rng: np.random.Generator) -> bytes:
    """A line removed, repeated, or exchanged with another."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    i, j = rng.integers(len(lines), size=2)
    match rng.integers(3):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)
