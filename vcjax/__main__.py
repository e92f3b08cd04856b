"""The `vcjax` command, also `python -m vcjax`: the command line, or one line that says what it lacks."""

import sys


def main() -> int:
    """Entry point; returns the exit status."""
    try:
        from vcjax.cli import main as command_line
    except ModuleNotFoundError as error:
        print(f"vcjax: the command line needs {error.name}: pip install 'vcjax[study]'.", file=sys.stderr)
        return 1
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
