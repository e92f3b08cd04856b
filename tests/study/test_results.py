"""Results on disk: the same when read back, complete or not there, refused when damaged."""

import dataclasses
import gc
import json
import os
import random
import shutil
from functools import cache
from importlib.metadata import PackageNotFoundError

import jax
import numpy as np
import pytest
import tiny_runs
import xarray as xr

import vcjax as vc
from vcjax.study import results
from vcjax.study.results import SCHEMA, attributes, describe, load, load_attributes, refuse_other_settings, save
from vcjax.study.sweep import Experiment


@cache
def runs() -> xr.Dataset:
    return tiny_runs.run_strict()


def test_read_back_as_written(tmp_path):
    kinds = {np.dtype(variable.dtype).kind for variable in runs().variables.values()}
    assert kinds == {"b", "i", "f", "U"}  # flags, counts, figures and labels
    path = save(runs(), tmp_path / "folder" / "runs.nc")
    back = load(path)
    xr.testing.assert_identical(back, runs())
    for name, variable in runs().variables.items():
        assert back[name].dtype.kind == variable.dtype.kind, name
        assert back[name].dtype == variable.dtype or variable.dtype.kind == "U", name
    assert back.attrs == runs().attrs and load_attributes(path) == runs().attrs
    assert [p.name for p in path.parent.iterdir()] == ["runs.nc"]


@pytest.mark.skipif(os.name != "posix", reason="limits the size of files as POSIX does")
def test_full_disk_is_told_in_one_line_and_keeps_what_was_there(tmp_path):
    import resource

    path = save(runs(), tmp_path / "runs.nc")
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))  # no file can grow larger
    try:
        with pytest.raises(OSError, match=r"runs.nc: not written \(.*MiB are free there\); .* room") as refusal:
            save(runs(), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(refusal.value)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["runs.nc"]


def test_read_whole_so_that_the_file_may_go(tmp_path):
    path = save(runs(), tmp_path / "runs.nc")
    back = load(path)
    path.unlink()
    xr.testing.assert_identical(back, runs())


def test_swept_failed_and_infinite_numbers_survive(tmp_path):
    swept = xr.concat([runs(), runs()], xr.Variable("config.gate.th1", [1.0, np.inf]))
    swept.is_finite[0, 1] = False
    swept.position_error_m[0, 1] = np.nan
    swept.nees_pose[0, 1] = np.inf
    back = load(save(swept, tmp_path / "swept.nc"))
    xr.testing.assert_identical(back, swept)
    assert back.is_finite.dtype == bool and not back.is_finite[0, 1]


def test_many_features_have_room_in_the_description(tmp_path):
    """The description of a scenario may be longer than the 64 KiB of a compact HDF5 attribute."""
    landmarks_m = np.random.default_rng(0).normal(size=(3000, 3))
    scenario = dataclasses.replace(tiny_runs.scenario(), landmarks_m=landmarks_m)
    found = attributes(Experiment(scenario, tiny_runs.config()), jax.random.key(0))
    assert len(found["scenario"]) > 2**17
    assert load(save(runs().assign_attrs(found), tmp_path / "runs.nc")).attrs == found


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = save(runs(), tmp_path / "runs.nc")
    before = path.read_bytes()

    def write_half(dataset, target, **_):
        target.write_bytes(before[: len(before) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", write_half)
    with pytest.raises(OSError, match="disk full"):
        save(runs(), path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_missing_file_is_told(tmp_path):
    for path in (tmp_path / "none.nc", tmp_path):
        for read in (load, load_attributes):
            with pytest.raises(FileNotFoundError, match="no such results file"):
                read(path)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return save(runs(), tmp_path_factory.mktemp("results") / "runs.nc")


def assert_refused(path, read=load):
    with pytest.raises(ValueError, match="not a readable NetCDF-4 file") as refusal:
        read(path)
    assert str(path) in str(refusal.value) and "remove it" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
def test_truncated_file_is_refused_in_one_line(written, tmp_path, share):
    content = written.read_bytes()
    path = tmp_path / "short.nc"
    path.write_bytes(content[: int(share * len(content))])
    assert_refused(path)
    assert_refused(path, load_attributes)
    gc.collect()  # what is left of the attempt must not complain when it goes


def test_garbage_and_other_formats_are_refused(written, tmp_path):
    path = tmp_path / "garbage.nc"
    for content in (b"no results at all\n", bytes(1000), b"\x89HDF\r\n\x1a\n" + bytes(500)):
        path.write_bytes(content)
        assert_refused(path)
    gc.collect()


def test_damaged_bytes_are_refused_or_without_effect_on_the_reader(written, tmp_path):
    """Nothing but a ValueError leaves the reader, wherever the damage is."""
    content, draw = written.read_bytes(), random.Random(0)
    path, refused = tmp_path / "damaged.nc", 0
    for _ in range(60):
        damaged = bytearray(content)
        for _ in range(draw.choice([1, 20, 300])):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(bytes(damaged))
        try:
            load(path)
        except ValueError as error:
            assert str(path) in str(error)
            refused += 1
    assert refused > 20


@pytest.mark.parametrize("schema", [SCHEMA + 1, "1", None])
def test_other_schema_is_refused(tmp_path, schema):
    other = runs().copy()
    del other.attrs["schema"]
    path = save(other if schema is None else other.assign_attrs(schema=schema), tmp_path / "runs.nc")
    with pytest.raises(ValueError, match=rf"schema {schema}, but this version reads {SCHEMA}"):
        load(path)


def test_file_that_lacks_a_variable_is_refused(tmp_path):
    path = save(runs().drop_vars(["is_finite", "robot"]), tmp_path / "runs.nc")
    with pytest.raises(ValueError, match=r"runs.nc: lacks is_finite, robot; remove it"):
        load(path)


def test_other_netcdf_file_is_refused(tmp_path):
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="netcdf4")
    shutil.copy(tmp_path / "other.nc", tmp_path / "copy.nc")
    with pytest.raises(ValueError, match=r"copy.nc: schema None"):
        load(tmp_path / "copy.nc")


def test_description_holds_every_setting():
    found = describe(vc.FilterConfig(gate=vc.ReprojectionError(th1=4.0), max_updates=7))
    assert found["class"] == "FilterConfig" and found["max_updates"] == 7
    assert found["gate"] == {"class": "ReprojectionError", "th1": 4.0, "prior": "corrected"}
    assert set(found) == {"class", *(field.name for field in dataclasses.fields(vc.FilterConfig))}
    scenario = describe(tiny_runs.scenario())
    assert scenario["odometry_std"] == [0.005, 0.005, 0, 0, 0, 0.05]
    assert scenario["movers"]["ids"] == tiny_runs.MOVERS and len(scenario["landmarks_m"]) == 162
    assert json.loads(json.dumps([found, scenario])) == [found, scenario]


def test_attributes_tell_settings_apart():
    def of(scenario=None, config=None, seed=0):
        return attributes(
            Experiment(scenario or tiny_runs.scenario(), config or tiny_runs.config()), jax.random.key(seed)
        )

    assert of() == of()
    others = [
        of(tiny_runs.scenario(oscillation_amplitude_m=0.01)),
        of(config=tiny_runs.config(vc.VirtualCorrection(th2=9.0000001))),
        of(config=tiny_runs.config(vc.ReprojectionError())),
        of(config=tiny_runs.config(max_updates=5)),
        of(seed=1),
    ]
    assert all(other != of() for other in others)
    assert of()["dtype"] == "float64"


def test_refusal_of_other_settings_names_the_first_that_differs():
    """By its path, however long the description; a place in a list where the beginnings look the same."""
    scenario = tiny_runs.scenario()
    other_places = np.array(scenario.landmarks_m)
    other_places[40, 1] += 0.5
    place = other_places[40, 1]
    for changed, words in (
        ({"scenario": dataclasses.replace(scenario, num_frames=14)}, r"\(scenario.num_frames: 12, now 14\)"),
        ({"scenario": dataclasses.replace(scenario, landmarks_m=other_places)}, rf"landmarks_m.40: .*, now .*{place}"),
        ({"config": tiny_runs.config(tiny_runs.STRICT)}, r"\(config.gate.th1: 9.0, now 1.0\)"),
        ({"config": tiny_runs.config(vc.ReprojectionError())}, r"\(config.gate.class: .*Virt.*, now .*Reproj.*\)"),
    ):
        was = Experiment(scenario, tiny_runs.config())
        found, expected = (attributes(each, jax.random.key(0)) for each in (was, dataclasses.replace(was, **changed)))
        refuse_other_settings("runs.nc", found, found)
        with pytest.raises(ValueError, match=words) as refused:
            refuse_other_settings("runs.nc", found, expected)
        assert len(str(refused.value)) < 220
    with pytest.raises(ValueError, match=r"key: \[0, 0\], now \[0, 1\]"):
        refuse_other_settings("runs.nc", attributes(was, jax.random.key(0)), attributes(was, jax.random.key(1)))


def test_source_tree_that_is_not_installed_has_an_unknown_version(monkeypatch):
    def version(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(results, "version", version)
    found = attributes(Experiment(tiny_runs.scenario(), tiny_runs.config()), jax.random.key(0))
    assert found["vcjax"] == "unknown"


def test_missing_xarray_is_told(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    for call in (results.import_xarray, lambda: load(tmp_path / "runs.nc")):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'vcjax\[study\]'"):
            call()
