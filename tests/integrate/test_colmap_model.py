"""The COLMAP workspace of a map: what it leaves out where the written poses contradict the tracks."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from dhtorch.data.recording import Recording
from dhtorch.export.colmap import ColmapImage
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.integrate import colmap_model
from dhtorch.integrate.colmap_model import write_colmap_workspace
from dhtorch.integrate.recording import PairEstimate, estimate_pairs
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Camera, Frame, Pose
from dhtorch.synthetic import SyntheticRoom


@pytest.fixture(scope="module")
def pair() -> tuple[Recording, list[PairEstimate]]:
    room = SyntheticRoom(hw=(240, 320), n_frames=4, step_m=0.04, supersample=1)
    return room, list(estimate_pairs(room, METHODS["map"].replace(n=512), [(0, 3)], cutoff=2.0))


def poses_of(room: Recording, turn_deg: float = 0.0) -> dict[int, Pose]:
    assert room.poses is not None
    twist = torch.tensor([[0.0, np.deg2rad(turn_deg), 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    return {0: room.poses[:1], 3: se3.compose(room.poses[3:4], se3.exp(twist))}


def test_a_workspace_holds_the_frames_and_points_without_observations_that_the_poses_contradict(
    pair, tmp_path: Path
) -> None:
    """The error of a point is the mean of its distances."""
    room, answers = pair
    counts = write_colmap_workspace(tmp_path, room, answers, poses_of(room))
    assert counts.n_triangulated > 30 and counts.n_outliers < 0.1 * counts.n_triangulated
    wrong = write_colmap_workspace(tmp_path / "wrong", room, answers, poses_of(room, 5.0))
    assert wrong.n_triangulated < 0.1 * counts.n_triangulated and wrong.n_outliers >= counts.n_triangulated
    assert 0 < wrong.n_points < counts.n_points, "the sensor's depth stays, in the picture whose depth it is"
    names = sorted(p.name for p in (tmp_path / "images").iterdir())
    assert names == ["000000.png", "000003.png"] and room[3].image.dtype == torch.uint8
    picture = np.asarray(Image.open(tmp_path / "images" / names[1]))
    np.testing.assert_array_equal(picture, room[3].image[0].movedim(0, -1))
    images, points = (
        [line.split() for line in (tmp_path / "sparse/0" / name).read_text().splitlines() if not line.startswith("#")]
        for name in ("images.txt", "points3D.txt")
    )
    seen = {
        head[0]: np.array(uv, float).reshape(-1, 3)[:, :2] for head, uv in zip(images[::2], images[1::2], strict=True)
    }
    frame = {head[0]: int(Path(head[-1]).stem) for head in images[::2]}
    poses, camera = poses_of(room), room[0].camera.to(torch.float64)
    triangulated = [row for row in points if len(row) >= 12]
    assert len(triangulated) == counts.n_triangulated and len(points) == counts.n_points
    for row in triangulated:
        xyz, error, track = torch.tensor([float(x) for x in row[1:4]]).double(), float(row[7]), row[8:]
        misses = []
        for name, index in zip(track[::2], track[1::2], strict=True):
            inside = se3.apply(se3.invert(poses[frame[name]]), xyz[None, None])
            at = cameras.project(camera, inside)[0, 0] + 0.5
            misses.append(float((at - torch.from_numpy(seen[name][int(index)])).norm()))
        assert error == pytest.approx(np.mean(misses), abs=2e-3) and max(misses) < 4.001


def test_pictures_are_undistorted_as_opencv_does_and_have_no_empty_pixels() -> None:
    cv2 = pytest.importorskip("cv2")
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(1, 256, (1, 3, 60, 80), generator=generator, dtype=torch.uint8)
    lens = torch.tensor([[0.26, -0.95, -0.005, 0.003, 1.16]])
    camera = Camera(torch.tensor([[66.0, 65.0]]), torch.tensor([[40.5, 29.0]]), lens)
    picture, pinhole = colmap_model._undistort(Frame(image, torch.zeros(1, 60, 80), camera))
    K, K_new = (cameras.to_matrix(each)[0].double().numpy() for each in (camera, pinhole))
    maps = cv2.initUndistortRectifyMap(K, lens[0].double().numpy(), None, K_new, (80, 60), cv2.CV_32FC1)
    assert maps[0].min() > -0.01 and maps[0].max() < 79.01 and maps[1].min() > -0.01 and maps[1].max() < 59.01
    assert pinhole.distortion is None and not np.allclose(K, K_new)
    other = cv2.remap(image[0].movedim(0, -1).numpy(), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    assert np.abs(picture.astype(int) - other.astype(int)).max() <= 5, "weights of 1/32 px in OpenCV, exact ones here"


@pytest.mark.parametrize("n_depths", [24, 9000])
@pytest.mark.parametrize("kind", ["uint8", "grey, floating point"])
def test_swept_pixels_are_points_seen_in_their_picture(n_depths: int, kind: str) -> None:
    hw, map_hw = ((48, 64), (6, 8)) if n_depths == 24 else ((480, 640), (96, 128))
    generator = torch.Generator().manual_seed(1)
    image = torch.randint(0, 256, (1, 3, *hw), generator=generator, dtype=torch.uint8)
    image = image[:, :1] / 255 if kind != "uint8" else image
    camera = Camera(torch.full((1, 2), 60.0), torch.tensor([[30.0, 25.0]]))
    frame = Frame(image, torch.zeros(1, *hw), camera)
    depth = torch.zeros(1, *map_hw)
    depth.view(-1)[torch.randperm(depth.numel(), generator=generator)[:n_depths]] = 2.0
    depth = depth * torch.linspace(1, 2, map_hw[1])
    turn = se3.exp(torch.tensor([[0.1, 0.3, -0.2, 1.0, 2.0, 3.0]], dtype=torch.float64))
    shifted = camera.replace(c=camera.c + 1.0)  # of the written picture, which shows less at the left
    shots = [None, ColmapImage("a.png", shifted, hw, turn)]
    answer = SimpleNamespace(
        pair=(7, 9),
        camera=camera,
        rgb=torch.zeros(1, 5, 3),
        swept=SimpleNamespace(hw=map_hw, read=lambda: (depth, depth, depth)),
    )
    points = colmap_model._swept_points(answer, frame, shots, {7: 1})
    step = max(1, -(-n_depths // 4000))
    chosen = [k for k, z in enumerate(depth.flatten().tolist()) if z > 0][::step]
    rows, columns = np.divmod(chosen, map_hw[1])
    scale = hw[0] / map_hw[0]
    uv = np.stack(((columns + 0.5) * scale - 0.5, (rows + 0.5) * scale - 0.5), 1)
    moved = uv + 1
    inside = ((moved > -0.5) & (moved < np.array(hw[::-1]) - 0.5)).all(1)
    z = depth.flatten()[chosen].numpy()
    local = np.concatenate(((uv - [30, 25]) / 60 * z[:, None], z[:, None]), 1)
    world = local @ turn.R[0].numpy().T + turn.t[0].numpy()
    np.testing.assert_allclose(points.xyz, world[inside], atol=1e-5)
    np.testing.assert_allclose(points.uv[:, 0], moved[inside], atol=1e-4)
    assert bool(points.uv[:, 1].isnan().all()) and (points.error == -1).all()
    assert points.seen_by.tolist() == [[1, -1]] * int(inside.sum())
    nearest = np.floor(uv + 0.5).astype(int)[inside]
    pixels = image[0].expand(3, *hw)[:, nearest[:, 1], nearest[:, 0]].T
    np.testing.assert_allclose(points.rgb, pixels / 255 if kind == "uint8" else pixels, atol=1e-6)
