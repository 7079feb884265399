"""Was a camera moved? A reference view and later pictures -> offset of the camera with covariance, and a verdict.

Places of the reference, evenly spread, are tracked into the picture, without regard to gain and bias of a window. What
moves by itself (a robot, objects, people) or hides the background does not fit the one rigid motion that most tracks
share, and leaves the fit. Near returns of the reference give the motion in metres; the picture needs no depth. Without
any depth the rotation is known, and the translation only up to scale.

The verdict is a test of *the camera stands where it stood*: the squared Mahalanobis length of the offset against a
quantile for the stated false-alarm rate.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Flag, PinReason, PinVerdict, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry import motion_fit, se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.covariance import chi2_quantile, mahalanobis, masked_median
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.least_squares import select_batch
from dhtorch.geometry.motion_fit import MotionFit, Sightings, fit_epipolar_motion
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.pipeline.pair import undistort_tracks, uniform_draws
from dhtorch.pipeline.presets import AUTO, MAP_PYRAMID_LEVELS
from dhtorch.pytree import collate
from dhtorch.records import MIN_TRACKABILITY, Camera, Frame, PinResult, Pose, TrackHint, Tracks
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

#: Places in the reference that are followed, rows and columns: one in a cell of 20 px of 640x480.
#: Source: chosen on built-in rooms of seeds 40 and 41.
PIN_GRID = (24, 32)

#: Spacing of places from which on the tracker's windows do not overlap, px. Source: derived, windows of 21 px.
PIN_WINDOW_PX = 20.0

#: Candidates for a place along each side of its cell; the one with most texture is taken. Source: derived, 10 px apart.
PIN_CANDIDATES = 2

#: Groups of neighbouring tracks, rows and columns, within which errors are taken as common.
#: Source: chosen on built-in rooms of seeds 40 and 41.
PIN_GROUPS = (6, 8)

#: Fewest places with a depth for a motion in metres. Source: chosen, a twelfth of the places.
MIN_METRIC_PLACES = 64

#: Fewest tracks that agree for an answer. Source: chosen on built-in rooms of seeds 40 and 41.
MIN_PIN_INLIERS = 24

#: Fewest groups in which tracks agree, and the least fraction of all tracks that agree.
#: Source: chosen on built-in rooms of seeds 40 and 41.
MIN_PIN_GROUPS, MIN_PIN_AGREEMENT = 8, 0.25

#: Largest standard deviation of the shift, and largest noise of the tracks that agree, for an answer, px: objects that
#: were put elsewhere agree to about a pixel. Source: chosen on gr00t_demo, whose episodes show five tables: .3 to .5
#: and .9 to 1.
MAX_PIN_SIGMA_PX, MAX_PIN_NOISE_PX = 0.25, 0.9

#: Error of the reference's depth common to all its points, a fraction: it scales the translation.
#: Source: chosen, the 1 % that stage 2 assumes for a return.
COMMON_DEPTH_ERROR = 0.01

#: Motion of the picture of a camera that counts as standing still (warmth, vibration, compression), px in each of the
#: directions of the offset. Source: chosen, half a pixel is found and a quarter is not.
STILL_SWAY_PX = 0.1

#: Rotation-only noise over the noise of epipolar distances from which on tracks without depth show a translation.
#: Source: chosen on lerobot_g1, whose head sways by turning: 1.1 to 1.9.
MIN_PARALLAX_RATIO = 2.5

#: Fractions of the places below which agreeing tracks are searched again: from a coarse flow of the whole picture; from
#: where the motion found so far predicts them. Source: chosen on built-in rooms of seeds 40 and 41.
POOR_SHARE, ENOUGH_SHARE = 0.2, 0.5

#: Pyramid levels of the search from a predicted place, a count. Source: derived, windows reach 20 px.
PREDICTED_LEVELS = 2

#: Hypotheses of the search for a pose, a count. Source: derived, (1 - .4³)^256 < 1e-7 with 40 % of the tracks right.
PIN_HYPOTHESES = 256

#: Fraction of a capture's frames in which a place must agree with the camera's motion to count as background.
#: Source: chosen, robots hide a place for less than half of an episode.
MIN_BACKGROUND_SHARE = 0.4


class CameraPin:
    """A fixed camera's reference view, with which later pictures are compared.

    Args:
        ref: one RGB-D frame, or several of one camera position (a batch of frames or a sequence): then places that
            move between them are left out, and the reference picture is their median. Depth 0 is no return; without
            any the offset is not metric.
        false_alarm_rate: of the verdict *moved* for a camera that stands still.
        seed: of the pose search.

    ``metric`` says whether the reference has enough depth for an offset in metres.

    Raises:
        ValueError: wrong shapes, a rate outside (0, 1), a reference without texture.

    Example:
        >>> import torch
        >>> from dhtorch import CameraPin
        >>> from dhtorch.synthetic import SyntheticRoom
        >>> room = SyntheticRoom(path="static", hw=(120, 160), n_frames=2)
        >>> result = CameraPin(room[0]).check(room[1].image)
        >>> bool(result.moved[0]), bool(result.shift_px[0] < 0.5)
        (False, True)
    """

    @standard_numerics
    def __init__(self, ref: Frame | Sequence[Frame], *, false_alarm_rate: float = 0.01, seed: int = 0) -> None:
        if not 0 < false_alarm_rate < 1:
            raise ValueError(f"CameraPin: false_alarm_rate is {false_alarm_rate}, expected above 0 and below 1")
        frames = ref if isinstance(ref, Frame) else collate(ref)
        check("CameraPin", image=(frames.image, "B C H W"), depth=(frames.depth, "B h w"), f=(frames.camera.f, "B 2"))
        self.false_alarm_rate, self.seed = false_alarm_rate, seed
        self.notes: list[str] = []
        self._set_reference(frames[:1].detach(), None)
        if len(frames.image) > 1:
            self._use_capture(frames.detach())

    @standard_numerics
    @torch.no_grad()
    def check(self, image: Tensor, K: Tensor | Camera | None = None) -> PinResult:
        """Compare pictures with the reference.

        Args:
            image: (B, C, H, W) or (C, H, W), C 1 or 3, float in [0, 1] or uint8; another size than the reference's is
                taken as the same view, resized.
            K: (3, 3) or (B, 3, 3) intrinsics, px, or a camera; None = the reference's.

        Raises:
            ValueError: wrong shapes.
        """
        image = image[None] if image.dim() == 3 else image
        check("CameraPin.check", image=(image, "B C H W"))
        if K is None:
            K = cam.resize(self.frame.camera, self.frame.hw, (image.shape[-2], image.shape[-1]))
        if isinstance(K, Tensor):
            K = K[None] if K.dim() == 2 else K
            K = cam.from_matrix(K.to(self.frame.camera.f), None if len(K) > 1 else self.frame.camera.distortion)
        camera = K.to(self.frame.camera.f).map(lambda x: x.expand(len(image), *x.shape[1:]) if len(x) == 1 else x)
        picture = grayscale(image).to(self.frame.camera.f)
        return collate(self._check_one(picture[b : b + 1], camera[b : b + 1]) for b in range(len(image)))

    def _set_reference(self, frame: Frame, background: Tensor | None) -> None:
        """Choose the places of the reference; ``background`` (N,) keeps only some of them."""
        self.frame = frame
        self.picture = grayscale(frame.image).to(frame.camera.f)
        self.pyramid = PyramidCache(self.picture)
        rows, columns, k = *PIN_GRID, PIN_CANDIDATES
        uv = map_pixel_centres(frame, (rows * k, columns * k))
        samples = AUTO.sample_depth_at(frame, uv)
        order = torch.arange(len(uv), device=uv.device).view(rows, k, columns, k).permute(0, 2, 1, 3).reshape(-1, k * k)
        best = samples.trackability[0][order].argmax(-1, keepdim=True)
        self.places = samples[:, order.gather(1, best)[:, 0]]
        textured = self.places.trackability >= MIN_TRACKABILITY
        textured = textured if background is None else textured & background
        if not bool(textured.any()):
            raise ValueError("CameraPin: found a reference without texture, expected something to follow")
        near = textured & self.places.usable & ((self.places.flag & Flag.DEPTH_EDGE) == 0)
        self.metric = int(near.sum()) >= MIN_METRIC_PLACES
        self.known = near if self.metric else textured  # (1, N) places that are followed
        self.uv = self._leave_out(~self.known)
        self.ray = cam.rays(frame.camera, self.places.uv).double().mT.contiguous()
        xyz = torch.where(near[..., None], self.places.xyz, 1.0).double().mT.contiguous()
        self.points = xyz if self.metric else self.ray  # (1, 3, N)
        f, c = frame.camera.f.double(), frame.camera.c.double()
        self.flow_form = motion_fit.mean_flow_form(self.points, self.known, f, c)
        self.free = 6 if self.metric else 3  # components of an offset
        self.sway = STILL_SWAY_PX**2 * torch.linalg.inv(self.flow_form[:, : self.free, : self.free])
        spacing = frame.hw[0] / rows, frame.hw[1] / columns
        self.overlap = max(1.0, PIN_WINDOW_PX / spacing[0]) * max(1.0, PIN_WINDOW_PX / spacing[1])
        column, row = cam.resize_pixels(self.places.uv[0], frame.hw, PIN_GROUPS).round().long().unbind(-1)
        self.group = row * PIN_GROUPS[1] + column

    def _leave_out(self, mask: Tensor) -> Tensor:
        """Places (1, N, 2) px to track, those of the mask (1, N) outside of the picture, where they cost nothing."""
        return torch.where(mask[..., None], -2.0 * max(self.frame.hw), self.places.uv)

    def _use_capture(self, frames: Frame) -> None:
        """Leave out what moves between the frames; where the camera stood still, take the frames' median."""
        result = self.check(frames.image[1:], frames.camera[1:])
        known = result.verdict != PinVerdict.CANNOT_KNOW
        if not bool(known.any()):
            self.notes.append("the frames of the reference do not agree: only the first is used")
        elif bool(result.moved.any()):
            self.notes.append("the camera moves within the reference: its first frame is the reference")
            self._set_reference(self.frame, result.inlier[known].float().mean(0) >= MIN_BACKGROUND_SHARE)
        else:
            depth = torch.where(frames.depth > 0, frames.depth, torch.nan).nanmedian(0, keepdim=True).values
            image = frames.image.float().median(0, keepdim=True).values.to(frames.image.dtype)
            self._set_reference(self.frame.replace(image=image, depth=depth.nan_to_num(0.0)), None)

    def _check_one(self, picture: Tensor, camera: Camera) -> PinResult:
        """The result (1) of one picture (1, 1, H, W)."""
        n_places = int(self.known.sum())
        tracks, seen, fit = self._search(picture, camera)
        if int(fit.inlier.sum()) < POOR_SHARE * n_places:  # from the motion of the whole picture
            again = self._search(picture, camera, start=coarse_flow)
            if int(again[2].inlier.sum()) > int(fit.inlier.sum()):
                tracks, seen, fit = again
        if int(fit.inlier.sum()) < ENOUGH_SHARE * n_places:  # the others from where the motion predicts them
            start = cam.project(camera, se3.apply(fit.T, seen.xyz.mT).to(picture))
            uv = self._leave_out(fit.inlier | ~self.known)
            hint = TrackHint(pyramid=self.pyramid, start=start, levels=PREDICTED_LEVELS)
            # The valid tracks of the first, else those of the second
            first = _TRACKER(self.picture, picture, uv, hint=hint)
            k = first.valid[..., None]
            cov = torch.where(k[..., None], first.cov, tracks.cov)
            uv_1 = torch.where(k, first.uv_1, tracks.uv_1)
            seen = self._see(tracks.replace(uv_1=uv_1, cov=cov, valid=first.valid | tracks.valid), camera)
            fit = self._fit(seen, fit.T)
        return self._conclude(fit, seen)

    def _see(self, tracks: Tracks, camera: Camera) -> Sightings:
        """Points of the reference with their ideal pixels in the picture."""
        tracks = undistort_tracks(tracks, self.frame.camera, camera)
        used = tracks.valid & self.known
        uv = torch.where(used[..., None], tracks.uv_1.double(), 0.0)
        return Sightings(self.points, uv.mT.contiguous(), used, camera.f.double(), camera.c.double())

    def _search(self, picture: Tensor, camera: Camera, **options: Any) -> tuple[Tracks, Sightings, MotionFit]:
        """Tracks, with options of the tracker, and their motion from a standstill, their median flow, and the best of
        random triples."""
        hint = TrackHint(pyramid=self.pyramid)
        tracks = _TRACKER(self.picture, picture, self.uv, hint=hint, **options)
        seen = self._see(tracks, camera)
        still = se3.identity(1, seen.f)
        starts = [still, motion_fit.rotation_from_flow(seen, self.ray)]
        if self.metric:
            draws = uniform_draws(self.seed, 1, PIN_HYPOTHESES).to(self.places.xyz)
            ideal = tracks.replace(uv_1=seen.uv.mT.to(tracks.uv_1), valid=seen.used)
            searched = pnp_ransac(self.places, ideal, cam.ideal(camera), cam.ideal(camera), draws)
            starts.append(select_batch(searched.ok, searched.T_1_from_0.map(lambda x: x.double()), still))
        return tracks, seen, self._fit(seen, collate(starts))

    def _fit(self, seen: Sightings, starts: Pose, *, zoom: bool = False) -> MotionFit:
        return motion_fit.fit_motion(
            seen, starts, self.group, overlap=self.overlap, rotation_only=not self.metric, zoom=zoom
        )

    def _conclude(self, fit: MotionFit, seen: Sightings) -> PinResult:
        """The offset of a fit with its shift, and the verdict."""
        T, cov, used, inlier, noise = fit.T, fit.cov[:, :6, :6], seen.used, fit.inlier, fit.noise_px
        shift, sigma = motion_fit.scene_flow(T, cov, seen.xyz, self.known, (seen.f, seen.c))
        translates = torch.zeros_like(used[:, 0])
        if self.metric:
            scale = COMMON_DEPTH_ERROR * torch.cat((torch.zeros_like(T.t), T.t), -1)
            cov = cov + scale[:, :, None] * scale[:, None]
        else:
            live, bend = F.pad(seen.plane, (0, 0, 0, 1), value=1.0), motion_fit.FINAL_BEND * noise
            moving, epipolar, on_line = fit_epipolar_motion(seen.xyz, live, used, T.R, seen.f.mean(-1), bend)
            translates = noise > MIN_PARALLAX_RATIO * epipolar.clamp_min(STILL_SWAY_PX)
            T = select_batch(translates, moving, T)
            flow = (seen.uv - (seen.xyz[:, :2] * seen.f[..., None] + seen.c[..., None])).norm(dim=1)
            shift = torch.where(translates, masked_median(flow, on_line)[:, 0], shift)
            sigma, noise = torch.where(translates, epipolar, sigma), torch.where(translates, epipolar, noise)
            inlier = torch.where(translates[:, None], on_line, inlier)
        joint = self._fit(seen, collate([fit.T, se3.identity(1, seen.f)]), zoom=True)
        is_flat = joint.cov[:, 6, 6] == 0  # all depths are equal: singular
        joint = select_batch(is_flat, fit, joint)
        zoomed, unclear = self._tell_zoom(joint, translates & (joint.noise_px <= MIN_PARALLAX_RATIO * sigma))
        noise = torch.where(zoomed, joint.noise_px, noise)
        inlier = torch.where(zoomed[:, None], joint.inlier, inlier)
        free = self.free
        distance = mahalanobis(se3.log(fit.T)[:, :free], cov[:, :free, :free] + self.sway)
        moved = (distance > chi2_quantile(1 - self.false_alarm_rate, free) ** 0.5) | translates
        groups = F.one_hot(self.group).float()  # (N, groups)
        agreeing, placed = ((x.float() @ groups > 0).sum(-1) for x in (inlier, self.known))
        coverage = agreeing / placed.clamp_min(1)
        agreement = inlier.sum(-1) / used.sum(-1).clamp_min(1)
        reason = first_reason(
            (used.sum(-1) < MIN_PIN_INLIERS, PinReason.NO_TRACKS),
            ((inlier.sum(-1) < MIN_PIN_INLIERS) | (agreement < MIN_PIN_AGREEMENT), PinReason.NO_AGREEMENT),
            (noise > MAX_PIN_NOISE_PX, PinReason.NO_AGREEMENT),
            (agreeing < MIN_PIN_GROUPS, PinReason.ONE_PLACE),
            (zoomed, PinReason.ZOOM),
            (~(sigma <= MAX_PIN_SIGMA_PX), PinReason.UNCERTAIN),
            (unclear & moved, PinReason.ZOOM_OR_MOTION),
        )
        answered = reason == PinReason.ANSWERED
        has_zoom = (answered & self.metric) | (reason == PinReason.ZOOM) | (reason == PinReason.ZOOM_OR_MOTION)
        zoom = torch.where(has_zoom & ~is_flat, joint.log_zoom.exp(), torch.nan)
        verdict = torch.where(moved, PinVerdict.MOVED, PinVerdict.NOT_MOVED)
        verdict = torch.where(answered, verdict, PinVerdict.CANNOT_KNOW).int()
        T_ref = se3.invert(T)
        A = se3.adjoint(T_ref)
        cov = A @ cov @ A.mT
        if not self.metric:
            cov = F.pad(cov[:, :3, :3], (0, 3, 0, 3), value=torch.nan)

        def answer(x: Tensor) -> Tensor:
            return torch.where(answered.view(-1, *[1] * (x.dim() - 1)), x, torch.nan)

        return PinResult(
            T_ref_from_live=T_ref.map(answer),
            cov=answer(cov),
            shift_px=answer(shift),
            shift_sigma_px=answer(sigma),
            distance=answer(distance),
            verdict=verdict,
            reason=reason,
            metric=torch.full_like(answered, self.metric),
            flow_form=self.flow_form[:, :6, :6],
            inlier=inlier & answered[:, None],
            agreement=agreement,
            coverage=coverage,
            false_alarm_rate=torch.full_like(shift, self.false_alarm_rate),
            zoom=zoom,
            zoom_sigma=zoom * joint.cov[:, 6, 6].sqrt(),
        )

    def _tell_zoom(self, joint: MotionFit, is_radial: Tensor) -> tuple[Tensor, Tensor]:
        """Fit (1) of motion and focal length -> whether another focal length explains the tracks better than a
        translation, and whether either would: (1) bool each.

        Squared Mahalanobis lengths are what chi-squared rises by where the translation, or the change of focal length,
        is left out; the rotation is free in both. ``is_radial`` (1) bool, without depth: rotation and focal length
        explain what counts as a translation else; a motion towards a wall would, too.
        """
        x = torch.cat((se3.log(joint.T), joint.log_zoom[:, None]), -1)
        cov = joint.cov.clone()
        cov[:, : self.free, : self.free] += self.sway
        cov[:, 6, 6] += STILL_SWAY_PX**2 / self.flow_form[:, 6, 6]

        def rise(first: int, last: int) -> tuple[Tensor, Tensor]:
            square = mahalanobis(x[:, first:last], cov[:, first:last, first:last]) ** 2
            return square, square > chi2_quantile(1 - self.false_alarm_rate, last - first)

        focal, needs_focal = rise(6, 7)
        if not self.metric:
            return torch.zeros_like(is_radial), is_radial & needs_focal
        shift, needs_shift = rise(3, 6)
        _, changed = rise(3, 7)
        unclear = torch.where(joint.cov[:, 6, 6] > 0, changed & ~needs_focal & ~needs_shift, needs_shift)
        return changed & needs_focal & (focal > shift), unclear


#: The tracker: pyramids, then windows with affine motion, gain and bias.
_TRACKER = partial(lucas_kanade_affine, levels=MAP_PYRAMID_LEVELS, track=partial(lucas_kanade, normalise="bias"))
