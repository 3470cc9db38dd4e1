import os
import subprocess
import sys
import warnings
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import stereokit.registry
from stereokit import ConfigError, list_components, list_models
from stereokit.registry import COSTS, MODELS, Registry, suggest

names = st.text("abcdefgh_0123456789", min_size=1, max_size=8)


@pytest.fixture
def shapes():
    registry = Registry("shapes", kind="shape")

    @registry.register("disc")
    class Disc:
        def __init__(self, radius=1.0, *, filled=False):
            self.radius, self.filled = radius, filled

    @registry.register("box")
    def box(width, height=2):
        return width, height

    return registry


@given(st.lists(names, unique=True), names)
def test_what_is_registered_is_found(known, other):
    registry = Registry("things", kind="thing")
    for name in known:
        registry.register(name)(lambda name=name: name)
    assert registry.names() == sorted(known)
    assert [registry.build(name, {}) for name in known] == known
    assert (other in registry) == (other in known)


def test_the_decorator_gives_back_what_it_decorates(shapes):
    def disc():
        return "another"

    assert shapes.register("another")(disc) is disc


@pytest.mark.parametrize(
    ("pattern", "matches"),
    [("*", ["box", "disc"]), ("b*", ["box"]), ("?is[ck]", ["disc"]), ("disc", ["disc"]), ("x*", [])],
)
def test_names_match_wildcards(shapes, pattern, matches):
    assert shapes.names(pattern) == matches


def test_unknown_names_are_answered_with_near_ones(shapes):
    with pytest.raises(ConfigError, match=r"unknown shape 'disk'; did you mean 'disc'\? Known: box, disc"):
        shapes.get("disk")
    with pytest.raises(ConfigError, match=r"unknown shape 'zzzzz'; Known: box, disc$"):
        shapes.build("zzzzz", {})


def test_suggestions():
    assert suggest("a", []) == "Known: none"
    assert suggest("coex2", ["coex", "coex_s"]).startswith("did you mean 'coex' or 'coex_s'? ")


def test_a_second_registration_is_refused(shapes):
    with pytest.raises(
        ConfigError, match=r"shape 'disc' is already registered, by .*test_registry.*Disc.*override=True"
    ):
        shapes.register("disc")(lambda: None)
    assert shapes.build("disc", {}).radius == 1


def test_override_replaces(shapes):
    shapes.register("disc", override=True)(lambda: "new")
    assert shapes.build("disc", {}) == "new"
    assert shapes.names() == ["box", "disc"]


def test_build_takes_the_offers_that_the_component_names(shapes):
    disc = shapes.build("disc", {"filled": True}, offered={"radius": 3, "color": "red"})
    assert (disc.radius, disc.filled) == (3, True)
    assert shapes.build("box", {"width": 5}, offered={"width": 1, "height": 7}) == (5, 7)


def test_unknown_arguments_are_refused(shapes):
    with pytest.raises(ConfigError, match=r"shape 'disc' takes no argument 'radios'; did you mean 'radius'\?"):
        shapes.build("disc", {"radios": 1})
    with pytest.raises(ConfigError, match=r"shape 'disc' takes no argument 'radios'"):
        shapes.resolve("disc", {"radios": 1}, {})


def test_missing_arguments_are_named(shapes):
    with pytest.raises(ConfigError, match="shape 'box' needs the argument width"):
        shapes.build("box", {})


def test_arguments_may_be_open(shapes):
    shapes.register("any")(lambda *args, **arguments: arguments)
    assert shapes.build("any", {"a": 1}, offered={"b": 2}) == {"a": 1}


@pytest.mark.parametrize("kind", [ValueError, TypeError])
def test_what_a_constructor_chokes_on_is_named(shapes, kind):
    @shapes.register("brittle")
    def brittle(size):
        raise kind("not that one")

    with pytest.raises(ConfigError, match=r"shape 'brittle' can't be built with size=\[1\]: not that one") as error:
        shapes.build("brittle", {"size": [1]})
    assert isinstance(error.value.__cause__, kind)


def test_errors_of_our_own_pass_as_they_are(shapes):
    own = ConfigError("plain words")

    @shapes.register("strict")
    def strict():
        raise own

    with pytest.raises(ConfigError) as error:
        shapes.build("strict", {})
    assert error.value is own


def test_resolved_arguments_are_complete_but_for_the_offered(shapes):
    assert shapes.resolve("disc", {"radius": 2.0}, offered={}) == {"radius": 2.0, "filled": False}
    assert shapes.resolve("disc", {}, offered={"radius": None}) == {"filled": False}
    assert shapes.resolve("disc", {"radius": 3}, offered={"radius": None}) == {"radius": 3, "filled": False}


def test_a_registry_shows_its_names(shapes):
    assert repr(shapes) == "Registry('shapes': disc, box)"


@pytest.mark.parametrize(
    ("slot", "components"),
    [
        ("backbones", ["residual", "spatial_pyramid", "unet"]),
        ("costs", ["concatenation", "correlation", "groupwise_correlation"]),
        ("guidance", ["addition", "gce", "neighborhood", "none"]),
        ("aggregations", ["encoder_decoder", "hourglass", "stacked_hourglass"]),
        ("regressions", ["soft_argmin", "top_k"]),
        ("upsamplers", ["bilinear", "none", "superpixel", "trilinear"]),
        ("models", ["coex", "gcnet", "psmnet"]),
    ],
)
def test_every_slot_lists_what_the_paper_needs(slot, components):
    assert set(components) <= set(list_components(slot))


def test_wildcards_reach_the_public_lists():
    assert list_models("psm*") == ["psmnet"]
    assert list_models() == list_components("models")
    assert list_components("costs", "con*") == ["concatenation"]


def test_unknown_slots_are_refused():
    with pytest.raises(ConfigError, match=r"unknown slot 'cost'; did you mean 'costs'"):
        list_components("cost")


class Entry(SimpleNamespace):
    """An entry point that runs a function when it is loaded."""

    def load(self):
        return self.run()


@pytest.fixture
def plugins(monkeypatch):
    """Installs plugins, which have not been loaded so far; what they register is forgotten afterwards."""
    for registry in (COSTS, MODELS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))

    def install(**entries):
        def entry_points(group):
            assert group == "stereokit.plugins"
            return [Entry(name=name, value=f"{name}.module", run=run) for name, run in entries.items()]

        monkeypatch.setattr(stereokit.registry, "entry_points", entry_points)
        monkeypatch.setattr(stereokit.registry, "_plugins_loaded", False)

    return install


def register_mine():
    COSTS.register("mine")(lambda: "my cost")


@pytest.mark.parametrize(
    "read",
    [
        lambda: list_components("costs"),
        lambda: COSTS.build("mine", {}),
        lambda: COSTS.get("mine"),
        lambda: "mine" in COSTS,
    ],
)
def test_plugins_are_loaded_when_first_needed(plugins, read):
    plugins(mine=register_mine)
    assert "mine" not in COSTS._factories
    read()
    assert COSTS.build("mine", {}) == "my cost"


def test_plugins_are_loaded_once(plugins):
    loads = []
    plugins(mine=lambda: loads.append(1))
    for _ in range(3):
        list_models()
    assert loads == [1]


def test_a_plugin_may_read_the_registries(plugins):
    plugins(mine=lambda: MODELS.register("mine")(lambda: MODELS.names()))
    assert "mine" in list_models()


def broken():
    raise ImportError("no module named 'left_out'")


def test_a_broken_plugin_is_a_warning_that_names_it(plugins):
    plugins(bad=broken, mine=register_mine)
    with pytest.warns(
        UserWarning, match=r"plugin 'bad' \(bad\.module\) could not be loaded .* ImportError: .*left_out"
    ):
        assert "mine" in list_components("costs")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "correlation" in list_components("costs")


def test_a_plugin_that_takes_a_name_is_a_warning(plugins):
    plugins(thief=lambda: COSTS.register("correlation")(lambda: None))
    with pytest.warns(UserWarning, match="plugin 'thief' .* 'correlation' is already registered"):
        list_components("costs")
    assert COSTS.get("correlation").__name__ == "CorrelationVolume"


@pytest.mark.slow
def test_an_installed_package_adds_a_component(tmp_path):
    (tmp_path / "elsewhere.py").write_text(
        "from stereokit.costs import CorrelationVolume\n"
        "from stereokit.registry import COSTS\n"
        "@COSTS.register('elsewhere')\n"
        "class Elsewhere(CorrelationVolume):\n"
        "    pass\n"
    )
    info = tmp_path / "elsewhere-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[stereokit.plugins]\nelsewhere = elsewhere\n")
    program = "import stereokit; print(type(stereokit.build_model('coex', cost='elsewhere').cost).__module__)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    result = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert result.stdout == "elsewhere\n", result.stderr
