"""Changes of the mean of a series: their places, and medians that leave out single outliers."""

import torch

from dhtorch.metrics.change_points import mean_changes, median_of_three


def test_changes_are_found_up_to_the_last_two_values():
    level = torch.tensor([0.0] * 6 + [9.0] * 6 + [0.0] * 2)
    series = torch.stack((level, torch.zeros(14)))
    assert mean_changes(series, 10.0) == [(0, 6, 14), (6, 12, 14)]
    assert mean_changes(torch.zeros(2, 14), 10.0) == [] == mean_changes(series[:, :3], 10.0)


def test_a_single_outlier_disappears_and_a_lasting_change_stays():
    x = torch.tensor([[0.0, 0, 7, 0, 0, 5, 5, 5]])
    assert median_of_three(x).tolist() == [[0.0, 0, 0, 0, 0, 5, 5, 5]]
