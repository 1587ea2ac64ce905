"""The metrics of LiDAR4D, compared with a second implementation that loops over points."""

from __future__ import annotations

import json
import math
import statistics
import sys
import types
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from tests.made_recordings import changed_recording, made_recording

from lidarpool.cli.commands import cli
from lidarreal import compare
from lidarreal.comparing import lidar4d
from lidarreal.comparing.lidar4d import (
    WINDOWS,
    FrameCollector,
    FrameMetrics,
    PanoramaImage,
    average_metrics,
    full_scale_of,
    structural_similarity,
)
from lidarreal.reconstruction.alignment import AlignedSweep
from lidarreal.reconstruction.held_out import HeldOutRays
from lidarreal.reconstruction.published_metrics import HeldOutFrames
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarsim import LidarError
from lidarsim.columns.sweep import Sweep

HEIGHT, WIDTH = 66, 1030


def scan(seed, count=9000):
    """Return the points and intensities of a sweep whose ranges are a smooth function of azimuth.

    Some points are outside of the image, above, below, or beyond 80 m.
    """
    random = np.random.default_rng(seed)
    azimuth = random.uniform(-np.pi, np.pi, count)
    azimuth[:5] = [np.pi, -np.pi, 0.0, -np.pi + 1e-4, np.pi - 1e-4]
    elevation = np.radians(random.uniform(-27, 4, count))
    range_m = 20 + 15 * np.sin(3 * azimuth) + random.normal(0, 0.02, count)
    range_m[::50] = 79.5 + random.uniform(0, 1, len(range_m[::50]))
    level = range_m * np.cos(elevation)
    points = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
    )
    return points, random.uniform(0, 1, count)


def project_by_loop(points, intensities):
    """Project points one by one to {(row, column): (range, intensity)}."""
    cells = {}
    for (x, y, z), intensity in zip(points.tolist(), intensities.tolist(), strict=True):
        range_m = math.sqrt(x * x + y * y + z * z)
        down_deg = 2.0 - math.degrees(math.atan2(z, math.hypot(x, y)))
        row = round(down_deg * HEIGHT / 26.9)
        column = round((math.pi - math.atan2(y, x)) * WIDTH / math.tau)
        if range_m >= 80 or not 0 <= row < HEIGHT or not 0 <= column < WIDTH:
            continue
        if (row, column) not in cells or range_m < cells[row, column][0]:
            cells[row, column] = range_m, intensity
    return cells


def unproject_by_loop(cells):
    points = []
    for (row, column), (range_m, _) in cells.items():
        azimuth = math.pi - math.tau * column / WIDTH
        elevation = math.radians(2.0 - 26.9 * row / HEIGHT)
        level = range_m * math.cos(elevation)
        points.append(
            (level * math.cos(azimuth), level * math.sin(azimuth), range_m * math.sin(elevation))
        )
    return np.array(points)


def squares_by_loop(points, reference):
    return [min(((reference - point) ** 2).sum(axis=1)) for point in points]


def similarity_by_filters(a, b):
    """Return the mean SSIM over the windows that are inside of the image."""
    filters = pytest.importorskip("scipy.ndimage")
    span = b.max() - b.min()
    low, high = (0.01 * span) ** 2, (0.03 * span) ** 2
    mean_a, mean_b, *products = (
        filters.uniform_filter(image, size=7) for image in (a, b, a * a, b * b, a * b)
    )
    var_a, var_b, covariance = (
        49 / 48 * (mean - both)
        for mean, both in zip(products, (mean_a**2, mean_b**2, mean_a * mean_b), strict=True)
    )
    image = (2 * mean_a * mean_b + low) * (2 * covariance + high)
    image /= (mean_a**2 + mean_b**2 + low) * (var_a + var_b + high)
    return image[3:-3, 3:-3].mean()


def similarity_by_loop(a, b):
    """Return the mean SSIM of all 7 x 7 windows, with sample variances."""
    span = b.max() - b.min()
    low, high = (0.01 * span) ** 2, (0.03 * span) ** 2
    values = []
    for row in range(a.shape[0] - 6):
        for column in range(a.shape[1] - 6):
            x = a[row : row + 7, column : column + 7].ravel()
            y = b[row : row + 7, column : column + 7].ravel()
            (var_x, covariance), (_, var_y) = np.cov(x, y)
            luminance = (2 * x.mean() * y.mean() + low) / (x.mean() ** 2 + y.mean() ** 2 + low)
            values.append(luminance * (2 * covariance + high) / (var_x + var_y + high))
    return statistics.fmean(values)


def image_by_loop(cells, index, highest):
    image = np.full((HEIGHT, WIDTH), 1e-6)
    for cell, values in cells.items():
        image[cell] = min(max(values[index], 1e-6), highest)
    return image


def errors_by_loop(a, b, highest):
    differences = [abs(x - y) for x, y in zip(a.ravel().tolist(), b.ravel().tolist(), strict=True)]
    mean_square = statistics.fmean(value**2 for value in differences)
    return (
        math.sqrt(mean_square),
        statistics.median(differences),
        similarity_by_filters(a, b),
        10 * math.log10(highest**2 / mean_square),
        math.nan,
    )


def metrics_by_loop(a, b):
    """Return all metrics of the cells `a` against the recorded cells `b`."""
    points_a, points_b = unproject_by_loop(a), unproject_by_loop(b)
    to_b, to_a = squares_by_loop(points_a, points_b), squares_by_loop(points_b, points_a)
    precision = sum(square < 0.05 for square in to_b) / len(to_b)
    recall = sum(square < 0.05 for square in to_a) / len(to_a)
    yield statistics.fmean(to_b) + statistics.fmean(to_a)
    yield 2 * precision * recall / (precision + recall)
    for index, highest in ((0, 80.0), (1, 1.0)):
        images = [image_by_loop(cells, index, highest) for cells in (a, b)]
        yield from errors_by_loop(*images, highest)
    size = HEIGHT * WIDTH
    both = len(a.keys() & b.keys())
    wrong = len(a) + len(b) - 2 * both
    yield math.sqrt(wrong / size)
    yield 1 - wrong / size
    yield 2 * both / (len(a) + len(b))


@pytest.fixture(scope="module")
def pair():
    """Return a recorded sweep, and one without some of its points and with other noise."""
    points, intensity = scan(1)
    moved = points * (1 + np.random.default_rng(2).normal(0, 0.003, (len(points), 1)))
    kept = np.random.default_rng(3).random(len(points)) < 0.9
    return (moved[kept], 0.8 * intensity[kept]), (points, intensity)


def test_points_are_projected_to_the_cells_of_the_second_implementation(pair):
    for points, intensity in pair:
        image = PanoramaImage.from_points(points, intensity)
        cells = project_by_loop(points, intensity)
        assert {*zip(*map(np.ndarray.tolist, image.depth_m.nonzero()), strict=True)} == {*cells}
        for cell, (range_m, value) in cells.items():
            assert image.depth_m[cell] == pytest.approx(range_m, rel=1e-12)
            assert image.intensity[cell] == value
        expected = unproject_by_loop(dict(sorted(cells.items())))
        np.testing.assert_allclose(image.points(), expected, atol=1e-11)


def test_directions_are_those_of_the_protocol():
    forward = PanoramaImage.from_points(np.array([[10.0, 0, 0]]))
    assert [*zip(*forward.depth_m.nonzero(), strict=True)] == [(5, 515)]  # 2° are 4.9 rows
    backward = PanoramaImage.from_points(np.array([[-10.0, 1e-9, 0], [-9.0, -1e-9, 0]]))
    assert [*zip(*backward.depth_m.nonzero(), strict=True)] == [(5, 0)]
    assert backward.depth_m[5, 0] == 10  # the nearer point belongs to column 1030 and is omitted
    left = PanoramaImage.from_points(np.array([[0, 10.0, 0]]))
    assert [*zip(*left.depth_m.nonzero(), strict=True)] == [(5, 258)]  # 257.5, to the even number
    high = np.radians(2.2)
    above = np.array([[10 * np.cos(high), 0, 10 * np.sin(high)], [80.0, 0, 0]])
    assert PanoramaImage.from_points(above).depth_m[0, 515] == pytest.approx(10)
    assert PanoramaImage.from_points(above).return_mask.sum() == 1


@pytest.mark.extended
def test_metrics_are_those_of_the_second_implementation(pair):
    metrics = FrameMetrics.between(*(PanoramaImage.from_points(*one) for one in pair))
    expected = [*metrics_by_loop(*(project_by_loop(*one) for one in pair))]
    np.testing.assert_allclose(metrics, expected, rtol=1e-9)
    # A change of both implementations is noticed, too.
    assert metrics.chamfer_m2 == pytest.approx(0.628556, rel=1e-5)
    assert metrics.f_score == pytest.approx(0.957810, rel=1e-5)
    assert metrics.depth_rmse_m == pytest.approx(3.003075, rel=1e-5)
    assert metrics.depth_psnr_db == pytest.approx(28.510476, rel=1e-5)
    assert metrics.ray_drop_f1 == pytest.approx(0.948096, rel=1e-5)


def test_errors_of_full_images_are_those_of_the_second_implementation():
    random = np.random.default_rng(6)
    depth_m = random.uniform(1, 90, (HEIGHT, WIDTH))  # beyond 80 m, depths are clipped
    intensity = random.uniform(0, 1.2, depth_m.shape)
    recorded = PanoramaImage(depth_m, intensity)
    simulated = PanoramaImage(
        depth_m + random.normal(0, 0.1, depth_m.shape),
        intensity + random.uniform(0, 0.1, depth_m.shape),
    )
    metrics = FrameMetrics.between(simulated, recorded)
    images = [one.depth_m.clip(1e-6, 80) for one in (simulated, recorded)]
    np.testing.assert_allclose(metrics[2:7], errors_by_loop(*images, 80.0), rtol=1e-9)
    assert metrics.depth_median_abs_error_m == pytest.approx(0.0674 * 79 / 89, abs=0.01)
    images = [one.intensity.clip(1e-6, 1) for one in (simulated, recorded)]
    np.testing.assert_allclose(metrics[7:12], errors_by_loop(*images, 1.0), rtol=1e-9)


def test_equal_frames_have_no_errors(pair):
    image = PanoramaImage.from_points(*pair[1])
    metrics = FrameMetrics.between(image, image)
    assert metrics.chamfer_m2 < 1e-12
    assert metrics[1:5] == (1, 0, 0, pytest.approx(1))
    assert metrics.intensity_rmse == metrics.ray_drop_rmse == 0
    assert metrics.ray_drop_accuracy == metrics.ray_drop_f1 == 1
    figures = average_metrics([metrics], [7], full_scale=255.0, intensity_factor=1.0)
    assert figures["depth"]["psnr_db"] is None
    assert figures["depth"]["lpips"] is None
    assert figures["by_frame"][0]["sweep"] == 7
    json.dumps(figures, allow_nan=False)


def test_a_frame_without_returns_has_no_chamfer_distance(pair):
    image = PanoramaImage.from_points(*pair[1])
    metrics = FrameMetrics.between(PanoramaImage.from_points(np.empty((0, 3))), image)
    figures = average_metrics([metrics], [0])
    assert (figures["chamfer_m2"], figures["f_score"]) == (None, 0)
    assert figures["intensity"] is None
    assert figures["ray_drop"]["f1"] == 0
    # Cells without a return count as a depth of 0.
    share = image.return_mask.mean()
    mean_square = share * np.mean(image.depth_m[image.return_mask] ** 2)
    assert figures["depth"]["rmse_m"] == pytest.approx(np.sqrt(mean_square), rel=1e-6)
    assert figures["depth"]["median_abs_error_m"] == 0


def test_similarity_is_that_of_all_windows():
    random = np.random.default_rng(5)
    b = random.uniform(0, 80, (13, 20))
    a = b + random.normal(0, 9, b.shape)
    found = structural_similarity(a, b)
    assert found == pytest.approx(similarity_by_loop(a, b), rel=1e-12)
    assert structural_similarity(b, a) != found  # the range of the second image counts


def test_similarity_is_undefined_for_a_constant_image():
    assert math.isnan(structural_similarity(np.zeros((9, 9)), np.zeros((9, 9))))


def test_lpips_gets_clipped_images_if_it_is_installed(pair, torch, monkeypatch):
    seen = []

    def network(a, b, *, normalize):
        seen.append((a, b, normalize))
        return np.array(0.25)

    module = types.ModuleType("lpips")
    module.LPIPS = lambda net, verbose: SimpleNamespace(eval=lambda: network)
    monkeypatch.setitem(sys.modules, "lpips", module)
    monkeypatch.setattr(lidar4d, "has_lpips", lambda: True)
    torch.no_grad = nullcontext
    lidar4d._lpips_network.cache_clear()
    metrics = FrameMetrics.between(*(PanoramaImage.from_points(*one) for one in pair))
    lidar4d._lpips_network.cache_clear()
    assert (metrics.depth_lpips, metrics.intensity_lpips) == (0.25, 0.25)
    (depth, _, normalize), _ = seen
    assert normalize and depth.dtype == np.float32
    assert depth.min() == np.float32(1e-6) and 70 < depth.max() <= 80


@pytest.mark.extended
def test_intensities_have_the_full_scale_of_their_recording(pair):
    highest = (0.5, 1, 200, 256, 70_000)
    scales = [full_scale_of(np.array([value]), are_energies=False) for value in highest]
    assert scales == [1, 1, 255, 65_535, 70_000]
    assert full_scale_of(np.array([0.1, 0.5]), are_energies=True) == 0.5
    (points_a, intensity_a), (points_b, intensity_b) = pair
    expected = FrameMetrics.between(*(PanoramaImage.from_points(*one) for one in pair))
    b = Sweep(points_b, {"intensity": 255 * intensity_b})
    for scale, energies, factor in (
        (1, (False, False), 255),
        (255, (False, False), 1),
    ):
        frames = FrameCollector(energies)
        frames.add((0, 0), Sweep(points_a, {"intensity": scale * intensity_a}), b)
        found = frames.figures()
        assert found["intensity"]["factor"] == factor
        assert found["intensity"]["full_scale"] == 255
        assert found["intensity"]["rmse"] == pytest.approx(expected.intensity_rmse, rel=1e-9)
    # Energies have the same scale, which is the highest one of B.
    frames = FrameCollector((True, True))
    frames.add((0, 0), Sweep(points_a, {"intensity": 255 * intensity_a}), b)
    assert frames.figures()["intensity"]["factor"] == 1
    assert frames.figures()["intensity"]["full_scale"] == pytest.approx(255, rel=1e-3)
    # Other energies have another scale, so their median is that of the recording.
    frames = FrameCollector((True, False))
    frames.add((0, 0), Sweep(points_b, {"intensity": 1e-3 * intensity_b}), b)
    assert frames.figures()["intensity"]["factor"] == pytest.approx(255_000)
    assert frames.figures()["intensity"]["rmse"] == pytest.approx(0, abs=1e-12)


@pytest.fixture
def recordings(pair, tmp_path):
    """Return two folders of KITTI files with two frames each."""
    folders = []
    for name, frames in (("a", pair), ("b", (pair[1], pair[1]))):
        folders.append(tmp_path / name)
        folders[-1].mkdir()
        for number, (points, intensity) in enumerate(frames):
            rows = np.column_stack([points, intensity]).astype(np.float32)
            rows.tofile(folders[-1] / f"{number:010d}.bin")
    return folders


def run_compare(*arguments):
    done = CliRunner().invoke(cli, ["compare", *map(str, arguments)])
    assert done.exit_code == 0, done.exception
    return done.output


@pytest.mark.extended
def test_compare_averages_the_metrics_of_frames(recordings, pair, tmp_path):
    output = run_compare(*recordings, "--protocol", "lidar4d", "--out", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "compare.json").read_text())["lidar4d"]
    assert found["protocol"] == "lidar4d"
    assert found["frames"] == 2
    assert found["image"] == {
        "rows": 66, "columns": 1030, "fov_up_deg": 2.0, "fov_deg": 26.9, "max_depth_m": 80.0,
    }  # fmt: skip
    assert [one["sweep"] for one in found["by_frame"]] == [[0, 0], [1, 1]]
    expected = FrameMetrics.between(*(PanoramaImage.from_points(*one) for one in pair))
    first = found["by_frame"][0]
    assert first["chamfer_m2"] == pytest.approx(expected.chamfer_m2, rel=1e-3)
    assert first["depth"]["ssim"] == pytest.approx(expected.depth_ssim, rel=1e-3)
    assert first["intensity"]["rmse"] == pytest.approx(expected.intensity_rmse, rel=1e-3)
    assert found["f_score"] == pytest.approx((expected.f_score + 1) / 2, rel=1e-3)
    assert found["depth"]["rmse_m"] == pytest.approx(expected.depth_rmse_m / 2, rel=1e-3)
    assert found["depth"]["psnr_db"] is None  # infinite in the second frame
    assert found["ray_drop"]["f1"] == pytest.approx((expected.ray_drop_f1 + 1) / 2, rel=1e-3)
    assert "lidar4d  2 frames: C-D " in output
    assert "Protocol of LiDAR4D" in (tmp_path / "out" / "compare.html").read_text()
    plain = run_compare(*recordings, "--json", "--out", tmp_path / "out")
    assert json.loads(plain)["lidar4d"] is None


def test_clouds_without_sweeps_and_other_protocols_are_refused(recordings, tmp_path):
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).random((100, 3)))
    cloud = tmp_path / "cloud.npy"
    with pytest.raises(LidarError, match=r"cloud\.npy has no sweeps, which `--protocol lidar4d`"):
        compare(cloud, cloud, protocol="lidar4d")
    with pytest.raises(LidarError, match="protocol"):
        compare(*recordings, protocol="lidar5d")


def held_out(number, points, pose, moved, simulated):
    """Return the pulses of a sweep whose sensor moves, and rays with these simulated ranges."""
    returned = simulated > 0
    origins = np.linspace(0, 1, len(points))[:, None] * moved

    def aligned(rows, lengths):
        toward = points[rows] - origins[rows]
        ends = origins[rows] + toward * lengths[:, None]
        turned = [one @ pose[:3, :3].T + pose[:3, 3] for one in (ends, origins[rows])]
        ring = np.zeros(len(rows), np.int64)
        return AlignedSweep(ends, *turned, ring, np.full(len(rows), 100.0), None)

    range_m = np.linalg.norm(points - origins, axis=1)
    rows = np.flatnonzero(returned)
    lost = np.flatnonzero(~returned)
    pulses = aligned(rows, np.ones(len(rows))), aligned(lost, 1 / range_m[lost])
    rays = HeldOutRays(
        sweep=np.full(len(points), number),
        ring=np.zeros(len(points), np.int64),
        range_m=np.append(range_m[rows], np.full(len(lost), np.nan)),
        simulated_m=np.append(simulated[rows] * range_m[rows], np.full(len(lost), np.nan)),
        intensity=np.full(len(points), 100.0),
        simulated_intensity=np.full(len(points), 100.0),
        standing=np.ones(len(points), bool),
        moving=np.zeros(len(points), bool),
        on_object=np.zeros(len(points), bool),
    )
    return pulses, rays


def test_held_out_frames_are_in_the_sensor_frame(pair):
    points, _ = pair[1]
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 7], [0, 0, 1, 2], [0, 0, 0, 1]])
    moved = np.array([0.5, 0.0, 0.0])
    simulated = np.where(np.arange(len(points)) % 10, 1.0, 0.0)
    pulses, rays = held_out(3, points, turn, moved, simulated)
    farther, far_rays = held_out(4, points, turn, moved, 1.05 * simulated)
    alignment = SimpleNamespace(poses={3: turn, 4: turn})
    sweeps = SimpleNamespace(
        read=lambda number: {3: pulses[0], 4: farther[0]}[number],
        alignment=alignment,
        recorded=SimpleNamespace(recording=made_recording("drive", 0, None)),
    )
    both = HeldOutRays.concatenate([rays, far_rays])
    frames = HeldOutFrames.from_rays(sweeps, both, {3: pulses, 4: farther})
    assert frames.sweep.tolist() == [3, 4]
    assert frames.full_scale.tolist() == [255, 255]
    equal, other = (FrameMetrics(*row) for row in frames.metrics.tolist())
    assert equal.chamfer_m2 < 1e-12
    assert (equal.f_score, equal.ray_drop_f1) == (1, 1)
    assert equal.depth_rmse_m == pytest.approx(0, abs=1e-9)
    expected = PanoramaImage.from_points(
        1.05 * (points - np.linspace(0, 1, len(points))[:, None] * moved)[simulated > 0]
        + (np.linspace(0, 1, len(points))[:, None] * moved)[simulated > 0]
    )
    recorded = PanoramaImage.from_points(points[simulated > 0])
    assert other.chamfer_m2 == pytest.approx(FrameMetrics.between(expected, recorded).chamfer_m2)
    figures = HeldOutFrames.figures([frames])
    assert figures["frames"] == 2
    assert figures["intensity"]["full_scale"] == 255
    assert HeldOutFrames.figures([frames._replace(**{
        name: getattr(frames, name)[:0] for name in frames._fields
    })]) is None  # fmt: skip


def test_windows_hold_out_the_frames_of_lidar4d():
    assert [*WINDOWS] == [1538, 1728, 1908, 3353, 2350, 4950, 8120, 10200, 10750, 11400]
    assert (WINDOWS[1538].last, WINDOWS[1538].held_out) == (1601, (1551, 1564, 1577, 1590))
    assert (WINDOWS[3353].last, WINDOWS[3353].held_out) == (3416, (3366, 3379, 3392, 3405))
    assert (WINDOWS[4950].last, WINDOWS[4950].held_out) == (5000, (4960, 4970, 4980, 4990))
    assert (WINDOWS[11400].last, WINDOWS[11400].held_out) == (11450, (11410, 11420, 11430, 11440))


@pytest.mark.parametrize(("count", "first"), [(51, 0), (2401, 2350), (2500, 2350)])
def test_a_window_is_read_from_all_frames_or_is_alone(count, first, monkeypatch, tmp_path):
    ring = np.repeat(np.arange(4), 100)
    azimuth = np.tile(np.linspace(-3, 3, 100), 4)
    points = np.stack([np.cos(azimuth), np.sin(azimuth), 0.1 * ring], axis=1)

    def read(number):
        return Sweep(points * (1 + number), {"ring": ring})

    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    recording = made_recording(
        "frames", count, read, read_stamps=lambda: range(count), read_poses=lambda: poses
    )
    module = "lidarreal.reconstruction.recorded_sweeps"
    monkeypatch.setattr(f"{module}.open_recording", lambda *_, **__: recording)
    recorded = RecordedSweeps.open(tmp_path / str(count), window=2350)
    assert recorded.count == 51
    np.testing.assert_allclose(recorded.read(10).points[0], points[0] * (first + 11))
    opened = recorded.recording
    assert opened.poses([0, 50])[:, 0, 3].tolist() == [first, first + 50]
    assert opened.stamps_ns.tolist() == [*range(first, first + 51)]
    short = changed_recording(recording, count=2000)
    monkeypatch.setattr(f"{module}.open_recording", lambda *_, **__: short)
    with pytest.raises(LidarError, match="has 2,000 sweeps, but the window consists of the frames"):
        RecordedSweeps.open(tmp_path / "short", window=2350)
