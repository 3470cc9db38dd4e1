import torch
from torch import nn
from torch.testing import assert_close

from stereokit.costs.projection import Projection


def test_without_widths_the_features_stay():
    left, right = torch.rand(2, 1, 4, 3, 5)
    projection = Projection(4, None)
    assert projection.out_channels == 4
    out_left, out_right = projection(left, right)
    assert out_left is left
    assert out_right is right


def test_both_views_pass_the_same_layers():
    projection = Projection(4, (6, 5)).eval()
    left, right = torch.rand(2, 2, 4, 3, 7)
    out_left, out_right = projection(left, right)
    assert out_left.shape == out_right.shape == (2, 5, 3, 7)
    assert_close(out_left, projection.layers(left))
    assert_close(out_right, projection.layers(right))


def test_the_second_layer_is_plain():
    kinds = [type(m) for m in Projection(4, (6, 5)).modules() if not list(m.children())]
    assert kinds == [nn.Conv2d, nn.BatchNorm2d, nn.LeakyReLU, nn.Conv2d]


def test_norm_statistics_come_from_both_views():
    projection = Projection(1, (1, 1))
    left, right = torch.rand(1, 1, 3, 7), torch.rand(1, 1, 3, 7) + 5
    conv, norm = projection.layers[0][0], projection.layers[0][1]
    projection(left, right)
    assert_close(norm.running_mean, 0.1 * conv(torch.cat((left, right))).mean().reshape(1))


def test_the_last_convolution_may_be_larger():
    projection = Projection(4, {"widths": [6, 5], "last_kernel": 3, "bias": False})
    assert [tuple(layer.weight.shape) for layer in projection.layers[1:]] == [(5, 6, 3, 3)]
    left, right = projection(*torch.rand(2, 1, 4, 3, 7))
    assert left.shape == right.shape == (1, 5, 3, 7)
