import torch
from torch import nn

from stereokit.optimize.convolution import FusedConvolution
from stereokit.optimize.fusion import find_chains, fuse


class Net(nn.Module):
    def __init__(self, forward, **modules):
        super().__init__()
        self.run = forward
        for name, module in modules.items():
            self.add_module(name, module)

    def forward(self, x):
        return self.run(self, x)


def chains(net):
    """Path of the convolution to those of the norm and the activation."""
    found = find_chains(net.eval(), lambda net: net(torch.rand(1, 2, 4, 4)))
    return {chain.conv: (chain.norm, chain.activation) for chain in found}


def layers(**more):
    return {"conv": nn.Conv2d(2, 2, 1), "norm": nn.BatchNorm2d(2), "act": nn.ReLU(), **more}


def test_a_row_of_layers_is_one():
    assert chains(Net(lambda net, x: net.act(net.norm(net.conv(x))), **layers())) == {"conv": ("norm", "act")}


def test_layers_by_function_stay():
    assert chains(Net(lambda net, x: net.norm(net.conv(x).relu()), **layers())) == {"conv": (None, None)}
    assert chains(Net(lambda net, x: net.norm(net.conv(x)).relu(), **layers())) == {"conv": ("norm", None)}


def test_an_output_that_is_read_twice_stays():
    assert chains(Net(lambda net, x: net.norm(y := net.conv(x)) + y, **layers())) == {"conv": (None, None)}
    assert chains(Net(lambda net, x: net.act(y := net.norm(net.conv(x))) + y, **layers())) == {"conv": ("norm", None)}
    assert chains(Net(lambda net, x: (net.norm(y := net.conv(x)), y), **layers())) == {"conv": (None, None)}


def test_an_activation_in_place_may_be_read_again():
    act = nn.ReLU(inplace=True)

    def forward(net, x):
        y = net.norm(net.conv(x))
        return net.act(y) + y

    assert chains(Net(forward, **layers(act=act))) == {"conv": ("norm", "act")}

    def reads_before(net, x):
        y = net.norm(net.conv(x))
        z = y.exp()
        return net.act(y) + z

    assert chains(Net(reads_before, **layers(act=act))) == {"conv": ("norm", None)}


def test_shared_layers_are_fused_if_they_always_meet():
    def both(net, x):
        return net.act(net.norm(net.conv(x))) + net.act(net.norm(net.conv(-x)))

    assert chains(Net(both, **layers())) == {"conv": ("norm", "act")}

    def one_without(net, x):
        return net.act(net.norm(net.conv(x))) + net.conv(-x)

    assert chains(Net(one_without, **layers())) == {"conv": (None, None)}

    def norm_of_two(net, x):
        return net.norm(net.conv(x)) + net.norm(x)

    assert chains(Net(norm_of_two, **layers())) == {"conv": (None, None)}

    def activation_of_two(net, x):
        return net.act(net.norm(net.conv(x))) + net.act(x)

    assert chains(Net(activation_of_two, **layers())) == {"conv": ("norm", None)}


def test_weights_that_others_read_stay():
    def forward(net, x):
        return net.norm(net.conv(x)) + nn.functional.conv2d(x, net.conv.weight)

    assert chains(Net(forward, **layers())) == {}

    def reads_the_norm(net, x):
        return net.norm(net.conv(x)) + net.norm.weight.sum()

    assert chains(Net(reads_the_norm, **layers())) == {"conv": (None, None)}


def test_norms_without_statistics_stay():
    norm = nn.BatchNorm2d(2, track_running_stats=False)
    assert chains(Net(lambda net, x: net.norm(net.conv(x)), **layers(norm=norm))) == {"conv": (None, None)}
    norm = nn.GroupNorm(1, 2)
    assert chains(Net(lambda net, x: net.norm(net.conv(x)), **layers(norm=norm))) == {"conv": (None, None)}


def test_layers_with_hooks_stay():
    net = Net(lambda net, x: net.act(net.norm(net.conv(x))), **layers())
    seen = []
    net.norm.register_forward_hook(lambda *arguments: seen.append(1))
    assert chains(net) == {"conv": (None, None)}
    assert seen == [1]
    net.conv.register_forward_pre_hook(lambda *arguments: None)
    assert chains(net) == {}


def test_layers_that_are_not_called_stay():
    net = Net(lambda net, x: net.act(net.norm(net.conv(x))), unused=nn.Conv2d(2, 2, 1), **layers())
    assert chains(net) == {"conv": ("norm", "act")}


def test_a_layer_of_two_names_is_replaced_under_both():
    conv = nn.Conv2d(2, 2, 1)
    net = Net(lambda net, x: net.conv(x) + net.twin(-x), conv=conv, twin=conv).eval()
    x = torch.rand(1, 2, 4, 4)
    expected = net(x)
    fuse(net, find_chains(net, lambda net: net(x)))
    assert net.conv is net.twin
    assert isinstance(net.conv, FusedConvolution)
    torch.testing.assert_close(net(x), expected)


def test_no_hooks_are_left_behind():
    net = Net(lambda net, x: net.act(net.norm(net.conv(x))), **layers())
    chains(net)
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in net.modules())


def test_layers_called_by_another_way_than_their_names_are_fused_too():
    net = Net(lambda net, x: net.rows[1](net.rows[0](x)), conv=nn.Conv2d(2, 2, 1), norm=nn.BatchNorm2d(2)).eval()
    net.norm.running_mean.uniform_(1, 2)
    net.rows = [net.conv, net.norm]
    x = torch.rand(1, 2, 4, 4)
    expected = net(x)
    fuse(net, find_chains(net, lambda net: net(x)))
    assert isinstance(net.rows[0], FusedConvolution)
    torch.testing.assert_close(net(x), expected)
