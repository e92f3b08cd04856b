"""What commands say: lines, a bar of progress; and the random key they are given by its number."""

import contextlib
from collections.abc import Callable, Iterator

import jax
from jaxtyping import PRNGKeyArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


def numbered_key(number: int) -> PRNGKeyArray:
    """The random key of a number.

    Raises:
        ValueError: if it is negative, or has more than 63 bits.
    """
    if not 0 <= number < 2**63:
        raise ValueError(f"--key {number}: give a whole number from 0 to 2**63 - 1.")
    return jax.random.key(number)


@contextlib.contextmanager
def progress_bar(console: Console, description: str) -> Iterator[Callable[..., None]]:
    """A progress bar; gives a function of (done, total) or (done, total, description) that moves it.

    When the work is refused, the bar goes, so that what is wrong stands alone.
    """
    columns = (BarColumn(16), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bar = Progress(TextColumn("{task.description}"), *columns, console=console)
    task = bar.add_task(description, total=None)

    def show(done: int, total: int, description: str | None = None) -> None:
        bar.update(task, completed=done, total=total, description=description)

    bar.start()
    try:
        yield show
    except Exception:
        bar.live.transient = True
        bar.live.stop()
        raise
    except BaseException:
        bar.stop()
        raise
    bar.stop()


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line as it is, without markup and never broken; what a terminal would obey is written out."""
    text = "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)
