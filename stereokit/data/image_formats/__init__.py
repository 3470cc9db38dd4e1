"""The image formats that are read, each checked before it is decoded.

A decoder sees only what its format's file here has looked at: known magic bytes, no extras (animation, metadata, colour
profiles), and a size that was weighed against the memory it takes.
"""

from stereokit.data.image_formats.encoded import EncodedImage
from stereokit.data.image_formats.sniffing import read_header

__all__ = ["EncodedImage", "read_header"]
