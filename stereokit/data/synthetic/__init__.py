"""Synthetic stereo: scenes rendered by exact geometry, with ground truth and occlusion masks for both views."""

from stereokit.data.synthetic.composition import Composition
from stereokit.data.synthetic.dataset import SyntheticScenes
from stereokit.data.synthetic.photometry import Cameras
from stereokit.data.synthetic.render import RenderedView, render_view
from stereokit.data.synthetic.scene import Layer, Scene
from stereokit.data.synthetic.surfaces import Surface, Wave
from stereokit.data.synthetic.textures import Texture, TextureBank

__all__ = [
    "Cameras",
    "Composition",
    "Layer",
    "RenderedView",
    "Scene",
    "Surface",
    "SyntheticScenes",
    "Texture",
    "TextureBank",
    "Wave",
    "render_view",
]
