"""Pieces of JSON and Markdown that reports share."""

import math
from collections.abc import Iterable, Sequence
from typing import Any


def with_nulls(value: Any) -> Any:
    """Plain values, with null for numbers that JSON does not know."""
    if isinstance(value, dict):
        return {key: with_nulls(item) for key, item in value.items()}
    if isinstance(value, list):
        return [with_nulls(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def grid(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
