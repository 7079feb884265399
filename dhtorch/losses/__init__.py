"""Losses for training on recovered depths and through the stages: depth with a sigma, pixels with a covariance."""

from dhtorch.losses.risk_coverage import risk_coverage_loss
from dhtorch.losses.weighted import reprojection_loss, sigma_weighted_depth_loss

__all__ = ["reprojection_loss", "risk_coverage_loss", "sigma_weighted_depth_loss"]
