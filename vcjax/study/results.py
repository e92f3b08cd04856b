"""Labelled results, in memory and on disk.

Results are an `xarray.Dataset`, on disk one NetCDF-4 file: labelled, self-describing, readable from any language, and a
single file, which can be written under a temporary name and renamed, so that a file that exists is complete.
"""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Collection, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from vcjax import extras
from vcjax.simulation.scenarios import Scenario
from vcjax.simulation.simulate import simulate
from vcjax.storage import replacing
from vcjax.study.sweep import Experiment

SCHEMA = 4
"""Version of the layout of results, raised when an older reader would misread them."""

PER_FRAME = {
    "position_error_m": "√(ex² + ey²) of the robot, m",
    "orientation_error_deg": "angle between true and estimated orientation, deg",
    "yaw_error_deg": "absolute yaw error, deg",
    "nees_position": "normalised estimation error squared of (x, y), 2 degrees of freedom",
    "nees_pose": "normalised estimation error squared of (x, y, yaw), 3 degrees of freedom",
    "nis_sum": "sum of the accepted updates' RE1, 2 degrees of freedom each",
    "num_updates": "accepted updates",
    "num_recovered": "recovered by the gate",
    "num_dynamic": "called dynamic by the gate and deleted",
    "num_inconsistent": "deleted by the detector",
    "num_births": "features initialised",
    "num_landmarks": "landmarks in the map",
    "num_coordinates": "length of the state",
}
PER_FEATURE = {
    "dynamic_deletions": "how often the gate called a feature dynamic",
    "inconsistent_deletions": "how often the detector deleted a feature",
    "frames_mapped": "frames a feature spent in the map",
    "first_mapped": "first frame a feature was in the map; 0: never",
    "first_deleted": "first frame it was deleted by gate or detector; 0: never",
    "dynamic_margin": "how dynamic it ever looked to the gate, χ² units; NaN: never a measured candidate",
    "detector_margin": "how dynamic it ever looked to the detector, χ² units; NaN: it never had anything to say",
    "velocity_error_m_s": "error of the detector's velocity when it first deleted a feature, m/s; NaN: it never did",
    "velocity_nees": "the same, normalised and squared, 3 degrees of freedom",
}
PER_RUN = {
    "nees_map": "normalised error squared of the places of static Euclidean landmarks in the last frame, 3 degrees of "
    "freedom, mean over them; NaN: none",
    "is_finite": "whether all numbers of the run stayed finite",
    "detection_auc": "share of pairs of a mover and another feature that dynamic_margin puts in the right order",
    "detector_auc": "share of pairs of a mover and another feature that detector_margin puts in the right order",
    "map_full_frames": "frames in which a feature had to wait for a free slot",
}


def as_dataset(
    lanes: dict[str, np.ndarray],
    experiment: Experiment,
    swept: dict[str, np.ndarray],
    seeds: np.ndarray,
    key: PRNGKeyArray,
) -> Any:
    """Label a batch's metrics: dimensions (*sweep paths, seed, frame | feature), coordinates, descriptions, settings.

    Variables are those of `PER_FRAME`, `PER_FEATURE` and `PER_RUN`, the estimated `robot` pose, `is_moving` for each
    feature, and, unless the scenario is swept, the truth: `robot_true`, `sensor_true`, `landmark_true`.

    Raises:
        ModuleNotFoundError: if xarray is not installed, with the remedy.
    """
    xr = import_xarray()
    outer = (*swept, "seed")
    data: dict[str, Any] = {
        name: ((*outer, "frame"), lanes[name], {"long_name": text}) for name, text in PER_FRAME.items()
    }
    data |= {name: ((*outer, "feature"), lanes[name], {"long_name": text}) for name, text in PER_FEATURE.items()}
    data |= {name: (outer, lanes[name], {"long_name": text}) for name, text in PER_RUN.items()}
    data["robot"] = ((*outer, "frame", "pose"), lanes["robot"], {"long_name": "estimated robot pose"})
    # What moves does not depend on the seed.
    data["is_moving"] = ((*swept, "feature"), lanes["is_moving"][..., 0, :], {"long_name": "whether a feature moves"})
    if not any(path.startswith("scenario.") for path in swept):
        truth = _truth(experiment.scenario)
        data["robot_true"] = (("frame", "pose"), np.asarray(truth.robot), {"long_name": "true robot pose"})
        data["sensor_true"] = (("frame", "pose"), np.asarray(truth.sensor), {"long_name": "true sensor pose"})
        data["landmark_true"] = (
            ("frame", "feature", "axis"),
            np.asarray(truth.landmarks_m),
            {"long_name": "features, m"},
        )
    coordinates = {
        **{path: ((path,), values) for path, values in swept.items()},
        "seed": seeds,
        "frame": np.arange(1, experiment.scenario.num_frames + 1),
        "feature": np.arange(lanes["is_moving"].shape[-1]),
        "pose": ["x", "y", "z", "qw", "qx", "qy", "qz"],
        "axis": ["x", "y", "z"],
    }
    return xr.Dataset(data, coordinates, attrs=attributes(experiment, key))


@jax.jit
def _truth(scenario: Scenario):
    return simulate(scenario, jax.random.key(0))[1]


def attributes(experiment: Experiment, key: PRNGKeyArray) -> dict[str, Any]:
    """What results come from, as it is kept beside them: equal attributes, equal numbers."""
    return provenance(key) | {
        "scenario": json.dumps(describe(experiment.scenario)),
        "config": json.dumps(describe(experiment.config)),
    }


def provenance(key: PRNGKeyArray) -> dict[str, Any]:
    """What all results come from: layout, random key, precision and version."""
    return {
        "schema": SCHEMA,
        "key": json.dumps(np.asarray(jax.random.key_data(key)).tolist()),
        "dtype": str(jax.dtypes.canonicalize_dtype(np.float64)),
        "vcjax": _version(),
    }


def refuse_other_settings(path: str | os.PathLike, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse to mix work of different settings.

    Args:
        path: where the work was found.
        found: what it comes from.
        expected: what it is to come from; what else is found does not matter.

    Raises:
        ValueError: naming the first setting that differs.
    """
    for name, value in expected.items():
        if found.get(name) != value:
            place, one, other = _first_difference(name, found.get(name), value)
            raise ValueError(
                f"{path} has other settings ({place}: {_short(one)}, now {_short(other)}); "
                "give another directory, or remove this one."
            )


def _first_difference(name: str, found: Any, expected: Any) -> tuple[str, Any, Any]:
    """The first part in which two descriptions differ: its path, and what each has there."""
    one, other = _parsed(found), _parsed(expected)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        parts = [(key, one.get(key), other.get(key)) for key in {**other, **one}]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other) and _short(one) == _short(other):
        parts = list(zip(range(len(one)), one, other, strict=True))
    else:
        parts = []
    differing = ((f"{name}.{key}", *pair) for key, *pair in parts if pair[0] != pair[1])
    place = next(differing, None)
    return (name, one, other) if place is None else _first_difference(*place)


def _parsed(value: Any) -> Any:
    """A description kept as text, as it was."""
    try:
        return json.loads(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _short(value: Any) -> str:
    text = json.dumps(value, default=lambda number: number.item())  # what comes from a file has types of its own
    return text if len(text) < 60 else text[:57] + "..."


def _version() -> str:
    """The version of this package; "unknown" where it runs from a source tree and is not installed."""
    try:
        return version("vcjax")
    except PackageNotFoundError:
        return "unknown"


def describe(tree: Any) -> Any:
    """A configuration object as plain dictionaries, lists and numbers, with the class of each under `class`."""
    if dataclasses.is_dataclass(tree):
        fields = {field.name: describe(getattr(tree, field.name)) for field in dataclasses.fields(tree)}
        return {"class": type(tree).__name__, **fields}
    if eqx.is_array(tree):
        return np.asarray(tree).tolist()
    return tree


def save(dataset: Any, path: str | os.PathLike) -> Path:
    """Write results to one NetCDF file, complete or not at all: to a temporary name, flushed, then renamed.

    Raises:
        OSError: if the place cannot be written; what was there before stays.
    """
    compressed = {name: {"zlib": True, "complevel": 4} for name, variable in dataset.items() if variable.ndim}
    with replacing(path) as temporary:
        try:
            dataset.to_netcdf(temporary, engine="netcdf4", encoding=compressed)
        except (OSError, RuntimeError) as error:  # the library names a full disk in many ways, none of them so
            free_mib, cause = shutil.disk_usage(temporary.parent).free / 2**20, getattr(error, "strerror", None)
            raise OSError(
                f"{path}: not written ({cause or error}; {free_mib:.1f} MiB are free there); what was written before "
                "stays, so run again when there is room."
            ) from None
    return Path(path)


RUN_VARIABLES = (*PER_FRAME, *PER_FEATURE, *PER_RUN, "robot", "is_moving")
"""What a file of runs holds at least."""


def load(path: str | os.PathLike, variables: Collection[str] = RUN_VARIABLES) -> Any:
    """Read results back, whole.

    Args:
        path: the file.
        variables: what it must hold.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no results file of this schema.
    """
    return _read(path, lambda dataset: dataset.load(), variables)


def load_attributes(path: str | os.PathLike, variables: Collection[str] = RUN_VARIABLES) -> dict[str, Any]:
    """Read what results come from (see `attributes`), and not the results themselves; otherwise as `load`."""
    return _read(path, lambda dataset: dataset.attrs, variables)


def _read(path: str | os.PathLike, part: Callable[[Any], Any], variables: Collection[str]) -> Any:
    xarray = import_xarray()
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such results file.")
    try:
        with xarray.open_dataset(path, engine="netcdf4") as dataset:
            found, names, result = dataset.attrs.get("schema"), set(dataset.variables), part(dataset)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: not a readable NetCDF-4 file ({error}); remove it and run again.") from error
    if found != SCHEMA:
        raise ValueError(f"{path}: schema {found}, but this version reads {SCHEMA}.")
    if missing := sorted(set(variables) - names):
        raise ValueError(f"{path}: lacks {', '.join(missing)}; remove it and run again.")
    return result


def import_xarray() -> Any:
    """The labelled-array library, an optional dependency.

    Raises:
        ModuleNotFoundError: if it is not installed, with the remedy.
    """
    return extras.load("xarray", "Labelled results", "study")
