"""Scripts as modules, so that tests call their `main`, and what these call in turn."""

import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any


def script(name: str) -> ModuleType:
    """A script as a module."""
    path = Path(__file__).parents[1] / "scripts" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recorded(monkeypatch, module: ModuleType, name: str, give: Callable[[Any], Any]) -> list[Any]:
    """The calls of a function from now on, each answered by `give`, with the arguments by their names.

    They are bound as the function declares them: one that it does not know, or lacks, is an error.
    """
    signature, calls = inspect.signature(getattr(module, name)), []

    def fake(*given, **named):
        bound = signature.bind(*given, **named)
        bound.apply_defaults()
        calls.append(SimpleNamespace(**bound.arguments))
        return give(calls[-1])

    monkeypatch.setattr(module, name, fake)
    return calls
