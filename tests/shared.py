"""Where the shared sample data lies, if it is there at all."""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("STEREOKIT_SHARED", Path(__file__).resolve().parents[1] / ".." / "shared"))

needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared sample data is not here")
