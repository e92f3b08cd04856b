"""Maps: tables there and back, point clouds as their format says."""

import numpy as np
import pytest

from vcjax.sources.map_file import CLASS_COLOURS, CLASSES, LandmarkMap, read_map, write_map


def drawn(num=6) -> LandmarkMap:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(num, 3, 3))
    kind = tuple(CLASSES[i % 4] for i in range(num))
    return LandmarkMap(rng.permutation(99)[:num], rng.normal(size=(num, 3)), A @ A.mT, kind)


@pytest.mark.parametrize("name", ["m.csv", "m.parquet"])
def test_tables_come_back(tmp_path, name):
    landmarks = drawn()
    found = read_map(write_map(tmp_path / name, landmarks))
    np.testing.assert_array_equal(found.track_id, landmarks.track_id)
    np.testing.assert_array_equal(found.place_m, landmarks.place_m)
    np.testing.assert_array_equal(found.cov, np.triu(landmarks.cov) + np.triu(landmarks.cov, 1).mT)
    assert found.kind == landmarks.kind


@pytest.mark.parametrize("num", [6, 0])
def test_point_cloud_is_as_its_header_says(tmp_path, num):
    landmarks = drawn(num)
    lines = write_map(tmp_path / "m.ply", landmarks).read_text("ascii").splitlines()
    end = lines.index("end_header")
    head, rows = lines[:end], [line.split() for line in lines[end + 1 :]]
    assert head[:2] == ["ply", "format ascii 1.0"] and f"element vertex {num}" in head and len(rows) == num
    names = [line.split()[2] for line in head if line.startswith("property")]
    kinds = [line.split()[1] for line in head if line.startswith("property")]
    assert names[:6] == ["x", "y", "z", "red", "green", "blue"] and kinds[:6] == ["double"] * 3 + ["uchar"] * 3
    for i, row in enumerate(rows):
        vertex = dict(zip(names, row, strict=True))
        assert [float(vertex[axis]) for axis in "xyz"] == landmarks.place_m[i].tolist()
        assert tuple(int(vertex[c]) for c in ("red", "green", "blue")) == CLASS_COLOURS[landmarks.kind[i]]
        assert int(vertex["track_id"]) == landmarks.track_id[i]
        assert float(vertex["cov_yz"]) == landmarks.cov[i, 1, 2] and CLASSES[int(vertex["class"])] == landmarks.kind[i]


def test_what_is_no_map_is_refused_and_the_old_file_stays(tmp_path):
    path = write_map(tmp_path / "m.ply", drawn())
    before, good = path.read_bytes(), drawn()
    bad = [
        (good._replace(kind=("accepted",) * 5 + ("gone",)), r"write_map\(kind\[5\]='gone'\): choose one of"),
        (good._replace(kind=("accepted",)), "6 ids, places .*, 1 classes; give one of each"),
        (good._replace(place_m=good.place_m[:, :2]), r"places \(6, 2\)"),
        (good._replace(place_m=np.full((6, 3), np.nan)), r"write_map\(place_m\[0, 0\] = nan\): must be finite"),
    ]
    for landmarks, message in bad:
        with pytest.raises(ValueError, match=message):
            write_map(path, landmarks)
    assert path.read_bytes() == before
    with pytest.raises(ValueError, match=r"unknown ending '\.obj'"):
        write_map(tmp_path / "m.obj", good)
    text = write_map(tmp_path / "m.csv", good).read_text().splitlines()
    cells = text[3].split(",")
    cells[1] = "4"
    (tmp_path / "m.csv").write_text("\n".join([*text[:3], ",".join(cells)]))
    with pytest.raises(ValueError, match=r"m\.csv, line 4, column class: 4 is no class; they are numbered from 0 to 3"):
        read_map(tmp_path / "m.csv")
