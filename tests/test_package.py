"""The package as a whole: what importing it does and does not do, and the order of its rooms."""

import ast
import inspect
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import vcjax

PACKAGE = Path(vcjax.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# Imports run one way: a room may use those named here and itself, and no other. The first three are below everything.
ROOMS = {
    "extras": set(),
    "fields": set(),
    "storage": set(),
    "models": {"fields"},
    "recording": {"fields", "models"},
    "ekf": {"fields", "models"},
    "gates": {"fields", "models", "recording", "ekf"},
    "filter": {"fields", "models", "recording", "ekf", "gates"},
    "simulation": {"fields", "models", "recording"},
    "devices": set(),
    "sources": {"extras", "fields", "storage", "models", "recording", "simulation"},
    "study": (
        below_study := {
            "extras",
            "fields",
            "storage",
            "models",
            "recording",
            "ekf",
            "gates",
            "filter",
            "simulation",
            "sources",
            "devices",
        }
    ),
    "tuning": (above_study := below_study | {"study"}),
    "detectability": above_study | {"tuning"},
    "recorded": above_study,
    "report": (results := above_study | {"tuning", "detectability", "recorded"}),
    "commands": results | {"report"},
    "cli": {"filter", "study", "commands"},
    "__main__": {"cli"},
}


def room(module: Path) -> str:
    """The room of a file: its folder in the package, or its own name."""
    return module.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(module: Path) -> set[str]:
    """Rooms of the package that a file imports from, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = [name.split(".") for name in names]
    return {part[1] for part in parts if part[0] == "vcjax" and len(part) > 1}


def test_rooms_are_ordered_without_a_circle():
    seen = set()
    for name, below in ROOMS.items():
        assert below <= seen, name
        seen.add(name)


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(module):
    if module == PACKAGE / "__init__.py":
        return  # gathers from all rooms
    assert room(module) in ROOMS, "a new room: give it its place"
    assert imported_rooms(module) <= ROOMS[room(module)] | {room(module)}


def test_the_reader_of_imports_sees_them(tmp_path):
    source = "import vcjax.study.sweep as s\nfrom vcjax.filter import slam\n\ndef f():\n    from vcjax import report\n"
    (tmp_path / "module.py").write_text(source + "import numpy\n")
    assert imported_rooms(tmp_path / "module.py") == {"study", "filter", "report"}


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_are_short_and_say_what_they_are(module):
    text = module.read_text()
    assert len(text.splitlines()) <= 300
    assert ast.get_docstring(ast.parse(text)), "a docstring"


def test_public_names_are_documented():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    exports = [alias for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert all(alias.asname == alias.name for alias in exports)  # `X as X`: exported on purpose
    names = {alias.name for alias in exports}
    assert {
        "FilterConfig",
        "Scenario",
        "simulate",
        "run",
        "step",
        "start",
        "monte_carlo",
        "scenarios",
        "summarise",
    } <= names
    for name in names:
        public = getattr(vcjax, name)
        assert inspect.getdoc(public) and public.__doc__, name  # its own, not one it inherits


def test_version_is_that_of_the_project():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    assert version("vcjax") == project["version"]


def test_type_information_is_shipped():
    assert (PACKAGE / "py.typed").exists()


def run_alone(script: str) -> str:
    """What a script prints in a process of its own."""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_starts_no_device_and_leaves_the_configuration_alone():
    num_devices = run_alone(
        """
import jax
before = dict(jax.config.values)
import vcjax
vcjax.scenarios.paper(dynamic="lateral", oscillation_amplitude_m=0.05)
vcjax.FilterConfig(gate=vcjax.ReprojectionError(th1=4.0))
after = dict(jax.config.values)
assert after == before, {name: after[name] for name in after if after[name] != before[name]}
assert not after["jax_enable_x64"]
# Refused once a device has started: neither the import nor a scenario or configuration did that.
jax.config.update("jax_num_cpu_devices", 2)
print(len(jax.local_devices(backend="cpu")))
"""
    )
    assert num_devices == "2"


def test_core_needs_no_optional_package():
    """Those of the study are not loaded with the package either: what is missing is told when it is used."""
    told = run_alone(
        """
import sys
optional = ["xarray", "netCDF4", "matplotlib", "rich", "scipy.stats", "tyro", "cv2", "pyarrow", "yaml", "PIL"]
sys.modules.update(dict.fromkeys(optional))  # an attempt to import any of them fails
import jax
import vcjax
try:
    vcjax.monte_carlo(vcjax.scenarios.paper(), num_seeds=1, key=jax.random.key(0))
except ModuleNotFoundError as error:
    print(error)
try:
    vcjax.summarise(None)
except ModuleNotFoundError as error:
    print(error)
assert not hasattr(vcjax, "sumarise")
"""
    )
    assert told == (
        "Labelled results need xarray: pip install 'vcjax[study]'.\n"
        "vcjax.summarise needs xarray: pip install 'vcjax[study]'."
    )


def test_command_tells_what_it_lacks():
    told = run_alone(
        """
import sys
sys.modules["tyro"] = None
import contextlib, vcjax.__main__
with contextlib.redirect_stderr(sys.stdout):
    assert vcjax.__main__.main() == 1
"""
    )
    assert told == "vcjax: the command line needs tyro: pip install 'vcjax[study]'."
