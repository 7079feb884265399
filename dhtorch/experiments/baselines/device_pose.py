"""Given relative poses (device trajectory, oracle) as a :class:`PoseFit`, for the option ``fit`` of a method."""

import torch

from dhtorch.codes import PoseCode
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose, PoseFit


def known_pose_fit(
    T_1_from_0: Pose,
    n: int,
) -> PoseFit:
    """Relative pose of B pairs → :class:`PoseFit` over ``n`` samples, with zero covariance.

    The pose is taken as exact: covariance, rms and pixel noise are zero and ``t_snr`` infinite; no sample is an
    inlier because none took part. A non-finite pose gets the code TOO_FEW and is not ok.
    """
    R, t = T_1_from_0.R, T_1_from_0.t
    batch = t.shape[0]
    finite = R.isfinite().flatten(1).all(-1) & t.isfinite().all(-1)
    zero = torch.zeros(batch, dtype=t.dtype, device=t.device)
    return PoseFit(
        T_1_from_0=T_1_from_0,
        cov=torch.zeros(batch, 6, 6, dtype=t.dtype, device=t.device),
        inlier=torch.zeros(batch, n, dtype=torch.bool, device=t.device),
        n_inlier=torch.zeros(batch, dtype=torch.int64, device=t.device),
        rms_px=zero,
        sigma_px=zero,
        t_snr=torch.full_like(zero, torch.inf),
        code=torch.where(finite, PoseCode.OK, PoseCode.TOO_FEW).to(torch.int32),
    )


def device_pose_fit(frame_0: Frame, frame_1: Frame, n: int) -> PoseFit:
    """Pose fit of a pair of frames from their stated poses ``T_world_from_cam``.

    Raises:
        ValueError: a frame without ``T_world_from_cam``.
    """
    if frame_0.T_world_from_cam is None or frame_1.T_world_from_cam is None:
        raise ValueError(
            "device_pose_fit: frame.T_world_from_cam is absent, expected the data set's camera-to-world pose"
        )
    T = se3.relative(frame_0.T_world_from_cam, frame_1.T_world_from_cam)
    return known_pose_fit(T.to(frame_0.camera.f.dtype), n)
