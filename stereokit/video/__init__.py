"""Stereo videos and cameras: frames of both views, from files, folders, cameras and streams.

PyAV (the extra `video`) reads and writes files and streams, because it knows timestamps, 16-bit FFV1, damaged frames
and timeouts, of which OpenCV's reader tells nothing. Cameras are OpenCV's, which knows those of all systems.
"""

from stereokit.video.frames import StereoFrame
from stereokit.video.layout import Layout
from stereokit.video.places import VIDEO_SUFFIXES, is_video
from stereokit.video.stereo import StereoVideo, open_stereo_video

__all__ = ["VIDEO_SUFFIXES", "Layout", "StereoFrame", "StereoVideo", "is_video", "open_stereo_video"]
