import re
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit import ConfigError
from stereokit.checks import check_interface, check_max_disparity, check_network, input_multiple
from stereokit.contracts import FeatureInfo

INFO = FeatureInfo(matching_channels={4: 32}, guide_channels={2: 8, 4: 32})


def block(kind, **attributes):
    """A block of a given class name, with these attributes."""
    return type(kind, (SimpleNamespace,), {})(**attributes)


def blocks(**changes):
    """A network that fits, but for the changes: attributes as slot__attribute."""
    attributes = {
        "backbone": {"info": INFO, "multiple": 4},
        "candidates": {"planes": 16, "spacing": 4.0, "fixed": True},
        "cost": {"in_channels": 32, "out_channels": 1, "planes": 16, "warps": True},
        "aggregation": {
            "in_channels": 1,
            "guide_channels": {4: 32, 8: 32},
            "multiple": 4,
            "planes_multiple": 4,
            "upscale": 1,
            "loss_weights": (1.0,),
        },
        "regression": {"min_levels": 16, "with_confidence": None},
        "upsampler": {"scale": 4, "domain": "disparity", "learned": True, "guide_channels": {2: 8, 4: 32}},
    }
    for change, value in changes.items():
        slot, attribute = change.split("__")
        attributes[slot][attribute] = value
    kinds = {
        "backbone": "Eyes",
        "candidates": "Menu",
        "cost": "Price",
        "aggregation": "Sum",
        "regression": "Choice",
        "upsampler": "Lens",
    }
    return {slot: block(kinds[slot], **given) for slot, given in attributes.items()}


def check(chosen, refinements=(), *, stride=4, max_disparity=64):
    """Holds a network of one stage to its contracts."""
    given = {slot: block for slot, block in chosen.items() if slot != "backbone"}
    stage = SimpleNamespace(stride=stride, coarser_costs=[], **given)
    check_network(backbone=chosen["backbone"], stages=[stage], refinements=refinements, max_disparity=max_disparity)


def test_what_fits_passes():
    check(blocks())
    check(blocks(upsampler__domain="volume", regression__min_levels=64))
    check(blocks(aggregation__upscale=2, upsampler__scale=2, regression__min_levels=32))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cost__in_channels": 31}, ["backbone Eyes", "cost Price", "32", "31"]),
        ({"cost__planes": 24}, ["cost Price", "backbone Eyes", "24", "16"]),
        ({"aggregation__in_channels": 7}, ["cost Price", "aggregation Sum", "1", "7"]),
        ({"aggregation__guide_channels": {4: 33}}, ["backbone Eyes", "aggregation Sum", "stride 4", "32", "33"]),
        ({"aggregation__guide_channels": {32: 16}}, ["backbone Eyes", "aggregation Sum", "stride 32", "32", "16"]),
        ({"aggregation__guide_channels": {1: 5}}, ["backbone Eyes", "aggregation Sum", "stride 1", "3", "5"]),
        ({"aggregation__guide_channels": {6: 5}}, ["backbone Eyes", "aggregation Sum", "stride 6", "None", "5"]),
        ({"candidates__fixed": False, "cost__warps": False}, ["candidates Menu", "cost Price", "can't warp"]),
        (
            {"candidates__fixed": False, "aggregation__planes_multiple": 3},
            ["candidates Menu", "aggregation Sum", "16", "3"],
        ),
        ({"aggregation__upscale": 3}, ["aggregation Sum", "backbone Eyes", "3", "4"]),
        ({"aggregation__upscale": 2}, ["aggregation Sum", "upsampler Lens", "2", "4"]),
        ({"upsampler__scale": 8}, ["aggregation Sum", "upsampler Lens", "4", "8"]),
        ({"upsampler__guide_channels": {2: 9}}, ["backbone Eyes", "upsampler Lens", "stride 2", "8", "9"]),
        ({"regression__min_levels": 17}, ["regression Choice", "aggregation Sum", "17", "16", "use k from 1 to 16"]),
        (
            {"regression__min_levels": 65, "upsampler__domain": "volume"},
            ["regression Choice", "aggregation Sum", "65", "64", "use k from 1 to 64"],
        ),
        ({"aggregation__planes_multiple": 5}, ["backbone Eyes", "aggregation Sum", "64", "20", "use 60 or 80"]),
    ],
)
def test_an_error_names_both_blocks_and_both_numbers(changes, words):
    with pytest.raises(ConfigError) as error:
        check(blocks(**changes))
    for word in words:
        assert re.search(rf"\b{word}\b", str(error.value)), word


@pytest.mark.parametrize(
    ("slot", "attribute", "protocol"),
    [
        ("backbone", "info", "Backbone"),
        ("candidates", "fixed", "Sampler"),
        ("cost", "planes", "Cost"),
        ("aggregation", "upscale", "Aggregation"),
        ("regression", "with_confidence", "Regression"),
        ("upsampler", "domain", "Upsampler"),
    ],
)
def test_what_a_block_lacks_is_named(slot, attribute, protocol):
    chosen = blocks()
    delattr(chosen[slot], attribute)
    expected = f"{slot} {type(chosen[slot]).__name__} lacks {attribute}; see stereokit.contracts.{protocol}"
    with pytest.raises(ConfigError, match=re.escape(expected)):
        check(chosen)
    with pytest.raises(ConfigError, match=re.escape(expected)):
        check_interface(slot, chosen[slot])


def test_coarser_guides_are_averaged_from_the_coarsest():
    assert [INFO.channels_at(s) for s in (1, 2, 4, 8, 12, 32)] == [3, 8, 32, 32, 32, 32]
    assert INFO.coarsest_guide == 4
    assert FeatureInfo({3: 1}, {3: 7}).channels_at(5) is None


@given(st.integers(-100, 2000), st.integers(1, 100))
def test_max_disparity_is_a_multiple_and_the_error_names_some(max_disparity, multiple):
    if max_disparity > 0 and max_disparity % multiple == 0:
        check_max_disparity(max_disparity, multiple, "blocks")
        return
    with pytest.raises(ConfigError) as error:
        check_max_disparity(max_disparity, multiple, "these blocks")
    message = str(error.value)
    assert f"max_disparity {max_disparity} is not a positive multiple of {multiple}, which these blocks need" in message
    offers = [int(d) for d in re.findall(r"\d+", message.split(";")[1])]
    assert offers
    for offer in offers:
        check_max_disparity(offer, multiple, "blocks")
        assert abs(offer - max(max_disparity, 0)) <= multiple


@pytest.mark.parametrize("value", [True, 64.0, "64", None])
def test_max_disparity_is_a_whole_number(value):
    with pytest.raises(ConfigError, match="whole number of pixels"):
        check_max_disparity(value, 4, "blocks")


def refinement(stride, **guide_channels):
    guides = {int(s[1:]): channels for s, channels in guide_channels.items()}
    return block("Brush", stride=stride, guide_channels=guides, loss_weight=1.0)


def test_refinements_go_on_from_where_the_upsampler_ends():
    check(blocks(), [refinement(1), refinement(1, s2=8)])
    check(blocks(upsampler__scale=2), [refinement(2), refinement(1)])
    check(blocks(upsampler__scale=1), [refinement(2), refinement(1)])


@pytest.mark.parametrize(
    ("changes", "refinements", "words"),
    [
        ({}, [refinement(2)], ["refinement Brush", "stride 2", "stride 1"]),
        ({"upsampler__scale": 1}, [refinement(3)], ["refinement Brush", "ends at stride 3"]),
        ({"upsampler__scale": 1}, [refinement(2)], ["refinement Brush", "ends at stride 2"]),
        ({"upsampler__scale": 2}, [], ["aggregation Sum", "upsampler Lens", "4", "2"]),
        ({}, [refinement(1, s2=9)], ["backbone Eyes", "refinement Brush", "stride 2", "8", "9"]),
        ({}, [block("Brush", stride=1)], ["refinement Brush lacks guide_channels, loss_weight"]),
    ],
)
def test_refinements_that_nothing_reaches_are_refused(changes, refinements, words):
    with pytest.raises(ConfigError) as error:
        check(blocks(**changes), refinements)
    for word in words:
        assert word in str(error.value)


def test_stages_compare_maps_that_there_are():
    with pytest.raises(ConfigError, match="backbone Eyes has no matching features at stride 2; use 4"):
        check(blocks(), stride=2)


def test_every_stride_divides_the_input():
    chosen = blocks(backbone__multiple=6, aggregation__multiple=4, aggregation__guide_channels={4: 32, 32: 32})
    stage = SimpleNamespace(stride=4, **{slot: chosen[slot] for slot in ("aggregation", "regression", "upsampler")})
    assert input_multiple(chosen["backbone"], [stage]) == 96
    assert input_multiple(chosen["backbone"], [stage], [refinement(1, s5=3)]) == 480
