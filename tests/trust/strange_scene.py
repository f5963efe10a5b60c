"""A scene with something of everything, as the text of its values, and strange values."""

# ruff: noqa: RUF001, SIM905

from typing import Any

import yaml
from hypothesis import strategies as st

SCENE: dict[str, Any] = yaml.load(
    """
volume:
  bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}
  resolution: [6, 5, 4]
  density: {file: density.npz}
  sigma_t: 2
  albedo: [0.5, 0.6, 0.7]
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
  - {type: ambient, radiance: [0.1, 0.2, 0.3]}
  - {type: environment, file: front.npy, scale: 1, rotation: 10, directions: 6}
  - {type: point, position: [0, 2, 0], intensity: 5}
views:
  - name: front
    image: front.npy
    camera: {type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], up: [0, 1, 0], fov: 30,
             resolution: [8, 6]}
  - name: side
    split: test
    mask: front.npy
    weight: 2
    camera: {type: orthographic, width: 1, resolution: [8, 6],
             matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.5], [0, 0, 0, 1]]}
render: {samples_per_pixel: 1, background: true, tolerance: 0.05}
diffusion: {model: p1, closure: geometric, tolerance: 1e-4, transport_rounds: 1}
optimize:
  iterations: 4
  loss: l2
  parameters:
    density: {init: 0, min: 0}
    g: {init: 0.1}
    lights.0.irradiance: {init: [1, 2, 3]}
    views.front.camera: {}
""",
    yaml.BaseLoader,
)
"""Its values are text, as they stand."""
RING = {
    "ring": {"count": "2", "radius": "2.5", "height": "0.1", "fov": "30", "resolution": ["8", "6"]},
    "images": '"*o*.npy"',
}
NUMBERS = (
    "0 -0.0 -1 1 2 3.5 1e-45 1e-300 1e38 -1e38 3e38 1e999 -1e999 .nan .inf -.inf 0o17 1e5 4096"
    " 16384 0x7fffffffffffffff 9223372036854775808 99999999999999999999999999999 1024 179.99999"
    " 0.9999999999 1_000 --1 1e 1.2.3"
).split()
WORDS = [
    *"~ null true no soon ü 𝔘𝔫𝔦 \u202e /dev/zero /dev/stdin pipe.npy pipe.npz loop.npy".split(),
    *"folder.npy link.npy gone.npz front.npy density.npz scene.yaml perspective *a | >".split(),
    *("", '""', '"\\0"', '"\\ud83d"', '"a\\nb"', "a" * 5000, '"' + "../" * 50 + 'etc/passwd"'),
    *('"/*/*/*/*"', '"**/*"', "!!python/name:os.system x", "&a 1", "? a", "- b", "@", "`", "{"),
    *("%TAG", "[", "]", "}", "{a: b", "'", '"', "#", ": :", "\t", "\x07", "\x85", "\ufeff"),
]
NESTED = [
    *("[" * 40 + "]" * 40, "{a: " * 40 + "}" * 40, "[" * 2000, "{a: " * 2000),
    *"[1, 2]; [1, 2, 3]; [0, 0, 0]; [[1, 2, 3]]; []; {}; [null]; {ring: {}}".split("; "),
    *"{file: pipe.npz}; {file: density.npz}; {file: folder.npy}; {constant: -1}".split("; "),
    *"{constant: 1}; [.nan, 1, 2]; [4096, 4096, 64]; [1024, 1024, 1024]".split("; "),
    *"[1e38, 1e38, 1e38]; [-1e38, 1e-38, 0]".split("; "),
]
VALUES = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(WORDS),
    st.sampled_from(NESTED),
    st.floats().map(repr),
    st.integers().map(str),
    st.text(max_size=12),
)
KNOWN = "density file type g init sigma_a matrix ring views.side.camera lights.9.scale << 1".split()
KEYS = st.one_of(
    st.sampled_from([*KNOWN, "a" * 3000, "\u202e", "é", '"a\\nb"', "? ", "[a]"]),
    st.text(max_size=8),
)
