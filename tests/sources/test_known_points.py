"""Tables of known points: which feature each is, and what is refused by its line."""

import numpy as np
import pytest
import recorded

from vcjax.sources.known_points import read_known_points
from vcjax.sources.tracks import tracks_of


def first_frame():
    tracks = tracks_of(recorded.content().recording, recorded.content().calibration)
    is_first = tracks.frame == 0
    return tracks.track_id[is_first], tracks.uv_px[is_first]


def test_points_by_track_and_by_pixel(tmp_path):
    ids, uv_px = first_frame()
    path = tmp_path / "a.csv"
    path.write_text(f"x,y,z,track_id\n1,2,3,{ids[4]}\n4,5,6.5,{ids[2]}\n")
    found = read_known_points(path, recorded.content())
    assert found.track_id.tolist() == [ids[4], ids[2]] and found.place_m.tolist() == [[1, 2, 3], [4, 5, 6.5]]
    (u, v), (s, t) = uv_px[4] + 1.0, uv_px[2] - 1.0
    path.write_text(f"u,v,x,y,z\n{u},{v},1,2,3\n{s},{t},4,5,6.5\n")
    for one, other in zip(read_known_points(path, recorded.content()), found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\n", "give the column track_id, or u and v; it has none of them"),
        ("x,y,z,u\n1,2,3,4\n", "or u and v; it has u"),
        ("x,y,z,track_id\n", "no row; give the known points"),
        ("x,y,z,track_id\n1,2,3,99999\n", "line 2, column track_id: 99999 is no track of the recording"),
        ("x,y,z,track_id\n1,2,nan,0\n", "line 2, column z: nan is not finite"),
        ("x,y,z,track_id\n1,2,3,{a}\n1,2,3,{a}\n", "line 3, column track_id: .* is the same feature as a point above"),
        ("x,y,z,u,v\n1,2,3,-50,-50\n", "line 2, column u: -50.0 has no feature of the first frame at most 5 px"),
    ],
)
def test_what_is_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text.replace("{a}", str(first_frame()[0][0])))
    with pytest.raises(ValueError, match=message):
        read_known_points(tmp_path / "a.csv", recorded.content())
