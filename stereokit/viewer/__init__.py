"""Pairs, results and videos in the browser: a page that this machine serves, or one file that holds all of it."""

from stereokit.viewer.desk import Desk
from stereokit.viewer.server import ViewServer
from stereokit.viewer.shot import Shot
from stereokit.viewer.sources import Album, Frames
from stereokit.viewer.standalone import write_page

__all__ = ["Album", "Desk", "Frames", "Shot", "ViewServer", "write_page"]
