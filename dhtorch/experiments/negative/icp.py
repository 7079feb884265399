"""Question: does ICP between independently sampled sparse sets add anything to a good device pose?

A chain of frames is placed by relative poses from one of three sources: ``good``, the recording's own trajectory;
``poor``, the same with rotation and translation errors per link; ``none``, the identity. Each is used unchanged, and
refined by ICP, point to point and point to plane, between point sets sampled independently in each frame. A refined
link is used if it is confident; otherwise the source's pose is kept and the frame is left out of the map. Lengths are
in units of the median depth of the scene's first frame, so that scenes of different size are comparable.

Expectation (written before the run; the refutation was made stricter after it, as the paper has it): no; over a good
pose ICP is rarely confident, so it covers fewer voxels than the pose alone (the paper: 5417 against 6200), and where
the trajectory is exact it adds drift. It earns its keep only without a pose: there it ends nearer to the truth than the
identity does.
What would refute it: on half of the scenes point-to-point ICP over the good pose covers as many voxels as the pose
alone, most of its links are confident, or without a pose it fails to end nearer to the truth on half of them.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import MainMetric, Row
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    ScenePairs,
    ScreenedItem,
    Settings,
    no_progress,
    paired_metric,
    screen_scenes,
)
from dhtorch.geometry import se3, sparse_grid
from dhtorch.geometry.checks import check
from dhtorch.geometry.least_squares import move_pose, select_batch, solve_spd
from dhtorch.geometry.linalg import small_matmul
from dhtorch.metrics import bootstrap
from dhtorch.pytree import Record, record
from dhtorch.records import Frame, Pose
from dhtorch.runtime.console import format_count
from dhtorch.synthetic.recording import SyntheticRoom

# Iterative closest point registration of two sparse point sets, with inlier ratio and conditioning.
#
# Alphabet: ``x`` points of set 0 and ``Y = R x + t`` in frame 1; ``q`` the point of set 1 nearest to Y and ``m`` the
# normal there. Point to point drives Y − q to zero, point to plane only its part along m. ``xi`` is the left
# perturbation of the pose, as in :mod:`dhtorch.geometry.least_squares`.

#: Smallest number of matches for a valid registration; three fix a rigid motion.
_MIN_MATCHES = 6


@record
class _IcpRegistration(Record):
    """Relative pose of two point sets, with matches, residual and conditioning."""

    T_1_from_0: Pose
    matched: Tensor  # (B, N) bool: points of set 0 with a point of set 1 within reach, at the final pose
    inlier_share: Tensor  # (B,) fraction of the points of set 0 that are matched; 0 without any
    rms_m: Tensor  # (B,) RMS distance of the matched points (along the normal for planes); NaN without any
    condition: Tensor  # (B,) smallest over largest eigenvalue of the normal matrix, lengths in units of the set's size
    ok: Tensor  # (B,) bool: enough matches, which constrain all six degrees of freedom


def register_icp(
    xyz_0: Tensor,  # (B, N, 3) m in frame 0, NaN = no point
    xyz_1: Tensor,  # (B, M, 3) m in frame 1, NaN = no point
    T_init: Pose,  # (B) 1 from 0
    *,
    normals_1: Tensor | None = None,  # (B, M, 3) unit, NaN = no plane there
    reach_m: float = 0.25,
    shrink: float = 0.9,
    least_reach_m: float = 0.1,
    keep: float = 0.8,
    iterations: int = 30,
) -> _IcpRegistration:
    """Register set 0 to set 1 by trimmed ICP from an initial pose: points, initial pose -> registration.

    Every iteration matches each point with its nearest, keeps the best matches and takes one Gauss–Newton step, which
    for points is the closed-form alignment up to second order in the rotation. The match distance shrinks from step to
    step: a distant start converges, and regions without overlap do not bias the end.

    Args:
        xyz_0, xyz_1: the sets; their numbers of points may differ.
        T_init: initial pose: a device's pose, or the identity.
        normals_1: for point-to-plane ICP; None = point to point.
        reach_m: largest match distance at the start.
        shrink: factor on the match distance from step to step.
        least_reach_m: lower bound of the match distance; matches within it count for ``inlier_share`` and ``rms_m``.
        keep: fraction of the matches kept in a step, the nearest ones (trimmed ICP).
        iterations: number of steps; there is no early stop.

    Returns:
        Registration. Where not ok, the pose is the initial one.

    Raises:
        ValueError: wrong shapes or options, or an empty set (N = 0 or M = 0).

    Gradient: none; matches are discrete.
    Cost: iterations × N × M distances.
    Source: P. Besl, N. McKay 1992 (points); Y. Chen, G. Medioni 1991 (planes); D. Chetverikov et al. 2002 (trimming).
    """
    sizes = check("register_icp", xyz_0=(xyz_0, "B N 3"), xyz_1=(xyz_1, "B M 3"), R=(T_init.R, "B 3 3"))
    check("register_icp", xyz_1=(xyz_1, "B M 3"), normals_1=(normals_1, "B M 3"))
    if not (sizes["N"] and sizes["M"]):
        raise ValueError(f"register_icp: sets have {sizes['N']} and {sizes['M']} points, expected at least one each")
    if not (0 < keep <= 1 and 0 < shrink <= 1 and 0 < least_reach_m <= reach_m and iterations > 0):
        options = f"keep={keep}, shrink={shrink}, least_reach_m={least_reach_m}, reach_m={reach_m}"
        raise ValueError(
            f"register_icp: found {options}, expected keep and shrink in (0, 1], 0 < least_reach_m <= reach_m, and at"
            " least one iteration"
        )
    with torch.no_grad():
        sets = _PointSets(xyz_0, xyz_1, normals_1)
        start = Pose(T_init.R.double(), T_init.t.double())
        finite = start.R.isfinite().all(-1).all(-1) & start.t.isfinite().all(-1)
        T = select_batch(finite, start, se3.identity(len(start.t), start.t))
        reach = reach_m
        for _ in range(iterations):
            H, g, _, _ = sets.linearise(T, reach, keep)
            T = move_pose(T, solve_spd(H, -g[..., None])[0][..., 0])
            reach = max(reach * shrink, least_reach_m)
        H, _, matched, square = sets.linearise(T, least_reach_m, 1.0)
    n = matched.sum(-1)
    condition = sets.condition(T, H)
    ok = finite & (n >= _MIN_MATCHES) & (condition > 1e-9)
    rms = torch.where(n > 0, (torch.where(matched, square, 0.0).sum(-1) / n.clamp_min(1)).sqrt(), torch.nan)
    share = n / sets.valid_0.sum(-1).clamp_min(1)
    pose = select_batch(ok, T, start).to(xyz_0.dtype)
    share, rms, condition = (v.to(xyz_0.dtype) for v in (share, rms, condition))
    return _IcpRegistration(pose, matched, share, rms, condition, ok)


def estimate_normals(
    xyz: Tensor,  # (B, M, 3) m, NaN = no point
    *,
    neighbours: int = 8,
    max_bend: float = 0.1,
) -> Tensor:
    """Unit normals (B, M, 3), towards the camera, of planes fitted to each point and its nearest neighbours.

    Args:
        xyz: points in a camera's frame.
        neighbours: number of nearest points in the fit.
        max_bend: largest fraction of the neighbourhood's variance off the plane; NaN above it.

    Raises:
        ValueError: wrong shapes, fewer points than neighbours, or fewer than three neighbours.

    Gradient: none.
    """
    sizes = check("estimate_normals", xyz=(xyz, "B M 3"))
    if not 3 <= neighbours < sizes["M"]:
        raise ValueError(
            f"estimate_normals: found {sizes['M']} points, {neighbours} neighbours, expected 3 or more of more"
        )
    with torch.no_grad():
        valid = xyz.isfinite().all(-1)
        x = _move_invalid_away(xyz, valid, 1e6)
        nearest = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").topk(neighbours + 1, -1, largest=False)
        group = x.gather(1, nearest.indices.flatten(1)[..., None].expand(-1, -1, 3)).view(*nearest.indices.shape, 3)
        deviation = (group - group.mean(-2, keepdim=True)).double()
        covariance = (deviation[..., :, None] * deviation[..., None, :]).mean(-3)
        has_neighbours = valid & (nearest.values[..., -1] < 1e5)
        eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
        values, vectors = torch.linalg.eigh(torch.where(has_neighbours[..., None, None], covariance, eye))
        normal = vectors[..., 0]
        normal = torch.where(((normal * x).sum(-1) > 0)[..., None], -normal, normal).to(xyz.dtype)
        flat = has_neighbours & (values[..., 0] <= max_bend * values.sum(-1)) & (values[..., 1] > 2 * values[..., 0])
    return torch.where(flat[..., None], normal, torch.nan)


class _PointSets:
    """Two point sets with invalid points replaced; sums are in float64."""

    def __init__(self, xyz_0: Tensor, xyz_1: Tensor, normals_1: Tensor | None) -> None:
        self.valid_0, valid_1 = xyz_0.isfinite().all(-1), xyz_1.isfinite().all(-1)
        if normals_1 is not None:
            valid_1 = valid_1 & normals_1.isfinite().all(-1)
        self.x = torch.where(self.valid_0[..., None], xyz_0, 0.0).double()
        self.q = _move_invalid_away(xyz_1, valid_1, 1e6)
        self.normals = None if normals_1 is None else torch.where(valid_1[..., None], normals_1, 0.0)
        weight = self.valid_0[..., None].double()
        count = weight.sum(1).clamp_min(1)
        deviation = (self.x - (self.x * weight).sum(1, keepdim=True) / count[:, None]) * weight
        self.size = ((deviation * deviation).sum((1, 2)) / count[:, 0]).sqrt().clamp_min(1e-9)  # (B,) m
        self.centre = (self.x * weight).sum(1) / count

    def linearise(self, T: Pose, reach: float, keep: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Normal equations H (B, 6, 6), g (B, 6) of the kept matches, their mask and squared residuals (B, N)."""
        Y = se3.apply(T, self.x)
        distance, index = torch.cdist(Y.to(self.q.dtype), self.q, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
        matched = self.valid_0 & (distance < reach)
        if keep < 1:
            ranked = torch.where(matched, distance, torch.inf).sort(-1).values
            last = (keep * matched.sum(-1, keepdim=True)).ceil().long().sub(1).clamp_min(0)
            matched = matched & (distance <= ranked.gather(-1, last))
        r = Y - _gather_rows(self.q, index).double()  # (B, N, 3)
        J = torch.cat((-se3.hat(Y), torch.eye(3, dtype=Y.dtype, device=Y.device).expand(*Y.shape, 3)), -1)
        if self.normals is not None:
            m = _gather_rows(self.normals, index).double()
            r = (m * r).sum(-1, keepdim=True)
            J = (m[..., None] * J).sum(-2, keepdim=True)
        w = matched.double()[..., None, None]
        Jw = J * w
        H = (Jw[..., :, None] * J[..., None, :]).sum((1, 2))
        g = (Jw * r[..., None]).sum((1, 2))
        return H, g, matched, (r * r).sum(-1)

    def condition(self, T: Pose, H: Tensor) -> Tensor:
        """Reciprocal condition number (B,) of H, rotations about the set's centre scaled by its size; 0 if singular.

        About the centre the motion of a point is ω × (Y − c) + u, so that the translation in H is u − ω × c.
        """
        eye = torch.eye(3, dtype=H.dtype, device=H.device).expand(len(H), 3, 3)
        c = se3.apply(T, self.centre[:, None])[:, 0]
        size = self.size[:, None, None]
        A = torch.cat((torch.cat((eye / size, 0 * eye), -1), torch.cat((se3.hat(c) / size, eye), -1)), -2)
        values = torch.linalg.eigvalsh(small_matmul(A.mT, small_matmul(H, A)))
        return (values[:, 0].clamp_min(0) / values[:, -1].clamp_min(1e-300)).clamp(0, 1)


def _gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """Rows (B, N, 3) of values (B, M, 3) at an index (B, N)."""
    return values.gather(1, index[..., None].expand(-1, -1, 3))


def _move_invalid_away(xyz: Tensor, valid: Tensor, far: float) -> Tensor:
    """Points with invalid ones moved to a coordinate ``far`` from all others."""
    return torch.where(valid[..., None], xyz, far)


ICP_POSE_SOURCES = ("good", "poor", "none")
_SOLVERS = ("", " + icp points", " + icp planes")
VARIANTS = tuple(source + solver for source in ICP_POSE_SOURCES for solver in _SOLVERS)
_TRUTH = "trajectory"

#: Share of confident links below which ICP counts as rarely confident. Source: derived, fewer than half.
_RARELY = 0.5

#: Smallest number of points in a set; links with a smaller one are skipped.
_MIN_SET_POINTS = 16


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    n: int = 1024,
    links: int = 10,
    voxel: float = 0.02,
    reach: float = 0.12,
    least_reach: float = 0.05,
    min_inlier_share: float = 0.6,
    min_condition: float = 1e-3,
    poor_deg: float = 3.0,
    poor_shift: float = 0.03,
    progress: Progress = no_progress,
) -> Outcome:
    """Run the experiment: chains of frames with each source of poses, alone and refined by ICP.

    Rows of links: error of the relative pose against the trajectory (``rotation_deg``, ``translation_m``,
    ``translation_rel`` in median depths), ``confident`` (0 or 1), ``inlier_share``, ``rms_m``, ``condition``. Rows of
    scenes: their medians, ``confident_share``, and of the whole chain ``n_voxels`` covered by the frames with a
    confident link, ``voxels_vs_pose``, the ratio of that number to that of the same poses alone, ``n_voxels_all`` by
    all frames, ``right_share`` (fraction of ``n_voxels`` within one voxel of the map on the true path: a smeared map
    covers more), ``drift_deg`` and ``drift_rel`` at its end. A built-in room has its true path; elsewhere the good pose
    is the reference, with zero drift by definition, and its errors are part of ICP's drift.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`. Scenes without a trajectory or with
            depth in one frame only have no links.
        methods: name → method; stages 1 and 2 of the first are run, its sampler with a different gaze in every frame.
        pairs: not used: links are evenly spaced along the recording.
        n: samples of a frame.
        links: largest number of links of a chain.
        voxel, reach, least_reach: voxel size, first and last limit of the match distance, in median depths.
        min_inlier_share, min_condition: thresholds of a confident link.
        poor_deg, poor_shift: errors of a poor link, degrees and median depths, in seeded random directions.

    Source: paper, "What Does Not Work", point-to-point ICP over a good VIO track.
    """
    method = next(iter(methods.values())).replace(n=n)
    chains: dict[str, _Chain] = {}

    def evaluate_item(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        chain = chains.setdefault(scene.name, _Chain(scene.recording, method, settings, voxel))
        if not all(chain.cloud(k)[0].isfinite().all(-1).sum() >= _MIN_SET_POINTS for k in item):
            return {}
        starts = {"good": chain.relative(item), "none": se3.identity(1, chain.cloud(item[0]).double())}
        starts["poor"] = se3.compose(chain.error(item, poor_deg, poor_shift), starts["good"])
        rows: dict[str, Row] = {}
        for source in ICP_POSE_SOURCES:
            for solver in _SOLVERS:
                fit = chain.refine(item, starts[source], solver, reach, least_reach)
                confident = fit is None or bool(
                    fit.ok & (fit.inlier_share >= min_inlier_share) & (fit.condition >= min_condition)
                )
                T = starts[source] if fit is None or not confident else fit.T_1_from_0.to(torch.float64)
                chain.keep(source + solver, item, T, confident)
                rows[source + solver] = _evaluate_link(chain, item, T, fit, confident)
        return rows

    def whole(scene: Scene, rows: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
        chain = chains.pop(scene.name, None)
        return {v: chain.summary(v) for v in VARIANTS} if chain and any(rows) else {}

    def items(scene: Scene) -> list[ScreenedItem]:
        return consecutive_links(scene.recording, links)

    outcome = screen_scenes(
        scenes_of(scenes),
        items,
        evaluate_item,
        VARIANTS,
        truth=_TRUTH,
        whole=whole,
        metrics=(
            MainMetric("rotation_deg", larger_is_better=False),
            MainMetric("translation_m", larger_is_better=False),
            MainMetric("n_voxels", larger_is_better=True),
            MainMetric("drift_rel", larger_is_better=False),
        ),
        finished=settings.finished,
        progress=progress,
    )
    return outcome.decide(
        "Does ICP between independently sampled sparse sets add anything to a good device pose?",
        "No: it covers fewer voxels than the pose alone; without a pose it ends nearer to the truth than nothing.",
        *verdict(outcome),
    )


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Verdict and text: fewer voxels over a good pose and rarely confident, but nearer to the truth without a pose."""
    voxel_pairs = paired_metric(outcome, _TRUTH, "good + icp points", "good", "n_voxels")
    drift_pairs = paired_metric(outcome, _TRUTH, "none + icp points", "none", "drift_rel")
    if not voxel_pairs or not drift_pairs:
        return None, "no scene with a trajectory and depth in two frames"
    n_fewer, n_nearer = (sum(a < b for a, b in value_pairs) for value_pairs in (voxel_pairs, drift_pairs))
    total = [sum(pair[k] for pair in voxel_pairs) for k in (0, 1)]
    ratio = bootstrap.interval_over_scenes([a / max(b, 1) for a, b in voxel_pairs])
    low, high = (ratio.value if bound is None else bound for bound in (ratio.low, ratio.high))
    confident_shares = [
        r["confident_share"] for r in outcome.scenes("good + icp points", _TRUTH).values() if r["n_pairs"]
    ]
    why = (
        f"over a good pose ICP covers {total[0]:.0f} voxels, the pose alone {total[1]:.0f} (paper: 5417, 6200), fewer"
        f" on {n_fewer} of {len(voxel_pairs)} scenes, median ratio {ratio.value:.2f} ({low:.2f} to {high:.2f}),"
        f" {sum(confident_shares) / len(confident_shares):.0%} of the links confident; without a pose it ends nearer"
        f" than the identity on {n_nearer} of {len(drift_pairs)}"
    )
    rarely_confident = sum(confident_shares) < _RARELY * len(confident_shares)
    return n_fewer > len(voxel_pairs) / 2 and rarely_confident and n_nearer > len(drift_pairs) / 2, why


def consecutive_links(recording: Recording, links: int) -> list[ScreenedItem]:
    """Links (pairs of frames) of a chain at a constant step over a recording; empty without a trajectory.

    Raises:
        ValueError: fewer than two frames, or ``links`` below 1.
    """
    if len(recording) < 2 or links < 1:
        actual = f"{format_count(len(recording), 'frame')} of {recording.name} and links={links}"
        raise ValueError(f"icp: found {actual}, expected at least two frames and one link")
    if recording.poses is None:
        return []
    step = math.ceil((len(recording) - 1) / links)
    return [(i, i + step) for i in range(0, len(recording) - step, step)]


class _Chain:
    """Point sets and trajectory of a recording, and the frame poses of each variant so far."""

    def __init__(self, recording: Recording, method: Method, settings: Settings, voxel: float) -> None:
        self.recording, self.method, self.settings = recording, method, settings
        self.clouds: dict[int, Tensor] = {}
        self.placed: dict[str, dict[int, tuple[Pose, bool]]] = {v: {} for v in VARIANTS}
        depth = self.cloud(0)[0, :, 2]
        self.scale = float(depth[depth.isfinite()].median()) if bool(depth.isfinite().any()) else 1.0  # m
        self.voxel = voxel * self.scale
        assert recording.poses is not None  # recordings without poses have no links
        self.poses: Pose = recording.poses
        self.true_poses: Pose = recording.true_poses if isinstance(recording, SyntheticRoom) else recording.poses

    def cloud(self, i: int) -> Tensor:
        """Points (1, n, 3) of the samples of frame ``i``, with a random gaze."""
        if i not in self.clouds:
            frame: Frame = self.recording[i].to(self.settings.dtype).to(self.settings.device)
            generator = torch.Generator().manual_seed(self.settings.seed + 1000 * (i + 1))
            relative_gaze = 0.4 + 0.2 * torch.rand(2, generator=generator)
            gaze = (float(relative_gaze[0]) * frame.hw[1], float(relative_gaze[1]) * frame.hw[0])
            stages, focal_length = self.method.replace(sample={"gaze": gaze}), frame.camera.f
            uv = stages.sample(frame.hw, stages.n, device=focal_length.device, dtype=focal_length.dtype)
            self.clouds[i] = stages.backproject(frame, uv).xyz
        return self.clouds[i]

    def relative(self, item: ScreenedItem, true: bool = False) -> Pose:
        """Relative pose from the earlier to the later frame, by the trajectory or the true path."""
        poses = self.true_poses if true else self.poses
        return se3.relative(*(poses[k : k + 1].to(torch.float64) for k in item))

    def error(self, item: ScreenedItem, degrees: float, shift: float) -> Pose:
        """Pose error of a size in degrees and median depths, in seeded random directions."""
        generator = torch.Generator().manual_seed(self.settings.seed + 7919 * (item[0] + 1))
        directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
        return se3.exp(torch.cat((directions[0] * math.radians(degrees), directions[1] * shift * self.scale))[None])

    def refine(
        self, item: ScreenedItem, start: Pose, solver: str, reach: float, least: float
    ) -> _IcpRegistration | None:
        """ICP registration of a link from a start; None without a solver."""
        if not solver:
            return None
        first, second = self.cloud(item[0]), self.cloud(item[1])
        planes = estimate_normals(second) if solver.endswith("planes") else None
        return register_icp(
            first, second, start, normals_1=planes, reach_m=reach * self.scale, least_reach_m=least * self.scale
        )

    def keep(self, variant: str, item: ScreenedItem, T: Pose, confident: bool) -> None:
        """Add the later frame of a link to the map of a variant."""
        placed = self.placed[variant]
        if item[0] not in placed:
            placed[item[0]] = (self.true_poses[item[0] : item[0] + 1].to(torch.float64), True)
        placed[item[1]] = (se3.compose(placed[item[0]][0], se3.invert(T)), confident)

    def voxels(self, placed: Mapping[int, tuple[Pose, bool]], confident_only: bool) -> Tensor:
        """Indices (V,) of the voxels occupied by the points of the placed frames."""
        points = [
            se3.apply(T, self.cloud(i).double())[0]
            for i, (T, confident) in placed.items()
            if confident or not confident_only
        ]
        return sparse_grid.occupied_cells(torch.cat(points), self.voxel)

    def summary(self, variant: str) -> Row:
        """Row of a variant's chain: voxels, confident links, and drift at its end."""
        placed = self.placed[variant]
        true_poses = {i: (self.true_poses[i : i + 1].to(torch.float64), True) for i in placed}
        covered, true_voxels = self.voxels(placed, confident_only=True), self.voxels(true_poses, confident_only=False)
        pose_voxels = self.voxels(self.placed[variant.split(" + ", maxsplit=1)[0]], confident_only=False)
        last = max(placed)
        drift = _pose_difference(placed[last][0], true_poses[last][0])
        links = [confident for i, (_, confident) in placed.items() if i != min(placed)]
        return {
            "n_voxels": len(covered),
            "voxels_vs_pose": len(covered) / max(len(pose_voxels), 1),
            "n_voxels_all": len(self.voxels(placed, confident_only=False)),
            "right_share": float(sparse_grid.touches_cells(covered, true_voxels).double().mean())
            if len(covered)
            else None,
            "confident_share": sum(links) / len(links),
            "drift_deg": drift[0],
            "drift_rel": drift[1] / self.scale,
            "median_depth_m": self.scale,
        }


def _evaluate_link(chain: _Chain, item: ScreenedItem, T: Pose, fit: _IcpRegistration | None, confident: bool) -> Row:
    """Row of a link: pose error, confidence, and the evidence of ICP."""
    angle, distance = _pose_difference(T, chain.relative(item, true=True))
    row: Row = {"rotation_deg": angle, "translation_m": distance, "translation_rel": distance / chain.scale}
    row |= {"confident": int(confident), "inlier_share": None, "rms_m": None, "condition": None}
    if fit is not None:
        row |= {k: float(v) if bool(v.isfinite()) else None for k in row if (v := getattr(fit, k, None)) is not None}
    return row


def _pose_difference(T: Pose, true: Pose) -> tuple[float, float]:
    """Angle (degrees) and distance (m) between two motions."""
    return math.degrees(float(se3.rotation_angle(T.R @ true.R.mT)[0])), float((T.t - true.t).norm())
