"""Makes data/sky: a small environment map of a clear sky with its sun, above a dark ground.

Run it from the repository's root: `python data/make_sky.py`, with ddrecon installed.
"""

from pathlib import Path

import numpy as np

ROWS, COLUMNS = 9, 16
FOLDER = Path(__file__).parent / "sky"


def sky() -> np.ndarray:
    """Radiance [h, w, 3] of a latitude-longitude map: blue towards the zenith, paler at the
    horizon, one pixel of sun.
    """
    up = np.cos(np.linspace(0, np.pi, ROWS))[:, None, None]
    pale, blue, ground = (
        np.array([0.5, 0.6, 0.7]),
        np.array([0.1, 0.25, 0.6]),
        np.array([0.12, 0.1, 0.08]),
    )
    radiance = np.where(up >= 0, pale + (blue - pale) * up.clip(min=0) ** 0.5, ground)
    radiance = np.repeat(radiance, COLUMNS, axis=1)
    radiance[2, 10] = [40, 36, 28]
    return radiance.astype(np.float32)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    np.save(FOLDER / "sky.npy", sky())
