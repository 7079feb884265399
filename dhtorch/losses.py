"""The losses of :mod:`dhtorch.functional` under their former name, for one release."""

from dhtorch.functional import reprojection_loss, risk_coverage_loss, sigma_weighted_depth_loss

__all__ = ["reprojection_loss", "risk_coverage_loss", "sigma_weighted_depth_loss"]
