"""Validation of depth maps against near returns, triangulated points and source views."""

from dhtorch.validation.faults import Diagnosis, diagnose
from dhtorch.validation.options import ValidationOptions
from dhtorch.validation.validate import QUICK_METHOD, validate_against, validate_depth

__all__ = ["QUICK_METHOD", "Diagnosis", "ValidationOptions", "diagnose", "validate_against", "validate_depth"]
