"""Features that are followed outside the map: what a run says of them in its table, and how they scale."""

import numpy as np
import pytest
import recorded

from vcjax.filter.follower import Following
from vcjax.recorded.filtered import filter_recording
from vcjax.recorded.followed import followed
from vcjax.recorded.run_folder import new_run
from vcjax.recorded.run_summary import run_summary
from vcjax.recorded.scale import scaled
from vcjax.recorded.verdicts import track_verdicts, verdicts
from vcjax.sources.table_file import read_table

NUMBERS = (
    "x",
    "y",
    "z",
    "vx",
    "vy",
    "vz",
    "cov_vx_vx",
    "cov_vx_vy",
    "cov_vx_vz",
    "cov_vy_vy",
    "cov_vy_vz",
    "cov_vz_vz",
)
CONFIG = recorded.config(following=Following(max_followed=8), blacklist_capacity=16)


@pytest.fixture(scope="module")
def filtered():
    return filter_recording(CONFIG, recorded.content().recording)


def test_the_table_has_a_row_for_each_follower_in_each_frame(filtered, tmp_path):
    recording, passed = recorded.content().recording, verdicts(filtered.info)
    tracks = track_verdicts(passed, filtered.info)
    summary = run_summary(CONFIG, recording, filtered, tracks)
    with new_run(tmp_path / "run", recording, filtered, passed, tracks, summary):
        pass
    found = read_table(
        tmp_path / "run" / "followers.csv", {"frame": "whole", "track_id": "whole"} | dict.fromkeys(NUMBERS, "real")
    )
    rows = []
    followers = filtered.info.followers
    for t, tracks_then in enumerate(followers.track_id.tolist()):
        for slot, track in enumerate(tracks_then):
            if track >= 0:
                cov = followers.cov[t, slot, 3:, 3:]
                upper = [cov[i, j] for i in range(3) for j in range(i, 3)]
                rows.append([t, track, *followers.place_m[t, slot], *followers.velocity_m_s[t, slot], *upper])
    assert len(rows) > 10
    np.testing.assert_array_equal(np.column_stack([found[n] for n in ("frame", "track_id", *NUMBERS)]), rows)
    # Only features that were called dynamic are followed.
    called = passed.track_id[(passed.verdict == 2) | (passed.verdict == 4)]
    assert set(found["track_id"].tolist()) <= set(called.tolist())


def test_they_scale_with_the_map(filtered):
    """Place, seen from the camera's first place, velocity, and standard deviations are multiplied."""
    before, after = followed(filtered.info), followed(scaled(filtered, 2.5).info)
    np.testing.assert_allclose(after.velocity_m_s, 2.5 * before.velocity_m_s)
    np.testing.assert_allclose(after.velocity_cov, 6.25 * before.velocity_cov)
    np.testing.assert_allclose(np.diff(after.place_m, axis=0), 2.5 * np.diff(before.place_m, axis=0), atol=1e-9)


def test_without_followers_there_is_no_table():
    assert followed(recorded.run().info) is None
