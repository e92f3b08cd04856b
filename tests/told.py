"""What a command says, and the one line that it says of bad input."""


def said(capsys) -> tuple[str, str]:
    """What went to standard output and to standard error."""
    found = capsys.readouterr()
    return found.out, found.err


def assert_one_line(told: str, *words: str) -> None:
    assert len(told.strip().splitlines()) == 1 and "Traceback" not in told, told
    assert told.startswith("vcjax: ") and "dummy" not in told, told
    for word in words:
        assert word in told, told
