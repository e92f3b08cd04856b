"""Pieces of Markdown that reports share."""

from collections.abc import Iterable, Sequence


def grid(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def counted(num: int, what: str) -> str:
    """E.g. "1 seed", "2 seeds"."""
    return f"{num} {what}" if num == 1 else f"{num} {what}s"
