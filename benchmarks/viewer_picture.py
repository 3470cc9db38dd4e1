"""Makes docs/viewer.jpg: the viewer's page in headless Chromium, with a pixel clicked and the cloud turned."""

import argparse
from pathlib import Path

import cv2
import numpy as np
from browser import viewer_page

from stereokit import Predictor
from stereokit.calibration import read_calibration
from stereokit.data.pairs import match_pairs
from stereokit.viewer import Album, Desk


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("left")
    parser.add_argument("right")
    parser.add_argument("calibration")
    parser.add_argument("--pixel", type=int, nargs=2, default=(345, 245), metavar=("X", "Y"))
    parser.add_argument(
        "--to", type=int, nargs=2, default=(560, 256), metavar=("X", "Y"), help="measured from the pixel"
    )
    parser.add_argument("--out", default="docs/viewer.jpg")
    options = parser.parse_args()
    pairs = match_pairs(options.left, options.right)
    desk = Desk(Album(pairs), Predictor("coex"), read_calibration(options.calibration))
    with viewer_page(desk, width=1440, height=860) as page:
        page.wait_for_function("() => window.app && app.frame && !app.drawing")
        (x, y), (to_x, to_y) = options.pixel, options.to
        page.evaluate(
            f"() => {{ for (const at of [[{x}, {y}], [{to_x}, {to_y}]]) app.measure({{x: at[0], y: at[1]}}) }}"
        )
        page.evaluate(f"() => {{ app.setWipe(0.3); app.pin({x}, {y}); }}")
        page.wait_for_selector("#chart svg")
        page.wait_for_timeout(500)
        image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    image = cv2.resize(image, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 76])
    Path(options.out).write_bytes(encoded.tobytes())
    print(f"wrote {options.out}, {len(encoded) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
