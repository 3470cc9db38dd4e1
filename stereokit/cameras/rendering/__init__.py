"""Rendered rigs: what two cameras of known lenses and pose see of boards and of textured planes, with true depth."""

from stereokit.cameras.rendering.examples import board_plane, board_poses, example_rig, example_scene
from stereokit.cameras.rendering.planes import Plane, hit
from stereokit.cameras.rendering.renderer import RigRenderer, rectified_depth

__all__ = [
    "Plane",
    "RigRenderer",
    "board_plane",
    "board_poses",
    "example_rig",
    "example_scene",
    "hit",
    "rectified_depth",
]
