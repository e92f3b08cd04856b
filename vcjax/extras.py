"""Packages that only some of the work needs: loaded where it begins, with the remedy where they are missing."""

import importlib
from typing import Any


def load(package: str, need: str, extra: str) -> Any:
    """An optional package.

    Args:
        package: its name, as it is imported.
        need: what needs it, the beginning of a sentence.
        extra: the extra of vcjax that installs it.

    Raises:
        ModuleNotFoundError: if it is not installed, with the remedy.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{need} need {package}: pip install 'vcjax[{extra}]'.") from error
