"""Set-up of all tests: float64, shapes and types of the package checked at run time, golden numbers at hand."""

import json
from functools import cache
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)

# Checks every call of the package against its annotations; while tracing, so that compiled code pays nothing. It must
# be set up before the package is imported anywhere.
jaxtyping.install_import_hook("vcjax", "beartype.beartype")

# The same examples in every run. Their time is mostly compilation, which the first of them pays: no deadline.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=60)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Compiled programs dropped before there are too many: each is several mappings, of which Linux allows 65 530.

    Beyond them the next program is a crash of the interpreter.
    """
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and len(mappings.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()


@pytest.fixture
def unchecked():
    """Run-time checks off, as users have it: bad input meets the package's own refusals."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def golden():
    """The contents of a file of tests/golden, by its name."""
    return cache(lambda name: json.loads((Path(__file__).parent / "golden" / name).read_text()))


@pytest.fixture(scope="session")
def folder():
    """Rendered images with their calibration, as `plain_folder` finds them."""
    from rendered import rendered

    return rendered().sequence.paths[0].parent.parent


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    """What `vcjax run` writes of them."""
    import recorded

    from vcjax.cli import main

    out = tmp_path_factory.mktemp("run") / "vc"
    jaxtyping.config.update("jaxtyping_disable", True)  # as `unchecked` does for a test
    try:
        command = ["run", str(recorded.recording_path()), *recorded.OPTIONS, "--out", str(out), "--pictures", "2"]
        assert main(command) == 0
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    return out
