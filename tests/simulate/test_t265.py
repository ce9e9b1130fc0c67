# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import look_at
from stereovox.simulate.t265 import T265, Drift, Track, write_track
from stereovox.sources.poses.tracker import read_tracker

STEADY = Drift(share=0, yaw_deg=0)
PERFECT = T265(jitter_m=0, jitter_deg=0, drift=STEADY, clock_drift_ppm=0)


def line(metres: float, speed: float = 1.0, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and poses, 200 Hz, of a body in optical axes that moves along the world's x; z up."""
    stamps = np.arange(0, round(metres / speed * 1e9) + 1, 5_000_000)
    poses = np.tile(look_at([start, 3, 2], [start + 1, 3, 2]), (len(stamps), 1, 1))
    poses[:, 0, 3] += stamps * 1e-9 * speed
    return stamps, poses


def there_and_back(metres: float) -> tuple[np.ndarray, np.ndarray]:
    """The same, out and back twice, looking the same way all the time."""
    stamps, _ = line(4 * metres)
    poses = np.tile(look_at([0, 0, 0], [1, 0, 0]), (len(stamps), 1, 1))
    poses[:, 0, 3] = metres - abs(stamps * 1e-9 % (2 * metres) - metres)
    return stamps, poses


def test_a_perfect_tracker_speaks_opengl():
    stamps, poses = line(1)
    poses[-1, :3, 3] += [0, 0.25, 0.5]  # left and up
    track = PERFECT.track(stamps, poses)
    np.testing.assert_allclose(track.positions[0], 0, atol=1e-12)
    np.testing.assert_allclose(track.positions[-1], [-0.25, 0.5, -1], atol=1e-9)
    np.testing.assert_allclose(track.quaternions[[0, -1]], [[0, 0, 0, 1]] * 2, atol=1e-9)
    np.testing.assert_array_equal(track.stamps_ns, stamps)
    np.testing.assert_allclose(track.errors_m, 0, atol=1e-12)


def test_its_world_is_level_even_where_it_starts_askew():
    askew = look_at([1, 2, 3], [1, 5, 2])  # looks along y, and down
    level = look_at([1, 2, 3], [1, 5, 3])
    track = PERFECT.track(np.array([0, 5_000_000]), np.stack([askew, level]))
    np.testing.assert_allclose(track.quaternions[1], [0, 0, 0, 1], atol=1e-12)
    down = Rotation.from_quat(track.quaternions[0]).apply([0, 0, -1])
    np.testing.assert_allclose(down, [0, -1 / np.sqrt(10), -3 / np.sqrt(10)], atol=1e-12)


def test_jitter_has_the_stated_size_and_is_smooth():
    stamps, poses = line(200, speed=5)
    track = replace(PERFECT, jitter_m=0.001, jitter_deg=0.05).track(stamps, poses)
    calm = track.confidence == 3
    shake = (track.positions - track.truth[:, :3, 3])[calm]
    turn = (Rotation.from_matrix(track.truth[:, :3, :3]).inv() * Rotation.from_quat(track.quaternions)).as_rotvec()
    np.testing.assert_allclose(shake.std(0), 0.001, rtol=0.1)
    np.testing.assert_allclose(np.degrees(turn[calm].std(0)), 0.05, rtol=0.1)
    np.testing.assert_allclose(np.diff(shake, axis=0).std(0), 0.001 * np.sqrt(2 - 2 * np.exp(-1 / 6)), rtol=0.1)
    white = replace(PERFECT, jitter_m=0.001, jitter_s=0).track(stamps, poses)
    steps = np.diff((white.positions - white.truth[:, :3, 3])[calm], axis=0)
    np.testing.assert_allclose(steps.std(0), 0.001 * np.sqrt(2), rtol=0.1)


def test_drift_is_about_one_per_cent_of_a_short_way_and_less_of_a_long_one():
    def error(metres: float) -> float:
        ends = [
            replace(PERFECT, seed=seed, drift=Drift(yaw_deg=0)).track(*line(metres)).errors_m[-1] for seed in range(8)
        ]
        return float(np.sqrt(np.mean(np.square(ends)))) / metres

    assert 0.005 < error(2) < 0.015
    assert 0.001 < error(60) < 0.7 * error(2)


def test_a_wrong_heading_bends_the_way():
    """What the tracker feels of its motion, in its own body, stays right: only the sum of it goes wrong."""
    stamps, poses = line(30, speed=3)
    drift = Drift(share=0, yaw_deg=3, find_again_m=0)
    track = replace(PERFECT, drift=drift).track(stamps, poses)
    reported = Rotation.from_quat(track.quaternions)
    true = Rotation.from_matrix(track.truth[:, :3, :3])
    felt = reported[:-1].inv().apply(np.diff(track.positions, axis=0))
    np.testing.assert_allclose(felt, true[:-1].inv().apply(np.diff(track.truth[:, :3, 3], axis=0)), atol=3e-3)
    np.testing.assert_allclose(felt.mean(0), [0, 0, -0.015], atol=2e-4)
    turned = (reported * true.inv()).as_rotvec()
    assert abs(np.degrees(turned[-1, 1])) > 1
    np.testing.assert_allclose(turned[:, [0, 2]], 0, atol=1e-9)  # gravity keeps roll and pitch
    assert track.errors_m[-1] > 0.05


def test_places_seen_before_take_the_drift_back():
    stamps, poses = there_and_back(15)
    for seed in range(4):
        lost = replace(PERFECT, seed=seed, drift=Drift(find_again_m=0)).track(stamps, poses)
        found = replace(PERFECT, seed=seed, drift=Drift()).track(stamps, poses)
        assert found.errors_m[-1] < 0.01 < lost.errors_m[-1]
        first, again = (np.argmin(abs(stamps - seconds * 1_000_000_000)) for seconds in (8, 52))  # both at 8 m
        np.testing.assert_allclose(found.positions[again], found.positions[first], atol=0.02)


def test_the_same_seed_gives_the_same_track():
    stamps, poses = line(5)
    first, again, other = (T265(seed=seed).track(stamps, poses) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.positions, again.positions)
    np.testing.assert_array_equal(first.quaternions, again.quaternions)
    assert not np.array_equal(first.positions, other.positions)


def test_confidence_comes_with_time_or_motion():
    standing = PERFECT.track(*line(3, speed=1e-3 * 1000, start=0.0))
    assert standing.confidence[0] == 1
    assert standing.confidence[np.searchsorted(standing.truth[:, 2, 3] * -1, 0.31)] == 3
    still = PERFECT.track(np.arange(0, 4_000_000_001, 5_000_000), np.tile(look_at([0, 0, 0], [1, 0, 0]), (801, 1, 1)))
    assert [int(still.confidence[int(200 * seconds)]) for seconds in (0, 0.9, 1.1, 1.9, 2.1, 4)] == [1, 1, 2, 2, 3, 3]


def test_its_clock_has_an_offset_and_gains():
    stamps, poses = line(10)
    track = replace(PERFECT, clock_offset_s=2.5, clock_drift_ppm=100).track(stamps, poses)
    assert stamps[0] - track.stamps_ns[0] == 2_500_000_000
    assert (track.stamps_ns[-1] - track.stamps_ns[0]) - (stamps[-1] - stamps[0]) == 1_000_000


def test_faults_come_when_asked_for():
    stamps, poses = line(10)
    jump = replace(PERFECT, jump_s=4.013, jump_m=0.5).track(stamps, poses)
    steps = np.linalg.norm(np.diff(jump.positions, axis=0), axis=1)
    at = int(np.argmax(steps))
    assert stamps[at] < 4_013_000_000 <= stamps[at + 1]
    np.testing.assert_allclose(np.delete(steps, at), 0.005, atol=1e-9)
    np.testing.assert_allclose(jump.errors_m[[at, at + 1, -1]], [0, 0.5, 0.5], atol=1e-9)
    lost = replace(PERFECT, jitter_m=0.001, lost_s=(5, 6)).track(stamps, poses)
    np.testing.assert_array_equal(lost.confidence[1000:1200], 1)
    assert (lost.confidence[[999, 1200]] == 3).all()
    assert lost.errors_m[1000:1200].mean() > 5 * lost.errors_m[1200:].mean()
    assert not np.array_equal(replace(PERFECT, jump_s=99).track(stamps, poses).positions, jump.positions)


def test_bad_input_is_one_line():
    stamps, poses = line(1)
    for bad in (stamps[:1], stamps[::-1]):
        with pytest.raises(StereovoxError, match="stamps that ascend"):
            T265().track(bad, poses)
    with pytest.raises(StereovoxError, match="no heading"):
        T265().track(stamps, np.tile(look_at([0, 0, 0], [0, 0, 1], up=(1, 0, 0)), (len(stamps), 1, 1)))


def test_the_file_holds_the_track(tmp_path):
    track: Track = T265(clock_offset_s=0.3).track(*line(2))
    write_track(tmp_path / "tracker.txt", track)
    poses = read_tracker(tmp_path / "tracker.txt", axes="opengl", world="file")
    np.testing.assert_array_equal(poses.stamps_ns, track.stamps_ns)
    np.testing.assert_array_equal(poses.confidence, track.confidence)
    np.testing.assert_allclose(poses.T_world_body[:, :3, 3], track.positions, atol=1e-9)
