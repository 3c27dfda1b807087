"""What a reader runs of README and docs: the commands and the Python blocks, in their order.

A fenced block without a language, or of `sh`, is of commands. Where lines of it, or of a `text`
block, begin with `$ `, these alone are commands, and the others what they print. A Python block
whose names are all its own is a process; one that uses names of the blocks before it continues
these, so that a process runs all blocks up to the last one that continues.
"""

import ast
import builtins
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Process:
    """A command for a shell, or Python code, and the line of the page where it stands."""

    page: str
    line: int
    text: str
    python: bool = False

    @property
    def name(self) -> str:
        first = f"Python of {self.text.count(chr(10))} lines" if self.python else self.text
        return f"{self.page}:{self.line} {first.splitlines()[0]}"


def pages() -> list[str]:
    """README first, then the pages of the documentation."""
    return ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]


def processes_of(page: str) -> list[Process]:
    """The processes of a page, in their order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found, chain = [], None
    for block in BLOCK.finditer(text):
        language, content = block.groups()
        line = text.count("\n", 0, block.start()) + 2
        if language == "python":
            if chain is not None and foreign_names(content):
                found.remove(chain)
                # The lines keep their numbers, so that an error names that of the page.
                between = "\n" * (line - chain.line - chain.text.count("\n"))
                chain = Process(page, chain.line, chain.text + between + content, python=True)
            else:
                chain = Process(page, line, content, python=True)
            found.append(chain)
        elif prompts := re.findall(r"^\$ (.*)$", content, re.M):
            if language in ("", "sh", "console", "text"):
                found += [Process(page, line, command) for command in prompts]
        elif language in ("", "sh"):
            found += [Process(page, line + n, command) for n, command in commands_of(content)]
    return found


def commands_of(block: str) -> Iterator[tuple[int, str]]:
    """The commands of a block, each with its line: as many lines as make one complete."""
    lines: list[str] = []
    for number, line in enumerate(block.splitlines()):
        if not lines and (not line.strip() or line.startswith("#")):
            continue
        lines.append(line)
        text = "\n".join(lines)
        if not line.endswith("\\") and is_complete(text):
            yield number + 1 - len(lines), text
            lines = []
    if lines:
        raise ValueError(f"no complete command: {lines}")


def is_complete(text: str) -> bool:
    return not subprocess.run(["bash", "-n", "-c", text], capture_output=True).returncode


def foreign_names(code: str) -> set[str]:
    """Names that code uses and defines nowhere."""
    used, defined = set(), set(dir(builtins))
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Name(id=name, ctx=ast.Load()):
                used.add(name)
            case ast.Name(id=name) | ast.arg(arg=name):
                defined.add(name)
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                defined.add(name)
            case ast.alias(name="*"):
                return set()
            case ast.alias(name=name, asname=other):
                defined.add((other or name).split(".")[0])
    return used - defined
