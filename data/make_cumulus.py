"""Makes data/cumulus/cumulus_128.npy from cumulus.webp: `python data/make_cumulus.py`, with ddrecon
installed.
"""

from pathlib import Path

import numpy as np

from ddrecon.io.images.table import read_image

FOLDER = Path(__file__).parent / "cumulus"
TIMES = 4


def main() -> None:
    """Writes the mean radiance of each block of 4 x 4 pixels, that of the cloud alone, without the
    sky that alpha leaves out.
    """
    pixels = read_image(FOLDER / "cumulus.webp").pixels
    height, width = (size // TIMES for size in pixels.shape[:2])
    np.save(
        FOLDER / "cumulus_128.npy",
        pixels.reshape(height, TIMES, width, TIMES, 3).mean((1, 3)).astype(np.float16),
    )


if __name__ == "__main__":
    main()
