"""Sample dict → the same sample with far depth: the whole method as a transform for data loaders."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from dhtorch.codes import Gate, Source
from dhtorch.geometry import camera as cam
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.presets import get_method
from dhtorch.pipeline.spec import iter_networks
from dhtorch.records import NO_HINT, DepthMap, Estimate, MergedDepth, PoseFit, Samples, TrackHint
from dhtorch.transforms import maps, poses
from dhtorch.transforms.sample_access import SampleError, check_sample, get_value, to_tensor
from dhtorch.transforms.sample_spec import SampleSpec, SampleViews
from dhtorch.transforms.status import ProblemCounts, SampleProblem
from dhtorch.transforms.tokens import FIT_MODES, TOKEN_CHANNELS, patch_tokens, token_grid

ON_ERROR_CHOICES = ("raise", "skip", "flag")


class ExtendDepth(torch.nn.Module):
    """Add to each sample what its depth and a second view tell: sparse metric points, the pose, and depth tokens.

    A new dict is returned, other keys untouched. Shapes are fixed by the options and the size of the image, every
    number is finite, and masks say what is meant: so samples collate, and an answer depends neither on the worker nor
    on the batch. Without a second view only the front end runs: the sensor's own returns, flags and hole classes.

    Args:
        method: a name (:data:`dhtorch.pipeline.presets.METHODS`) or a :class:`dhtorch.pipeline.method.Method`.
        n: samples per image; None = the method's own number.
        hint: what is known of the motion between the views, for the tracker.
        seed: of the pose search. With ``index_key`` each sample has the seed ``seed + sample[index_key]``.
        index_key: key of a whole number that tells samples apart; None = the same draws for all.
        dense: True = a map of every pixel as well, with the defaults of :func:`dhtorch.pipeline.dense.complete_depth`;
            a mapping =
            options for it: ``source_views``, ``planes``, ``size``, ``refinements``, ``min_correlation``,
            ``max_sigma_rel``. Sigma and score of swept pixels are calibrated by what travels with the package.
        patch, tokens_hw, fit: the network's patches, see :func:`dhtorch.transforms.patch_tokens`.
        on_error: what to do with a sample that cannot be read, or whose values contradict what was stated. ``raise``;
            ``skip`` = return None, see :func:`dhtorch.transforms.collate_kept`; ``flag`` = add zeros, and ``problem``
            says so. Skipped and flagged samples are counted (:meth:`report`) and warned of.
        batched: True = samples are collated batches, False = single ones. None = single ones, and where a field shows
            a batch (3x3 intrinsics, texts, an index or episode for each picture) it is refused instead of being read
            as frames along time. A batch with a missing key or a wrong shape raises in any case.
        prefix: of the keys that are added.
        **views: where the images, the depth and the intrinsics are, and their units: see
            :class:`dhtorch.transforms.SampleSpec`. ``depth_unit`` must be given.

    Returns:
        The sample and, behind the prefix (N = n, P patches, with B in front of a batch): ``uv`` (N, 2) px;
        ``xyz`` (N, 3) m in the reference view's camera; ``depth``, ``sigma`` (N,) m; ``score`` (N,) in [0, 1];
        ``valid`` (N,) there is a depth; ``source``, ``flag``, ``hole``, ``gate`` (N,) codes of ``dhtorch.codes``;
        ``T_1_from_0`` (4, 4) and its ``pose_cov`` (6, 6), ``pose_ok``, ``pose_code``; with ``pose`` also
        ``pose_convention``, in which of :data:`dhtorch.geometry.pose_conventions.CONVENTIONS` a pose would fit that the
        near returns refute; ``tokens`` (P, 10) of :data:`dhtorch.transforms.TOKEN_CHANNELS` and ``tokens_valid`` (P,);
        ``problem``. What is not valid is 0.

        With ``dense`` also ``depth_map``, ``sigma_map`` (h, w) m, ``score_map`` (h, w) in [0, 1], ``source_map`` and
        ``gate_map`` (h, w) codes, over the field of the picture and of its size unless that is longer than ``size``.
        A silent pixel, NaN in a :class:`dhtorch.records.DepthMap`, is 0 here; where there is no second view the map
        is the sensor's. Tokens are then pooled from all pixels of the map, no longer from the samples; every other key
        is what it is without maps.

    Raises:
        ValueError: options that cannot be.
        SampleError: a bad sample, where ``on_error`` says so.

    Gradient: points, maps, tokens and pose to images, depth and intrinsics, as ``dhtorch.extend`` and
    ``dhtorch.pipeline.dense.complete_depth``; none in a worker, whose samples cannot carry a graph.
    Memory: with ``dense`` that of ``complete``, about a third as much again for tokens.
    Cost: as the method; with ``dense`` most of it is the sweep's. In workers use one thread
    (``worker_init_fn=one_thread``). A process that has used several threads should not be forked: set one thread
    before, or spawn the workers.
    """

    def __init__(
        self,
        *,
        method: str | Method = "paper",
        n: int | None = None,
        hint: TrackHint = NO_HINT,
        seed: int = 0,
        index_key: str | None = None,
        dense: bool | Mapping[str, Any] = False,
        patch: int = 14,
        tokens_hw: tuple[int, int] | None = None,
        fit: str = "stretch",
        on_error: str = "raise",
        batched: bool | None = None,
        prefix: str = "dhtorch.",
        **views: Any,
    ) -> None:
        super().__init__()
        method = get_method(method, n)
        if on_error not in ON_ERROR_CHOICES or (batched and on_error == "skip"):
            expected = ("raise", "flag") if batched else ON_ERROR_CHOICES
            raise ValueError(f"on_error is {on_error!r}, expected one of {', '.join(expected)}")
        if fit not in FIT_MODES:
            raise ValueError(f"fit is {fit!r}, expected one of {', '.join(FIT_MODES)}")
        token_grid((max(patch, 1),) * 2, patch=patch, tokens_hw=tokens_hw)  # raises where no patch fits
        self.views = SampleSpec(**views)
        self.maps = maps.DenseMaps.asked(dense)
        self.method, self.hint = method, hint
        self.learned = torch.nn.ModuleList(iter_networks(self.method))  # so that .to() and .parameters() find them
        self.seed, self.index_key = seed, index_key
        self.patch, self.tokens_hw, self.fit = patch, tokens_hw, fit
        self.on_error, self.batched, self.prefix = on_error, bool(batched), prefix
        self._stated = batched
        self.tally = ProblemCounts()
        self._seen_hw: tuple[int, int] | None = None

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any] | None:
        """The sample with our keys; None where it is skipped."""
        if sample is None and self.on_error == "skip":  # what a data set gives that could not read one
            return self.left_out({}, SampleError("sample: found None, expected a dict with pictures and depth"))
        check_sample(sample, self.views.image, self.views.intrinsics, self._stated)
        with torch.set_grad_enabled(torch.is_grad_enabled() and get_worker_info() is None):
            try:
                read = self.views.read(sample, batched=self.batched)
                seed = self._seeds(sample, len(read.bad))
                flagged = bool(read.complaints) and bool(read.bad.any())
                if flagged and not (self.batched and self.on_error == "flag"):
                    raise SampleError(read.complaint())
            except SampleError as error:
                if self.on_error == "raise" or self.batched:
                    raise
                return self.left_out(sample, error)
            if flagged:
                warnings.warn(f"flagged: {read.complaint()}", stacklevel=2)
            added = self._answer(read, seed, flagged)
        self._counted(added["problem"], read.reference.hw)
        return self._joined(sample, added)

    def report(self) -> dict[str, int]:
        """Number of samples by problem since the transform was made, those of all workers together."""
        return self.tally.report()

    def left_out(self, sample: Mapping[str, Any], error: Exception) -> dict[str, Any] | None:
        """A sample that cannot be read, as ``on_error`` wants it: None, or itself with zeros. Counted and warned of.

        Raises:
            SampleError: it is to be flagged, and nothing tells the size of its image.
        """
        hw = (None if self.maps else self.tokens_hw) or self.views.image_hw(sample) or self._seen_hw
        if self.on_error == "flag" and hw is None:
            missing = "maps" if self.maps else "tokens: give tokens_hw"
            raise SampleError(f"{error} (and no image tells the size of its {missing})") from error
        warnings.warn(f"{'skipped' if self.on_error == 'skip' else 'flagged'}: {error}", stacklevel=3)
        self.tally.add(torch.tensor([SampleProblem.UNREADABLE]))
        return None if self.on_error == "skip" or hw is None else self._joined(sample, self._blank(hw))

    def _answer(self, read: SampleViews, seed: int | Tensor, flagged: bool) -> dict[str, Tensor]:
        frame, paired, bad = read.reference, read.paired, read.bad
        samples, estimate, fits, dense = self._asked(read, seed)
        fit = fits[-1] if fits else None
        found = merge(samples, estimate)
        pooled = (found, samples.hole) if dense is None else maps.map_to_samples(dense, frame, self.method)
        tokens = patch_tokens(*pooled, frame.hw, patch=self.patch, tokens_hw=self.tokens_hw, fit=self.fit)
        xyz = samples.xyz if estimate is None else cam.unproject(frame.camera, found.uv, found.depth)
        xyz = torch.where((found.source != Source.NONE)[..., None], xyz, 0.0)
        gate = None if estimate is None else estimate.gate
        added = _sample_keys(
            found, tokens, xyz=xyz, flag=samples.flag, hole=samples.hole, gate=gate, fit=fit, paired=paired
        )
        added |= (
            {} if self.views.pose is None else poses.refuted_pose_keys(fits, paired, poses.pose_label(self.views.pose))
        )
        added |= {} if dense is None else maps.map_to_keys(dense)
        if flagged:
            added = {key: x.masked_fill(bad.view(-1, *[1] * (x.ndim - 1)), 0) for key, x in added.items()}
        problem = torch.tensor(_problem_codes(read, flagged), dtype=torch.int32, device=xyz.device)
        return {**added, "problem": problem}

    def _asked(
        self, read: SampleViews, seed: int | Tensor
    ) -> tuple[Samples, Estimate | None, list[PoseFit], DepthMap | None]:
        """What the method says, and of which views' poses, the last of which stands for all, and the maps where they
        are wanted; the front end alone, and no estimate, where nothing is paired."""
        if read.other is None or not bool(read.paired.any()):
            samples = self.method.sample_depth(read.reference)
            dense = None if self.maps is None else self.maps.sensed(read.reference, self.method)
            return samples, None, [], dense
        trace: dict[str, Any] = {}
        told: dict[str, Any] = {"seed": seed, "hint": self.hint, "trace": trace}
        told |= {} if read.given is None else {"fit": read.given}
        if self.maps is None:
            dense = None
            estimate = self.method(read.reference, read.other, **told)
        else:
            dense = self.maps.swept(read, self.method, **told)
            estimate = trace["sparse"]
        estimate = estimate.replace(gate=torch.where(read.paired[:, None], estimate.gate, Gate.NO_TRACK))
        return trace["samples"], estimate, [view["fit"] for view in trace.get("views", [trace])], dense

    def _seeds(self, sample: Mapping[str, Any], batch: int) -> int | Tensor:
        if self.index_key is None:
            return self.seed
        index = to_tensor(get_value(sample, self.index_key), self.index_key).flatten()
        if index.shape[0] != batch or index.is_floating_point():
            expected = f"{batch} whole numbers"
            raise SampleError(
                f"{self.index_key}: found {index.dtype} of shape {tuple(index.shape)}, expected {expected}"
            )
        return index.long().cpu() + self.seed

    def _blank(self, hw: tuple[int, int]) -> dict[str, Tensor]:
        """What is added to a sample that cannot be read: zeros of the usual shapes."""
        rows, columns = token_grid(hw, patch=self.patch, tokens_hw=self.tokens_hw)
        n, p = self.method.n, rows * columns
        sizes = {"uv": (n, 2), "xyz": (n, 3), "depth": (n,), "sigma": (n,), "score": (n,), "T_1_from_0": (4, 4)}
        sizes |= {"pose_cov": (6, 6), "tokens": (p, len(TOKEN_CHANNELS))}
        out = {key: torch.zeros(1, *size) for key, size in sizes.items()}
        for key, size in {"valid": (n,), "pose_ok": (), "tokens_valid": (p,)}.items():
            out[key] = torch.zeros(1, *size, dtype=torch.bool)
        for key, size in {"source": (n,), "flag": (n,), "hole": (n,), "gate": (n,), "pose_code": ()}.items():
            out[key] = torch.zeros(1, *size, dtype=torch.int32)
        if self.views.pose is not None:
            out["pose_convention"] = torch.zeros(1, dtype=torch.int32)
        if self.maps is not None:
            size = self.maps.hw(hw)
            out |= {key: torch.zeros(1, *size) for key in maps.MAP_NUMBER_KEYS}
            out |= {key: torch.zeros(1, *size, dtype=torch.int32) for key in maps.MAP_CODE_KEYS}
        return {**out, "problem": torch.full((1,), SampleProblem.UNREADABLE, dtype=torch.int32)}

    def _counted(self, problem: Tensor, hw: tuple[int, int]) -> None:
        self.tally.add(problem)
        if self._seen_hw != hw:  # torch looks twice at what a module is given
            self._seen_hw = hw

    def _joined(self, sample: Mapping[str, Any], added: Mapping[str, Tensor]) -> dict[str, Any]:
        # Copies of their own: a row of a shared table would be sent to the main process with the whole table.
        mine = {self.prefix + key: x if self.batched else x[0].contiguous() for key, x in added.items()}
        return {**sample, **mine}


def _problem_codes(read: SampleViews, flagged: bool) -> list[int]:
    """The code of each sample; few numbers, of which torch would make several operations."""
    bad = read.bad.tolist() if flagged else [False] * len(read.bad)

    def code(bad: bool, sensed: bool, paired: bool) -> int:
        if bad:
            return SampleProblem.UNREADABLE
        if not sensed:
            return SampleProblem.NO_DEPTH
        return SampleProblem.NONE if paired else SampleProblem.NO_SECOND_VIEW

    return list(map(code, bad, read.sensed.tolist(), read.paired.tolist()))


def _sample_keys(
    found: MergedDepth,
    tokens: tuple[Tensor, Tensor],
    *,
    xyz: Tensor,
    flag: Tensor,
    hole: Tensor,
    gate: Tensor | None,
    fit: PoseFit | None,
    paired: Tensor,
) -> dict[str, Tensor]:
    """Keys of what was found; without an estimate nothing was tracked."""
    return {
        "uv": found.uv,
        "xyz": xyz,
        "depth": found.depth,
        "sigma": found.sigma,
        "score": found.score,
        "valid": found.source != Source.NONE,
        "source": found.source,
        "flag": flag,
        "hole": hole,
        "gate": torch.full_like(hole, Gate.NO_TRACK) if gate is None else gate,
        **_pose_keys(fit, paired, found.depth),
        "tokens": tokens[0],
        "tokens_valid": tokens[1],
    }


def _pose_keys(fit: PoseFit | None, paired: Tensor, like: Tensor) -> dict[str, Tensor]:
    B = paired.shape[0]
    if fit is None:
        code = torch.zeros(B, dtype=torch.int32, device=like.device)
        blank = {"T_1_from_0": like.new_zeros(B, 4, 4), "pose_cov": like.new_zeros(B, 6, 6)}
        return {**blank, "pose_ok": torch.zeros_like(paired), "pose_code": code}
    ok = fit.ok & paired
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=like.dtype, device=like.device).expand(B, 1, 4)
    top = torch.cat((fit.T_1_from_0.R, fit.T_1_from_0.t[..., None]), -1)
    T = torch.where(ok[:, None, None], torch.cat((top, last), 1), 0.0)
    cov = torch.where(ok[:, None, None], fit.cov, 0.0)
    code = torch.where(paired, fit.code, torch.zeros_like(fit.code))
    return {"T_1_from_0": T, "pose_cov": cov, "pose_ok": ok, "pose_code": code}
